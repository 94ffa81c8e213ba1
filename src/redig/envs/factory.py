"""The environment that recipes train in: the scenario with its time limit, action check and reward scale."""

from __future__ import annotations

import torch
from torchrl.envs import Compose, RewardScaling, StepCounter, TransformedEnv, VmasEnv
from vmas.simulator.scenario import BaseScenario

from redig.envs.action_check import ActionCheck
from redig.envs.navigation import FormationNavigation
from redig.envs.randomisation import ActionDelay, ObservationNoise


def make_env(
    num_envs: int,
    *,
    max_steps: int = 200,
    seed: int = 0,
    device: torch.device | str = "cpu",
    reward_scale: float = 1.0,
    scenario: BaseScenario | None = None,
    action_delay: tuple[int, int] = (0, 0),
    observation_noise: float = 0.0,
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
        action_delay: smallest and largest delay of commands (steps), see :class:`~redig.envs.ActionDelay`.
        observation_noise: standard deviation, see :class:`~redig.envs.ObservationNoise`; 0: none.
        scenario_kwargs: arguments of the scenario.

    Raises:
        ValueError: for ``num_envs`` or ``max_steps`` below 1, a bad delay or noise, and bad arguments of the scenario.

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
    delay = [] if tuple(action_delay) == (0, 0) else [ActionDelay(*action_delay)]
    transforms = [*delay, ActionCheck(), StepCounter(max_steps)]  # actions pass from last to first
    if reward_scale != 1:
        transforms.append(RewardScaling(loc=0.0, scale=reward_scale, in_keys=[("agents", "reward")]))
    if observation_noise != 0:
        transforms.append(ObservationNoise(observation_noise))
    return TransformedEnv(base, Compose(*transforms))
