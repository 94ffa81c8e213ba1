"""The way of a team's centre: the path with the most room for the team, in the middle of what room there is."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from redig.envs.maps import ObstacleMap
from redig.envs.occupancy import OccupancyMap
from redig.planning.astar import astar
from redig.planning.curves import resample, smooth
from redig.planning.grid import OccupancyGrid, occupancy_grid

RAY_STEP = 0.05  # m


def team_grid(obstacle_map: ObstacleMap | OccupancyMap, radius: float, reach: float) -> OccupancyGrid:
    """A grid that is free near the middle of the map's gap, and where there is room, ``reach`` (m) from obstacles.

    Args:
        obstacle_map: the map.
        radius: of a robot (m).
        reach: half of the breadth that the team would like to have (m).

    Raises:
        ValueError: if the gap is too narrow for one robot.

    Examples:
        >>> from redig.envs.maps import corridor
        >>> grid = team_grid(corridor(1.1), radius=0.1, reach=1.2)
        >>> grid.is_free((0.0, 0.05)), grid.is_free((0.0, 0.15))
        (True, False)
    """
    room = obstacle_map.gap / 2 - radius
    if not room > 0:
        raise ValueError(f"obstacle_map: a gap of {obstacle_map.gap} m is too narrow for a robot of {radius} m radius")
    resolution = min(0.1, room / 2)
    return occupancy_grid(obstacle_map, resolution, inflation=min(obstacle_map.gap / 2 - resolution, reach))


def centre_path(
    obstacle_map: ObstacleMap | OccupancyMap,
    grid: OccupancyGrid,
    start: Tensor,
    goal: Tensor,
    reach: float,
    spacing: float = 0.02,
    half_window: float = 0.3,
) -> Tensor:
    """Samples of the way of a team's centre, half-way between the obstacles on its left and on its right.

    The path is A*'s; where obstacles within ``reach`` bind, it is moved to their middle, between such places it runs
    straight, and then it is smoothed.

    Args:
        obstacle_map: the map.
        grid: such as that of :func:`team_grid`.
        start: ``[2]`` (m).
        goal: ``[2]`` (m).
        reach: half of the breadth that the team would like to have (m).
        spacing: of the samples along the path (m).
        half_window: of the smoothing (m).

    Returns:
        ``[S, 2]`` (m); the first is the start, the last the goal.

    Raises:
        ValueError: if the start or the goal lies outside the grid, or no path connects them.

    Examples:
        >>> import torch
        >>> from redig.envs.maps import corridor
        >>> start, goal = torch.tensor([-2.75, 0.2]), torch.tensor([2.75, -0.1])
        >>> path = centre_path(corridor(), team_grid(corridor(), 0.1, 1.2), start, goal, reach=1.2)
        >>> bool((path[path[:, 0].abs() < 0.5, 1].abs() < 1e-3).all())  # the middle of the corridor
        True
    """
    path = resample(astar(grid, start, goal).to(start), spacing)
    for _ in range(3):
        shift, bound = _to_the_middle(*free_width(obstacle_map, path, reach), reach, obstacle_map.gap / 2)
        at, where = np.arange(len(path)), bound.cpu().numpy()
        between = np.interp(at, at[where], shift.cpu().numpy()[where])
        path = path + torch.as_tensor(between, dtype=path.dtype, device=path.device).unsqueeze(-1) * normals(path)
        path = smooth(resample(path, spacing), round(half_window / spacing))
    return path


def _to_the_middle(left: Tensor, right: Tensor, reach: float, least: float) -> tuple[Tensor, Tensor]:
    """How far to move to the left ``[S]`` (m), and where that is not a free choice ``[S]`` (bool).

    Between two obstacles to their middle, beside a single one to a distance of ``least``; the ends must stay.
    """
    between = (left < reach) & (right < reach)
    shift = torch.where(between, (left - right) / 2, (least - right).clamp_min(0) - (least - left).clamp_min(0))
    bound = between | (shift != 0)
    shift[[0, -1]], bound[[0, -1]] = 0.0, True
    return shift, bound


def normals(path: Tensor) -> Tensor:
    """Unit vectors ``[S, 2]`` to the left of a sampled path ``[S, 2]``.

    Examples:
        >>> import torch
        >>> normals(torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]))[1]
        tensor([-0., 1.])
    """
    along = torch.gradient(path, dim=0)[0]
    along = along / along.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    return torch.stack([-along[:, 1], along[:, 0]], -1)


def free_width(obstacle_map: ObstacleMap | OccupancyMap, path: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """How far it is from each point of a path to the first obstacle on its left and on its right, at most ``reach``.

    Args:
        obstacle_map: the map.
        path: ``[S, 2]`` (m).
        reach: how far to look (m).

    Returns:
        left and right, ``[S]`` (m) each.

    Examples:
        >>> import torch
        >>> from redig.envs.maps import corridor
        >>> path = torch.tensor([[-0.1, 0.2], [0.0, 0.2], [0.1, 0.2]])
        >>> left, right = free_width(corridor(1.1), path, reach=1.0)
        >>> round(left[1].item(), 3), round(right[1].item(), 3)
        (0.35, 0.75)
    """
    count = int(np.ceil(reach / RAY_STEP)) + 1
    steps = torch.linspace(0, reach, count, dtype=path.dtype, device=path.device)
    across = normals(path)
    both = torch.stack([across, -across]).unsqueeze(-2)  # [2, S, 1, 2]
    clear = obstacle_map.signed_distance(path.unsqueeze(-2) + steps.unsqueeze(-1) * both)  # [2, S, count]
    blocked = clear <= 0
    first = blocked.int().argmax(-1, keepdim=True)
    before = (first - 1).clamp_min(0)
    inside, outside = clear.gather(-1, first), clear.gather(-1, before)
    width = steps[before] + steps[1] * outside / (outside - inside).clamp_min(1e-9)  # where the distance is zero
    width = torch.where(first == 0, 0.0, width).squeeze(-1)
    left, right = torch.where(blocked.any(-1), width, reach).unbind(0)
    return left, right
