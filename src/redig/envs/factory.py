"""The environment that recipes train in: the scenario with its time limit, action check and reward scale."""

from __future__ import annotations

import torch
from torchrl.envs import Compose, RewardScaling, StepCounter, TransformedEnv, VmasEnv
from vmas.simulator.scenario import BaseScenario

from redig.envs.action_check import ActionCheck
from redig.envs.navigation import FormationNavigation


def make_env(
    num_envs: int,
    *,
    max_steps: int = 200,
    seed: int = 0,
    device: torch.device | str = "cpu",
    reward_scale: float = 1.0,
    scenario: BaseScenario | None = None,
    **scenario_kwargs: object,
) -> TransformedEnv:
    """Formation navigation as a TorchRL environment; a time-out truncates and does not terminate.

    Args:
        num_envs: number of teams simulated in parallel.
        max_steps: steps until a team's episode is cut.
        seed: of starts and goals.
        device: of the simulation.
        reward_scale: factor on the reward.
        scenario: what to simulate; by default :class:`~redig.envs.FormationNavigation`.
        scenario_kwargs: arguments of the scenario.

    Raises:
        ValueError: for ``num_envs`` or ``max_steps`` below 1, and for bad arguments of the scenario.

    Examples:
        >>> env = make_env(4, formation="line", n_robots=3)
        >>> env.rollout(2)["agents", "action"].shape
        torch.Size([4, 2, 3, 2])
    """
    for name, value in (("num_envs", num_envs), ("max_steps", max_steps)):
        if value < 1:
            raise ValueError(f"{name}: got {value}, must be at least 1")
    base = VmasEnv(
        FormationNavigation() if scenario is None else scenario,
        num_envs=num_envs,
        seed=seed,
        device=device,
        **scenario_kwargs,
    )
    transforms = [ActionCheck(), StepCounter(max_steps)]
    if reward_scale != 1:
        transforms.append(RewardScaling(loc=0.0, scale=reward_scale, in_keys=[("agents", "reward")]))
    return TransformedEnv(base, Compose(*transforms))
