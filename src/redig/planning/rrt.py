"""RRT: a path found by a random tree, the second planner."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from redig.planning.grid import OccupancyGrid, Point, shortcut


def rrt(
    grid: OccupancyGrid,
    start: Sequence[float] | Tensor,
    goal: Sequence[float] | Tensor,
    seed: int = 0,
    step: float = 0.5,
    goal_bias: float = 0.1,
    max_iterations: int = 5000,
) -> Tensor:
    """Way points of a path from ``start`` to ``goal``: a goal-biased RRT, then line-of-sight shortcuts.

    The tree grows by at most ``step`` towards a random point of the grid, or towards the goal, and is complete as soon
    as the goal is in sight of its newest node. A start or goal in an occupied cell is connected to the nearest free
    one.

    Args:
        grid: the occupancy grid.
        start: x, y (m).
        goal: x, y (m).
        seed: of the random points.
        step: length of a branch (m).
        goal_bias: probability of growing towards the goal.
        max_iterations: random points to try.

    Returns:
        way points ``[W, 2]`` (m), the start first and the goal last.

    Raises:
        ValueError: if the start or the goal lies outside the grid.
        RuntimeError: if no path was found within ``max_iterations``.

    Examples:
        >>> from redig.envs.maps import corridor
        >>> from redig.planning import occupancy_grid
        >>> rrt(occupancy_grid(corridor()), (-3.0, 0.0), (3.0, 0.0))
        tensor([[-3.,  0.],
                [ 3.,  0.]])
    """
    first, last = (float(start[0]), float(start[1])), (float(goal[0]), float(goal[1]))
    root = grid.centre(grid.nearest_free("start", first))
    target = grid.centre(grid.nearest_free("goal", last))
    branch = _grow(grid, root, target, random.Random(seed), step, goal_bias, max_iterations)
    if not branch:
        raise RuntimeError(f"goal: {last} m was not reached from start {first} m in max_iterations={max_iterations}")
    return torch.tensor(shortcut(grid, [first, *_densify(branch, grid.resolution), last]))


def _grow(
    grid: OccupancyGrid,
    root: Point,
    target: Point,
    generator: random.Random,
    step: float,
    goal_bias: float,
    max_iterations: int,
) -> list[Point]:
    """Nodes from the root to the target, or none if the tree does not get there."""
    nodes = np.empty((max_iterations + 1, 2))
    nodes[0] = root
    parents = [-1]
    (x_min, y_min), (height, width) = grid.origin, grid.occupied.shape
    newest: Point | None = root
    for _ in range(max_iterations):
        if newest is not None and grid.line_of_sight(newest, target):
            branch, node = [target], len(parents) - 1
            while node >= 0:
                branch.append((float(nodes[node, 0]), float(nodes[node, 1])))
                node = parents[node]
            return branch[::-1]
        drawn = (
            x_min + width * grid.resolution * generator.random(),
            y_min + height * grid.resolution * generator.random(),
        )
        x, y = target if generator.random() < goal_bias else drawn
        offset = nodes[: len(parents)] - (x, y)
        nearest = int(np.einsum("ij,ij->i", offset, offset).argmin())
        from_x, from_y = float(nodes[nearest, 0]), float(nodes[nearest, 1])
        share = min(1.0, step / max(math.hypot(x - from_x, y - from_y), 1e-9))
        newest = (from_x + share * (x - from_x), from_y + share * (y - from_y))
        if grid.line_of_sight((from_x, from_y), newest):
            nodes[len(parents)] = newest
            parents.append(nearest)
        else:
            newest = None
    return []


def _densify(points: list[Point], spacing: float) -> list[Point]:
    """The same path with way points at most ``spacing`` (m) apart, so that shortcuts can start between nodes."""
    dense = [points[0]]
    for (x0, y0), (x1, y1) in pairwise(points):
        pieces = max(1, math.ceil(math.hypot(x1 - x0, y1 - y0) / spacing))
        dense += [(x0 + (x1 - x0) * k / pieces, y0 + (y1 - y0) * k / pieces) for k in range(1, pieces + 1)]
    return dense
