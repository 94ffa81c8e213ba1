"""Metrics as pure functions of trajectories: success, travel time, contextual formation integrity (CFI) and jerk.

A trajectory holds T samples, ``dt`` (s) apart, of which the first is the start (t = 0). Teams that finish early are
padded by repeating their last sample.
"""

from __future__ import annotations

import torch
from torch import Tensor

from redig.envs.formations import formation_integrity


def success(arrived: Tensor, collision: Tensor) -> Tensor:
    """Which robots succeed: ``any_t arrived_i(t) and not any_t collision_i(t)``, SR of Sec. 4.

    A collision at any time counts, also one after the arrival.

    Args:
        arrived: ``[*B, T, n]`` bool, whether the robot has reached its goal.
        collision: ``[*B, T, n]`` bool, whether the robot touches a wall or a teammate.

    Returns:
        ``[*B, n]`` bool. Its mean is the success rate of robots, that of :func:`team_success` the one of teams.

    Examples:
        >>> import torch
        >>> arrived = torch.tensor([[False, False], [True, True]])
        >>> success(arrived, torch.tensor([[False, True], [False, False]]))
        tensor([ True, False])
    """
    return arrived.any(-2) & ~collision.any(-2)


def team_success(arrived: Tensor, collision: Tensor) -> Tensor:
    """Which teams succeed, that is, all of their robots (see :func:`success`): ``[*B]`` bool.

    Examples:
        >>> import torch
        >>> arrived = torch.tensor([[[True, True]], [[True, False]]])  # two teams of two robots, one sample
        >>> team_success(arrived, torch.zeros_like(arrived))
        tensor([ True, False])
    """
    return success(arrived, collision).all(-1)


def travel_time(arrived: Tensor, dt: float) -> Tensor:
    """Time of the last arrival, ``TT = dt * max_i min {t : arrived_i(t)}``.

    A team that leaves a robot behind has no travel time (the horizon is none), so report the mean over the others
    together with how many those are.

    Args:
        arrived: ``[*B, T, n]`` bool; the first sample is t = 0.
        dt: time between samples (s).

    Returns:
        ``[*B]`` (s); NaN for teams of which some robot never arrives.

    Examples:
        >>> import torch
        >>> arrived = torch.tensor([[False, False], [True, False], [True, True]])
        >>> round(travel_time(arrived, dt=0.1).item(), 3)
        0.2
    """
    first = arrived.int().argmax(-2)  # of equal values, argmax gives the first
    last = dt * first.amax(-1).to(torch.get_default_dtype())
    return last.masked_fill(~arrived.any(-2).all(-1), float("nan"))


def gap_term(position: Tensor, xi: float | Tensor, delta: float, literal: bool = False) -> Tensor:
    """How well the team's size fits the gap: the first term of the CFI (Appendix F.5), in [0, 1].

    With r the team's maximum radius, the largest distance of a robot from the centroid, the default is
    ``clamp(2 - |r - xi| / delta, 0, 1)``: 1 while ``|r - xi| <= delta``, then falling linearly to 0 at ``2 delta``. The
    printed ``1 - min(|r - (xi + delta)|, |r - (xi - delta)|) / delta`` is 0 at ``r = xi`` and unbounded below;
    ``literal=True`` gives it clamped to [0, 1] (``docs/paper.md``).

    Args:
        position: ``[*B, n, 2]`` (m).
        xi: corridor width with a safety margin (m), such as the gap less a robot's diameter; broadcasts against ``*B``.
        delta: tolerance (m).
        literal: the formula as printed, clamped.

    Returns:
        ``[*B]``.

    Raises:
        ValueError: if ``delta`` is not positive.

    Examples:
        >>> import torch
        >>> pair = torch.tensor([[-1.0, 0.0], [1.0, 0.0]])  # r = 1 m
        >>> gap_term(pair, xi=1.0, delta=0.5).item(), gap_term(pair, xi=1.0, delta=0.5, literal=True).item()
        (1.0, 0.0)
    """
    if not delta > 0:
        raise ValueError(f"delta: got {delta}, must be greater than 0 m")
    radius = (position - position.mean(-2, keepdim=True)).norm(dim=-1).amax(-1)
    if literal:
        term = 1 - torch.minimum((radius - (xi + delta)).abs(), (radius - (xi - delta)).abs()) / delta
    else:
        term = 2 - (radius - xi).abs() / delta
    return term.clamp(0, 1)


def contextual_formation_integrity(
    name: str, position: Tensor, xi: float | Tensor, delta: float, w: float = 0.5, literal: bool = False
) -> Tensor:
    """Contextual formation integrity (Appendix F.5): ``CFI = w * gap_term + (1 - w) * tau``, in [0, 1].

    Args:
        name: formation name, see :func:`redig.envs.formations.formation_offsets`.
        position: ``[*B, n, 2]`` (m), robots in the order of the formation.
        xi: corridor width with a safety margin (m), see :func:`gap_term`.
        delta: tolerance of the gap term (m).
        w: weight of the gap term, in [0, 1].
        literal: both terms as printed, each clamped to [0, 1].

    Returns:
        ``[*B]``; the report averages it over time.

    Raises:
        ValueError: if ``w`` is not in [0, 1], ``delta`` not positive or the name unknown.

    Examples:
        >>> from redig.envs.formations import formation_offsets
        >>> line = formation_offsets("line", 5, width=2.0)  # r = 1 m
        >>> contextual_formation_integrity("line", line, xi=1.75, delta=0.5).item()
        0.75
    """
    if not 0 <= w <= 1:
        raise ValueError(f"w: got {w}, must be in [0, 1]")
    tau = formation_integrity(name, position, literal=literal)
    return w * gap_term(position, xi, delta, literal) + (1 - w) * tau


def jerk(position: Tensor, dt: float) -> Tensor:
    """Norm of the jerk ``|d^3 p / dt^3|`` as the third finite difference of the position.

    ``|p(t + 3) - 3 p(t + 2) + 3 p(t + 1) - p(t)| / dt^3``

    Args:
        position: ``[*B, T, n, 2]`` (m).
        dt: time between samples (s).

    Returns:
        ``[*B, T - 3, n]`` (m/s³), empty for fewer than four samples.

    Examples:
        >>> import torch
        >>> t = torch.arange(6.0)
        >>> jerk((t**3)[:, None, None] * torch.tensor([1.0, 0.0]), dt=1.0).squeeze(-1)
        tensor([6., 6., 6.])
    """
    samples, robots = position.shape[-3], position.shape[-2]
    if samples < 4:
        return position.new_zeros(*position.shape[:-3], 0, robots)
    return (position.diff(n=3, dim=-3) / dt**3).norm(dim=-1)
