"""Curves given by samples at equal distances: values between the samples, smoothing, continuation beyond the ends."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def sample(values: Tensor, at: Tensor) -> Tensor:
    """Linear interpolation of ``values`` ``[S, *F]``, and beyond the ends the straight continuation of the end pieces.

    Args:
        values: ``[S, *F]``, S >= 2, samples at 0, 1, ..., S - 1.
        at: ``[*N]``, where to interpolate, in numbers of samples.

    Returns:
        ``[*N, *F]``.

    Examples:
        >>> import torch
        >>> sample(torch.tensor([0.0, 1.0, 4.0]), torch.tensor([-1.0, 0.5, 1.5, 3.0]))
        tensor([-1.0000,  0.5000,  2.5000,  7.0000])
    """
    below = at.floor().long().clamp(0, len(values) - 2)
    share = (at - below).reshape(*at.shape, *[1] * (values.ndim - 1))
    return values[below] + share * (values[below + 1] - values[below])


def smooth(values: Tensor, half_window: int) -> Tensor:
    """Weighted mean over ``half_window`` samples to either side (Hann window); the ends and straight pieces stay.

    Beyond its ends the curve is continued by its own point reflection, which is why the ends do not move.

    Args:
        values: ``[S, *F]``.
        half_window: in samples; shortened to ``S - 1`` for short curves.

    Returns:
        ``[S, *F]``.

    Raises:
        ValueError: if ``half_window`` is negative.

    Examples:
        >>> import torch
        >>> smooth(torch.tensor([0.0, 1.0, 2.0, 2.0, 2.0]), 2)
        tensor([0.0000, 1.0000, 1.7500, 2.0000, 2.0000])
    """
    if half_window < 0:
        raise ValueError(f"half_window: got {half_window}, must not be negative")
    width = min(half_window, len(values) - 1)
    if width == 0:
        return values.clone()
    before = 2 * values[:1] - values[1 : width + 1].flip(0)
    after = 2 * values[-1:] - values[-width - 1 : -1].flip(0)
    padded = torch.cat([before, values, after]).reshape(len(values) + 2 * width, -1)
    offset = torch.arange(-width + 1, width, dtype=values.dtype, device=values.device)
    weight = 1 + (math.pi * offset / width).cos()
    rows = padded.T.unsqueeze(1)  # [F, 1, S + 2 width]
    smoothed = torch.nn.functional.conv1d(rows, (weight / weight.sum()).view(1, 1, -1)).squeeze(1).T
    return smoothed[1:-1].reshape(values.shape)


def resample(points: Tensor, spacing: float) -> Tensor:
    """A polyline ``[W, 2]`` (m) as samples ``[S, 2]`` at equal distances of about ``spacing`` (m) along it, ends kept.

    Examples:
        >>> import torch
        >>> resample(torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), 0.5)[:, 1]
        tensor([0.0000, 0.0000, 0.0000, 0.5000, 1.0000])
    """
    length = points.diff(dim=0).norm(dim=-1)
    way = torch.cat([length.new_zeros(1), length.cumsum(0)])
    count = max(2, round(way[-1].item() / spacing) + 1)
    at = torch.linspace(0, 1, count, dtype=points.dtype, device=points.device) * way[-1]
    piece = (torch.searchsorted(way, at) - 1).clamp(0, len(length) - 1)
    share = ((at - way[piece]) / length[piece].clamp_min(1e-12)).unsqueeze(-1)
    return points[piece] + share * (points[piece + 1] - points[piece])
