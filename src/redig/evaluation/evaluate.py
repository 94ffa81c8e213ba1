"""Evaluate a policy: drive teams from fresh starts, once each, and measure what they did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.envs.navigation import FormationNavigation
from redig.envs.seeding import preserve_rng_state
from redig.evaluation.metrics import contextual_formation_integrity, jerk, success, travel_time


def rollout_trajectories(
    policy: TensorDictModuleBase,
    env: EnvBase,
    seed: int,
    max_steps: int | None = None,
    exploration_type: ExplorationType = ExplorationType.DETERMINISTIC,
) -> TensorDict:
    """Drive every team of ``env`` once, from a start drawn with ``seed`` until it is done; no start is used twice.

    Torch's and the simulator's random states are as before afterwards; the state of ``env`` itself is not.

    Args:
        policy: any TensorDictModule from the observation to the action.
        env: a :class:`~redig.envs.navigation.FormationNavigation` as TorchRL environment, ``num_envs`` = E.
        seed: of the starts and of the policy's noise.
        max_steps: horizon; default: that of the environment's ``StepCounter``.
        exploration_type: of the policy.

    Returns:
        TensorDict ``[E, T]`` of ``position`` ``[E, T, n, 2]`` (m), ``velocity`` and the ``command`` that led to it
        (m/s; zeros at the start), and, all bool, ``arrived`` and ``collision`` ``[E, T, n]`` and ``mask`` ``[E, T]``.
        The first of the T samples is the start, so T is at most ``max_steps + 1``. ``mask`` is true until the team is
        done; what follows repeats its last sample.

    Raises:
        ValueError: if there is no horizon, or it is not positive.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from redig.envs import make_env
        >>> observation, action = ("agents", "observation"), ("agents", "action")
        >>> rest = TensorDictModule(lambda state: torch.zeros_like(state[..., :2]), [observation], [action])
        >>> rollout_trajectories(rest, make_env(2), seed=0, max_steps=3)["position"].shape
        torch.Size([2, 4, 5, 2])
    """
    max_steps = _horizon(env) if max_steps is None else max_steps
    if max_steps < 1:
        raise ValueError(f"max_steps: got {max_steps}, must be at least 1")
    with preserve_rng_state(), torch.no_grad(), set_exploration_type(exploration_type):
        env.set_seed(seed)
        torch.manual_seed(seed)  # the policy's noise must not depend on how a simulator is seeded
        data = env.rollout(max_steps, policy, break_when_all_done=True)
    info = TensorDict.cat([data[:, :1]["agents", "info"], data["next", "agents", "info"]], 1)
    done = data["next", "done"].squeeze(-1)
    ended_before = torch.cat([done.new_zeros(done.shape[0], 2), done[:, :-1]], 1).cummax(1).values
    return TensorDict(
        {
            "position": info["position"],
            "velocity": info["velocity"],
            "command": torch.cat([torch.zeros_like(info["velocity"][:, :1]), data["agents", "action"]], 1),
            "arrived": info["arrived"].squeeze(-1) > 0,
            "collision": info["collision"].squeeze(-1) > 0,
            "mask": ~ended_before,
        },
        [done.shape[0], done.shape[1] + 1],
    )


def evaluate(
    policy: TensorDictModuleBase,
    env: EnvBase,
    seed: int,
    num_starts: int | None = None,
    max_steps: int | None = None,
    deltas: Sequence[float] = (0.5, 0.1, 0.03),
    exploration_type: ExplorationType = ExplorationType.DETERMINISTIC,
) -> dict[str, float]:
    """Drive teams from fresh starts and report the metrics of the paper, see :mod:`redig.evaluation.metrics`.

    The corridor width with a safety margin, xi of the CFI, is taken as the breadth that the robots' centres can use:
    the map's gap less a robot's diameter. The CFI of a team is averaged until its last arrival (or the horizon), and
    the jerk of a robot until its own arrival, because after it the environment holds the robot, not the policy.

    Args:
        policy: any TensorDictModule from the observation to the action.
        env: a :class:`~redig.envs.navigation.FormationNavigation` as TorchRL environment.
        seed: of the starts; equal seeds give equal starts.
        num_starts: number of starts; default: one for each of the environment's ``num_envs``. With more, the
            environment is run again with the seeds that follow; with fewer, the rest is driven but not counted.
        max_steps: horizon; default: that of the environment's ``StepCounter``.
        deltas: tolerances of the CFI (m).
        exploration_type: of the policy.

    Returns:
        ``success_rate`` (robots), ``team_success_rate``, ``travel_time`` (s, mean over the teams of which every robot
        arrives), ``travel_time_teams`` (their fraction), ``cfi_<delta>`` and ``cfi_literal_<delta>`` for each delta,
        ``jerk_mean`` and ``jerk_peak`` (m/s³, mean over teams of a team's mean, and of the largest of any robot),
        ``collision_rate`` (robots that ever collide) and ``num_starts``. NaN where nothing was there to measure.

    Raises:
        ValueError: if ``num_starts`` or ``max_steps`` is not positive, or there is no horizon.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from redig.envs import make_env
        >>> observation, action = ("agents", "observation"), ("agents", "action")
        >>> straight = TensorDictModule(lambda state: state[..., 4:6].clamp(-1, 1), [observation], [action])
        >>> metrics = evaluate(straight, make_env(4, formation="line", corridor_width=4.0), seed=0)
        >>> metrics["success_rate"], metrics["num_starts"]  # in so wide a corridor, straight on is good enough
        (1.0, 4.0)
    """
    return mean_metrics([evaluate_teams(policy, env, seed, num_starts, max_steps, deltas, exploration_type)])


def mean_metrics(teams: Sequence[Mapping[str, Tensor]]) -> dict[str, float]:
    """What :func:`evaluate` reports of teams: the mean of each metric, NaN left out, and ``num_starts``.

    Args:
        teams: from :func:`team_metrics` or :func:`evaluate_teams`, one or several; each metric is ``[E]``.

    Examples:
        >>> rates = [{"travel_time": torch.tensor([7.0, torch.nan])}, {"travel_time": torch.tensor([8.0])}]
        >>> mean_metrics(rates)
        {'travel_time': 7.5, 'num_starts': 3.0}
    """
    metrics = {key: torch.cat([each[key] for each in teams]) for key in teams[0]}
    means = {key: value.nanmean().item() for key, value in metrics.items()}
    return {**means, "num_starts": float(len(next(iter(metrics.values()))))}


def evaluate_teams(
    policy: TensorDictModuleBase,
    env: EnvBase,
    seed: int,
    num_starts: int | None = None,
    max_steps: int | None = None,
    deltas: Sequence[float] = (0.5, 0.1, 0.03),
    exploration_type: ExplorationType = ExplorationType.DETERMINISTIC,
) -> dict[str, Tensor]:
    """The metrics of :func:`evaluate` for each start, ``[num_starts]``: what intervals are computed from.

    ``travel_time`` is NaN for a team of which not every robot arrives.

    Args:
        policy: see :func:`evaluate`, as the other arguments.
        env: see there.
        seed: see there.
        num_starts: see there.
        max_steps: see there.
        deltas: see there.
        exploration_type: see there.

    Raises:
        ValueError: see there.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from redig.envs import make_env
        >>> observation, action = ("agents", "observation"), ("agents", "action")
        >>> straight = TensorDictModule(lambda state: state[..., 4:6].clamp(-1, 1), [observation], [action])
        >>> teams = evaluate_teams(straight, make_env(4, formation="line", corridor_width=4.0), seed=0, num_starts=3)
        >>> teams["team_success_rate"]
        tensor([1., 1., 1.])
    """
    num_envs = env.batch_size[0]
    num_starts = num_envs if num_starts is None else num_starts
    if num_starts < 1:
        raise ValueError(f"num_starts: got {num_starts}, must be at least 1")
    scenario: FormationNavigation = env.scenario
    teams: dict[str, list[Tensor]] = {}
    for run in range(-(-num_starts // num_envs)):
        trajectories = rollout_trajectories(policy, env, seed + run, max_steps, exploration_type)
        for key, value in team_metrics(trajectories, scenario, deltas).items():
            teams.setdefault(key, []).append(value)
    return {key: torch.cat(values)[:num_starts] for key, values in teams.items()}


def team_metrics(
    trajectories: TensorDictBase, scenario: FormationNavigation, deltas: Sequence[float] = (0.5, 0.1, 0.03)
) -> dict[str, Tensor]:
    """Every metric of :func:`evaluate` for each team.

    Args:
        trajectories: as :func:`rollout_trajectories` returns them, ``[E, T]``; of ``velocity`` and ``command`` it has
            no need.
        scenario: whose formation, map, radius and time step count.
        deltas: tolerances of the CFI (m).

    Returns:
        ``[E]`` each, NaN where there is nothing to measure.

    Examples:
        >>> from redig.envs import make_env
        >>> scenario = make_env(1, formation="line").scenario
        >>> position = torch.linspace(-2, 2, 5)[:, None] * torch.eye(2)[1] + torch.arange(8.0)[None, :, None, None] / 10
        >>> arrived = torch.zeros(1, 8, 5, dtype=torch.bool)
        >>> arrived[:, 7:] = True
        >>> still = torch.zeros_like(arrived)
        >>> team = {"position": position, "arrived": arrived, "collision": still, "mask": ~still[..., 0]}
        >>> round(team_metrics(TensorDict(team, [1, 8]), scenario)["travel_time"].item(), 3)
        0.7
    """
    position, arrived, collision = (trajectories[key] for key in ("position", "arrived", "collision"))
    reached = success(arrived, collision)
    time = travel_time(arrived, scenario.dt)
    metrics = {
        "success_rate": reached.float().mean(-1),
        "team_success_rate": reached.all(-1).float(),
        "travel_time": time,
        "travel_time_teams": (~time.isnan()).float(),
    }
    # both averages run over the samples produced by a command given before the (last) arrival
    moving = ~arrived.roll(1, 1)
    moving[:, 0] = True
    moving &= trajectories["mask"].unsqueeze(-1)  # [E, T, n]
    xi = scenario.obstacle_map.gap - 2 * scenario.radius
    for literal, prefix in ((False, "cfi"), (True, "cfi_literal")):
        for delta in deltas:
            integrity = contextual_formation_integrity(scenario.formation, position, xi, delta, literal=literal)
            metrics[f"{prefix}_{delta:g}"] = _masked_mean(integrity, moving.any(-1))
    third = jerk(position, scenario.dt)
    counted = moving[:, 3:]
    metrics["jerk_mean"] = _masked_mean(third.flatten(1), counted.flatten(1))
    peak = third.masked_fill(~counted, 0).flatten(1)
    empty = ~counted.flatten(1).any(-1)
    metrics["jerk_peak"] = torch.cat([peak, peak.new_zeros(len(peak), 1)], 1).amax(-1).masked_fill(empty, float("nan"))
    metrics["collision_rate"] = collision.any(-2).float().mean(-1)
    return metrics


def _masked_mean(value: Tensor, mask: Tensor) -> Tensor:
    """Mean ``[E]`` of ``value`` ``[E, T]`` where ``mask`` is true; NaN where it nowhere is."""
    return torch.where(mask, value, 0).sum(-1) / mask.sum(-1)


def _horizon(env: EnvBase) -> int:
    transforms = env.transform if isinstance(env, TransformedEnv) else ()
    transforms = [transforms] if isinstance(transforms, StepCounter) else transforms
    for transform in transforms:
        if isinstance(transform, StepCounter) and transform.max_steps is not None:
            return transform.max_steps
    raise ValueError(
        "max_steps: got None, but the environment has no StepCounter with a horizon; give a number of steps"
    )
