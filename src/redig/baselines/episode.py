"""What all baselines share: a plan at the start of each episode, and then a command at each step."""

from __future__ import annotations

from abc import abstractmethod

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from redig.envs.navigation import FormationNavigation
from redig.policy import ACTION, OBSERVATION

STEP = "step_count"


class EpisodePlanner(TensorDictModuleBase):
    """A centralised policy that plans when ``step_count`` (TorchRL's ``StepCounter``) is 0.

    Teams that begin an episode are planned for in that step, the others keep their plan.

    Args:
        scenario: of the environment to drive; its map, offsets and limits are read.

    Raises:
        ValueError: when called with an observation of another number of robots than the scenario's.

    Examples:
        >>> from redig.envs import make_env
        >>> class Resting(EpisodePlanner):
        ...     def begin(self, teams, position, goal, num_teams):
        ...         pass
        ...
        ...     def command(self, position, velocity, step):
        ...         return torch.zeros_like(position)
        >>> env = make_env(2)
        >>> env.rollout(3, Resting(env.scenario))["agents", "action"].abs().max().item()
        0.0
    """

    def __init__(self, scenario: FormationNavigation) -> None:
        super().__init__()
        self.scenario = scenario
        self.in_keys = [OBSERVATION, STEP]
        self.out_keys = [ACTION]
        self._teams = 0

    @abstractmethod
    def begin(self, teams: Tensor, position: Tensor, goal: Tensor, num_teams: int) -> None:
        """Plan for the teams ``[E]`` (indices of ``num_teams``), at ``position`` ``[E, n, 2]`` with ``goal`` (m)."""

    @abstractmethod
    def command(self, position: Tensor, velocity: Tensor, step: Tensor) -> Tensor:
        """Velocity commands ``[B, n, 2]`` (m/s) at ``step`` ``[B]`` of the episode."""

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of all robots."""
        observation = tensordict[OBSERVATION]
        if observation.ndim != 3 or observation.shape[1] != self.scenario.n_robots:
            raise ValueError(
                f"observation: got shape {list(observation.shape)}, expected [teams, {self.scenario.n_robots}, F]"
            )
        position, velocity, way = observation[..., :2], observation[..., 2:4], observation[..., 4:6]
        step = tensordict[STEP].reshape(-1)
        beginning = step == 0 if self._teams == len(step) else torch.ones_like(step, dtype=torch.bool)
        if beginning.any():
            teams = beginning.nonzero().squeeze(-1)
            self.begin(teams, position[teams], (position + way)[teams], len(step))
            self._teams = len(step)
        limit = self.scenario.max_speed
        return tensordict.set(ACTION, self.command(position, velocity, step).clamp(-limit, limit))
