"""Planning: paths on an occupancy grid, path tracking, and the demonstrations made with them."""

from redig.planning.astar import astar
from redig.planning.demonstrations import demonstrations
from redig.planning.grid import OccupancyGrid, occupancy_grid
from redig.planning.rrt import rrt
from redig.planning.virtual_structure import StructurePlanner

__all__ = ["OccupancyGrid", "StructurePlanner", "astar", "demonstrations", "occupancy_grid", "rrt"]
