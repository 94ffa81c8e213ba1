"""Which of the formation rewards a team gets, by name."""

from __future__ import annotations

from torch import Tensor

from redig.envs import rewards
from redig.envs.formations import pairwise_distances

FORMATION_REWARDS = ("spring_damper", "spring_damper_bonus", "scaled", "slanted", "integrity", "none")


def formation_reward(
    kind: str,
    formation: str,
    position: Tensor,
    velocity: Tensor,
    offsets: Tensor,
    direction: Tensor,
    omega: float = 0.5,
    tolerance: float = 0.5,
) -> Tensor:
    """The formation reward of each robot, of one of the kinds in :mod:`redig.envs.rewards`.

    Args:
        kind: ``spring_damper`` (Eq. 29), ``spring_damper_bonus``, ``scaled``, ``slanted``, ``integrity`` or ``none``.
        formation: its name, see :func:`~redig.envs.formations.formation_offsets`.
        position: ``[B, n, 2]`` (m).
        velocity: ``[B, n, 2]`` (m/s).
        offsets: the formation ``[n, 2]`` (m).
        direction: unit vector of travel ``[B, 2]``.
        omega: balance of spring and damper.
        tolerance: how far from its place (m) the bonus of a robot is gone, of ``scaled`` and ``slanted``.

    Returns:
        ``[B, n]``; the same for every robot where the reward is the team's.

    Raises:
        ValueError: for an unknown kind.

    Examples:
        >>> import torch
        >>> from redig.envs.formations import formation_offsets
        >>> wedge = formation_offsets("wedge", 5)
        >>> team = wedge.unsqueeze(0), torch.zeros(1, 5, 2), wedge, torch.tensor([[1.0, 0.0]])
        >>> formation_reward("integrity", "wedge", *team)
        tensor([[1., 1., 1., 1., 1.]])
    """
    if kind == "scaled":
        return rewards.scaled_formation_bonus(position, offsets, direction, tolerance)
    if kind == "slanted":
        return rewards.slanted_formation_bonus(position, offsets, direction, tolerance)
    if kind == "integrity":
        team = rewards.integrity_bonus(formation, position, offsets, direction)
        return team.unsqueeze(-1).expand(-1, len(offsets))
    if kind == "spring_damper_bonus":
        return rewards.spring_damper_bonus(position, velocity, pairwise_distances(offsets), omega)
    if kind == "spring_damper":
        team = rewards.spring_damper(position, velocity, pairwise_distances(offsets), omega)
        return team.unsqueeze(-1).expand(-1, len(offsets))
    if kind == "none":
        return position.new_zeros(position.shape[:2])
    raise ValueError(f"formation_reward: got {kind!r}, allowed are {', '.join(FORMATION_REWARDS)}")
