"""Environments: formations, maps, rewards and the VMAS scenario made of them."""

from redig.envs.action_check import ActionCheck
from redig.envs.direction import smoothed_direction
from redig.envs.factory import make_env
from redig.envs.formations import FORMATIONS, formation_integrity, formation_offsets, pairwise_distances
from redig.envs.map_batch import MapBatch
from redig.envs.map_kinds import bollards, curve, doorway, forest, narrowing, passages
from redig.envs.maps import ObstacleMap, corridor
from redig.envs.navigation import FormationNavigation
from redig.envs.occupancy import OccupancyMap, load_occupancy_map
from redig.envs.random_maps import EVALUATION_MAPS, MAP_KINDS, named_map, random_map
from redig.envs.randomisation import ActionDelay, ObservationNoise
from redig.envs.turning import TurningCommand

__all__ = [
    "EVALUATION_MAPS",
    "FORMATIONS",
    "MAP_KINDS",
    "ActionCheck",
    "ActionDelay",
    "FormationNavigation",
    "MapBatch",
    "ObservationNoise",
    "ObstacleMap",
    "OccupancyMap",
    "TurningCommand",
    "bollards",
    "corridor",
    "curve",
    "doorway",
    "forest",
    "formation_integrity",
    "formation_offsets",
    "load_occupancy_map",
    "make_env",
    "named_map",
    "narrowing",
    "pairwise_distances",
    "passages",
    "random_map",
    "smoothed_direction",
]
