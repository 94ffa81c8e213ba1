"""Formations: where each robot stands in the team's own frame, and how whole the shape is (tau of the CFI).

A formation is described in the frame of travel: the first coordinate points forward, the second to the left, both in
metres from the team's centroid. Robots are numbered so that the definition of tau needs no search: the wedge has its
apex first, then alternating left and right; the line runs from right to left; the circle runs counter-clockwise.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

FORMATIONS = ("wedge", "line", "circle")


def formation_offsets(name: str, n: int, width: float = 2.0) -> Tensor:
    """Positions of the robots of a formation, relative to their centroid.

    Args:
        name: one of ``"wedge"``, ``"line"`` (abreast) and ``"circle"``.
        n: number of robots, at least 2 (3 for a wedge or a circle).
        width: extent across the direction of travel (m); for the circle, its diameter. A wedge of an even number lacks
            the last robot on the right.

    Returns:
        offsets ``[n, 2]`` (m), forward and left.

    Raises:
        ValueError: if the name is unknown, ``n`` too small or ``width`` not positive.

    Examples:
        >>> from redig.envs.formations import formation_offsets
        >>> formation_offsets("line", 3)[:, 1]
        tensor([-1.,  0.,  1.])
    """
    if name not in FORMATIONS:
        raise ValueError(f"formation: got {name!r}, allowed are {', '.join(FORMATIONS)}")
    smallest = 2 if name == "line" else 3
    if n < smallest:
        raise ValueError(f"n_robots: got {n}, a {name} formation needs at least {smallest} robots")
    if not width > 0:
        raise ValueError(f"formation_width: got {width}, must be greater than 0 m")
    if name == "line":
        left = torch.linspace(-width / 2, width / 2, n)
        offsets = torch.stack([torch.zeros(n), left], -1)
    elif name == "wedge":
        rank = (torch.arange(n) + 1) // 2
        side = torch.where(torch.arange(n) % 2 == 1, 1.0, -1.0)
        step = width / 2 / (n // 2)
        offsets = torch.stack([-rank * step, side * rank * step], -1)
    else:
        angle = 2 * math.pi * torch.arange(n) / n
        offsets = width / 2 * torch.stack([angle.cos(), angle.sin()], -1)
    return offsets - offsets.mean(0)


def pairwise_distances(position: Tensor) -> Tensor:
    """Distances between robots: ``[*B, n, 2]`` (m) to ``[*B, n, n]`` (m); p_ij of Eq. 29, and d_ij when given offsets.

    Examples:
        >>> import torch
        >>> pairwise_distances(torch.tensor([[0.0, 0.0], [3.0, 4.0]]))[0, 1].item()
        5.0
    """
    return (position.unsqueeze(-2) - position.unsqueeze(-3)).norm(dim=-1)


def formation_integrity(name: str, position: Tensor, literal: bool = False) -> Tensor:
    """Tau of the contextual formation integrity (Appendix F.5): how well the team keeps its shape, in [0, 1].

    It measures proportions, not size, so a wedge or line that is squeezed evenly keeps it. The printed formulas for
    circle and line are wrong (``docs/paper.md``); the corrected ones are the default, ``literal=True`` gives those.

    Args:
        name: formation name, see :func:`formation_offsets`.
        position: ``[*B, n, 2]`` (m), robots in the order of :func:`formation_offsets`.
        literal: the formula as printed, clamped to [0, 1].

    Returns:
        tau ``[*B]``; 1 for a perfect shape.

    Raises:
        ValueError: if the name is unknown or there are too few robots.

    Examples:
        >>> formation_integrity("wedge", formation_offsets("wedge", 5)).item()
        1.0
    """
    n = position.shape[-2]
    formation_offsets(name, n)  # validates the name and n
    if name == "circle":
        tau = _circle_integrity(position, literal)
    elif name == "wedge":
        tau = _wedge_integrity(position)
    else:
        tau = _line_integrity(position, literal)
    return tau.clamp(0, 1)


def _circle_integrity(position: Tensor, literal: bool) -> Tensor:
    n = position.shape[-2]
    before, after = position.roll(1, -2) - position, position.roll(-1, -2) - position
    cross = after[..., 0] * before[..., 1] - after[..., 1] * before[..., 0]
    angle = torch.atan2(cross, (before * after).sum(-1)) % (2 * math.pi)  # interior angle, reflex ones included
    interior = math.pi * (n - 2) / n
    deviation = angle / interior if literal else (angle - interior).abs() / interior
    return 1 - deviation.mean(-1)


def _wedge_integrity(position: Tensor) -> Tensor:
    """1 - 2|L_l - L_r|/(L_l + L_r) - mean_k |L_k m/k - L_b|/L_b over inner pairs k < m (the paper's middle side)."""
    n = position.shape[-2]
    apex, left, right = position[..., :1, :], position[..., 1::2, :], position[..., 2::2, :]
    m = (n - 1) // 2  # complete pairs; with an even n the last robot on the left has no partner
    left_length = (left[..., -1, :] - apex[..., 0, :]).norm(dim=-1) / left.shape[-2]
    right_length = (right[..., -1, :] - apex[..., 0, :]).norm(dim=-1) / right.shape[-2]
    tau = 1 - 2 * (left_length - right_length).abs() / (left_length + right_length).clamp_min(1e-6)
    across = (left[..., :m, :] - right).norm(dim=-1)  # [*B, m]
    if m > 1:
        rank = torch.arange(1, m, device=position.device)
        base = across[..., -1:].clamp_min(1e-6)
        tau = tau - ((across[..., :-1] * m / rank - base).abs() / base).mean(-1)
    return tau


def _line_integrity(position: Tensor, literal: bool) -> Tensor:
    """Relative deviation of the gaps from L/(n-1), and of the robots from the straight line through the two ends."""
    n = position.shape[-2]
    ends = position[..., -1, :] - position[..., 0, :]
    length = ends.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    gaps = (position[..., 1:, :] - position[..., :-1, :]).norm(dim=-1)
    if literal:
        return 1 - (gaps / length).mean(-1)
    ideal = length / (n - 1)
    relative = position - position[..., :1, :]
    off_line = (relative[..., 0] * ends[..., 1:] - relative[..., 1] * ends[..., :1]).abs() / length
    return 1 - ((gaps - ideal).abs() / ideal).mean(-1) - (off_line / length).mean(-1)
