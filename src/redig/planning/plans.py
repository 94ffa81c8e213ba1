"""Plans for the robots of many teams at once, as functions from where they are to velocity commands."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import lru_cache, partial

import torch
from torch import Tensor

from redig.envs.map_batch import map_at
from redig.envs.maps import ObstacleMap
from redig.envs.navigation import FormationNavigation
from redig.envs.occupancy import OccupancyMap
from redig.planning.astar import astar
from redig.planning.grid import OccupancyGrid, occupancy_grid
from redig.planning.rrt import rrt
from redig.planning.tracking import PathTracker, ReferenceTracker, pad_paths, pad_references
from redig.planning.virtual_structure import StructurePlanner

CLEARANCE = 0.12  # m, that a virtual structure keeps where its robots are disturbed, and will be imitated


def planning_grid(obstacle_map: ObstacleMap | OccupancyMap, radius: float) -> OccupancyGrid:
    """The grid for robots of a radius (m): 0.15 m of clearance where there is room, less in a narrow gap.

    Examples:
        >>> from redig.envs.maps import corridor
        >>> planning_grid(corridor(1.1), 0.1).resolution, round(planning_grid(corridor(0.3), 0.1).resolution, 3)
        (0.1, 0.025)
    """
    room = obstacle_map.gap / 2 - radius
    clearance = min(0.15, room / 2)
    return occupancy_grid(obstacle_map, resolution=min(0.1, room - clearance), inflation=radius + clearance)


def team_grids(scenario: FormationNavigation) -> Callable[[int], OccupancyGrid]:
    """The grid that each team's robots plan on, by its number; one is made for each map.

    Examples:
        >>> from redig.envs import make_env
        >>> grid_of = team_grids(make_env(2).scenario)
        >>> grid_of(0) is grid_of(1)  # on one map
        True
    """
    grid = lru_cache(maxsize=None)(partial(planning_grid, radius=scenario.radius))
    return lambda team: grid(map_at(scenario.obstacle_map, team))


def team_structures(scenario: FormationNavigation, **options: float) -> Callable[[int], StructurePlanner]:
    """The virtual structure of each team, by its number; one is made for each map.

    Args:
        scenario: formation, robots and map.
        options: of :class:`~redig.planning.virtual_structure.StructurePlanner`.

    Examples:
        >>> from redig.envs import make_env
        >>> structure_of = team_structures(make_env(2).scenario, clearance=0.05)
        >>> structure_of(0) is structure_of(1)  # on one map
        True
    """

    def structure(team_map: ObstacleMap | OccupancyMap) -> StructurePlanner:
        offsets = scenario.offsets.cpu()
        return StructurePlanner(team_map.to("cpu"), scenario.formation, offsets, scenario.radius, **options)

    cached = lru_cache(maxsize=None)(structure)
    return lambda team: cached(map_at(scenario.obstacle_map, team))


def plan_alone(
    scenario: FormationNavigation,
    start: Tensor,
    goal: Tensor,
    planner: str,
    speed: tuple[float, float],
    generator: torch.Generator,
    seed: int,
    report: Callable[[int], None],
) -> PathTracker:
    """Commands of robots that each have a plan and a speed of their own.

    Args:
        scenario: map and limits.
        start: ``[E, n, 2]`` (m).
        goal: ``[E, n, 2]`` (m).
        planner: ``"astar"`` or ``"rrt"``.
        speed: lowest and highest (m/s).
        generator: of the speeds.
        seed: of RRT.
        report: called with the number of each team that is planned for.

    Returns:
        a function from positions ``[E, n, 2]`` (m) to commands ``[E, n, 2]`` (m/s).

    Examples:
        >>> from redig.envs import make_env
        >>> env = make_env(2, n_robots=3)
        >>> observation = env.reset()["agents", "observation"]
        >>> start, goal = observation[..., :2], observation[..., :2] + observation[..., 4:6]
        >>> speed, generator = (0.5, 1.0), torch.Generator()
        >>> tracker = plan_alone(env.scenario, start, goal, "astar", speed, generator, 0, lambda team: None)
        >>> tracker(start).shape
        torch.Size([2, 3, 2])
    """
    grid_of = team_grids(scenario)
    num_envs, n = start.shape[:2]
    paths = []
    for i, (a, b) in enumerate(zip(start.flatten(0, 1).tolist(), goal.flatten(0, 1).tolist(), strict=True)):
        grid = grid_of(i // n)
        paths.append(astar(grid, a, b) if planner == "astar" else rrt(grid, a, b, seed=seed + i))
        if (i + 1) % n == 0:
            report(i // n)
    own_speed = torch.empty(num_envs, n, device=start.device).uniform_(*speed, generator=generator)
    plans = pad_paths(paths).to(start.device).unflatten(0, (num_envs, n))
    return PathTracker(plans, own_speed, scenario.max_acceleration, scenario.dt)


def plan_together(
    scenario: FormationNavigation,
    start: Tensor,
    goal: Tensor,
    speed: tuple[float, float],
    generator: torch.Generator,
    report: Callable[[int], None],
) -> Callable[[Tensor], Tensor]:
    """Commands of teams that each have one plan, that of a virtual structure, and one speed.

    The arguments are those of :func:`plan_alone`. The function returned counts its calls: one for each step.

    Examples:
        >>> from redig.envs import make_env
        >>> env = make_env(2, n_robots=3)
        >>> observation = env.reset()["agents", "observation"]
        >>> start, goal = observation[..., :2], observation[..., :2] + observation[..., 4:6]
        >>> tracker = plan_together(env.scenario, start, goal, (1.0, 1.0), torch.Generator(), lambda team: None)
        >>> tracker(start).shape
        torch.Size([2, 3, 2])
    """
    structure_of = team_structures(scenario, clearance=CLEARANCE)
    team_speed = torch.empty(len(start), device=start.device).uniform_(*speed, generator=generator)
    references = []
    for i, (a, b, limit) in enumerate(zip(start.cpu(), goal.cpu(), team_speed.tolist(), strict=True)):
        references.append(structure_of(i)(a, b, limit, scenario.max_acceleration, scenario.dt))
        report(i)
    tracker = ReferenceTracker(pad_references(references).to(start.device), scenario.dt)
    steps = itertools.count()
    return lambda position: tracker(position, torch.full((len(position),), next(steps), device=position.device))
