"""The uncoordinated planner: what the demonstrations do, without their noise and with one speed for all."""

from __future__ import annotations

import torch
from torch import Tensor

from redig.baselines.episode import EpisodePlanner
from redig.envs.navigation import FormationNavigation
from redig.planning.astar import astar
from redig.planning.plans import team_grids
from redig.planning.tracking import PathTracker, pad_paths


class UncoordinatedPlanner(EpisodePlanner):
    """Each robot follows its own A* path and does not know of the others.

    Args:
        scenario: of the environment to drive.
        speed: of all robots (m/s).

    Raises:
        ValueError: if the speed is not positive or above the scenario's limit.

    Examples:
        >>> from redig.envs import make_env
        >>> env = make_env(2)
        >>> env.rollout(3, UncoordinatedPlanner(env.scenario))["agents", "action"].shape
        torch.Size([2, 3, 5, 2])
    """

    def __init__(self, scenario: FormationNavigation, speed: float = 1.0) -> None:
        super().__init__(scenario)
        if not 0 < speed <= scenario.max_speed:
            raise ValueError(f"speed: got {speed}, must satisfy 0 < speed <= max_speed = {scenario.max_speed} m/s")
        self.speed = speed
        self.grid_of = team_grids(scenario)
        self._plans: list[Tensor] = []

    def begin(self, teams: Tensor, position: Tensor, goal: Tensor, num_teams: int) -> None:
        """Plan a path for each robot of the teams."""
        n = position.shape[1]
        if len(self._plans) != num_teams * n:
            self._plans = [position.new_empty(0)] * num_teams * n
        for team, starts, ends in zip(teams.tolist(), position.tolist(), goal.tolist(), strict=True):
            grid = self.grid_of(team)
            self._plans[team * n : (team + 1) * n] = [astar(grid, a, b) for a, b in zip(starts, ends, strict=True)]
        paths = pad_paths(self._plans).to(position.device).unflatten(0, (num_teams, n))
        speed = torch.full(paths.shape[:2], self.speed, device=position.device)
        self._tracker = PathTracker(paths, speed, self.scenario.max_acceleration, self.scenario.dt)

    def command(self, position: Tensor, velocity: Tensor, step: Tensor) -> Tensor:
        """Follow the own path."""
        return self._tracker(position)
