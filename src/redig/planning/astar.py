"""A*: the shortest path on an occupancy grid, pulled tight."""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from redig.planning.grid import OccupancyGrid, shortcut


def shortest_cells(grid: OccupancyGrid, start: int, goal: int) -> tuple[list[int], float]:
    """The shortest 8-connected way between two free cells that cuts no corner (A*, octile heuristic).

    Args:
        grid: the occupancy grid.
        start: number of the first cell.
        goal: number of the last cell.

    Returns:
        cell numbers, and the length of the way (cells); no cells and infinity if there is none.

    Examples:
        >>> import torch
        >>> grid = OccupancyGrid(torch.zeros(1, 4, dtype=torch.bool), resolution=1.0, origin=(0.0, 0.0))
        >>> cells, length = shortest_cells(grid, grid.cell((0.5, 0.5)), grid.cell((3.5, 0.5)))
        >>> [grid.centre(cell)[0] for cell in cells], length
        ([0.5, 1.5, 2.5, 3.5], 3.0)
    """
    stride, neighbours = grid.stride, grid.neighbours
    goal_column, goal_row = divmod(goal, stride)
    diagonal_extra = math.sqrt(2) - 1
    length = {start: 0.0}
    parent: dict[int, int] = {}
    closed = bytearray(len(neighbours))
    queue = [(0.0, start)]
    while queue:
        cell = heapq.heappop(queue)[1]
        if cell == goal:
            cells = [cell]
            while cells[-1] != start:
                cells.append(parent[cells[-1]])
            return cells[::-1], length[goal]
        if closed[cell]:
            continue
        closed[cell] = 1
        here = length[cell]
        for neighbour, step in neighbours[cell]:
            candidate = here + step
            if candidate < length.get(neighbour, math.inf):
                length[neighbour] = candidate
                parent[neighbour] = cell
                column, row = divmod(neighbour, stride)
                dx, dy = abs(column - goal_column), abs(row - goal_row)
                rest = dx + diagonal_extra * dy if dx > dy else dy + diagonal_extra * dx
                heapq.heappush(queue, (candidate + rest, neighbour))
    return [], math.inf


def astar(grid: OccupancyGrid, start: Sequence[float] | Tensor, goal: Sequence[float] | Tensor) -> Tensor:
    """Way points of a short path from ``start`` to ``goal``: A* on the grid, then line-of-sight shortcuts.

    A start or goal in an occupied cell is connected to the nearest free one.

    Args:
        grid: the occupancy grid.
        start: x, y (m).
        goal: x, y (m).

    Returns:
        way points ``[W, 2]`` (m), the start first and the goal last.

    Raises:
        ValueError: if the start or the goal lies outside the grid, or no path connects them.

    Examples:
        >>> from redig.envs.maps import corridor
        >>> from redig.planning import occupancy_grid
        >>> astar(occupancy_grid(corridor()), (-3.0, 0.0), (3.0, 0.0))
        tensor([[-3.,  0.],
                [ 3.,  0.]])
    """
    first, last = (float(start[0]), float(start[1])), (float(goal[0]), float(goal[1]))
    start_cell, goal_cell = grid.nearest_free("start", first), grid.nearest_free("goal", last)
    cells, _ = shortest_cells(grid, start_cell, goal_cell)
    if not cells:
        raise ValueError(f"goal: {last} m cannot be reached from start {first} m; no free cells connect them")
    return torch.tensor(shortcut(grid, [first, *map(grid.centre, cells), last]))
