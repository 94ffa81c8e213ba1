"""When to be where: the fastest passage along given ways of all robots, within their limits, made smooth."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from redig.planning.curves import sample, smooth

FINE = 0.01  # s


def time_scaling(ways: Tensor, max_speed: float, max_acceleration: float, dt: float, ramp: float = 0.1) -> Tensor:
    """Positions at times ``0, dt, 2 dt, ...`` of robots that go along their ways together.

    Row s of ``ways`` is where all robots are at one and the same time; sought is s(t). Speed is limited by the fastest
    robot at each place, acceleration along the ways and across them, each by the most accelerated robot (a forward and
    a backward pass over the squared speed), and the mean over a window of time then limits the jerk to the acceleration
    divided by half of that window.

    Args:
        ways: ``[S, n, 2]`` (m), samples of the robots' ways; the team rests in the first and in the last.
        max_speed: of a robot (m/s).
        max_acceleration: of a robot (m/s²).
        dt: time step (s).
        ramp: half of the window of the smoothing (s).

    Returns:
        ``[T, n, 2]`` (m): the first row of ``ways`` at t = 0, the last at the end.

    Raises:
        ValueError: if ``ways`` has a wrong shape, or a limit is not positive.

    Examples:
        >>> import torch
        >>> way = torch.stack([torch.linspace(0, 4, 201), torch.zeros(201)], -1).unsqueeze(1)
        >>> position = time_scaling(way, max_speed=1.0, max_acceleration=1.0, dt=0.1)
        >>> speed = position.diff(dim=0).norm(dim=-1) / 0.1
        >>> round(speed.max().item(), 3), position[-1, 0, 0].item()
        (1.0, 4.0)
    """
    if ways.ndim != 3 or ways.shape[0] < 3 or ways.shape[-1] != 2:
        raise ValueError(f"ways: got shape {list(ways.shape)}, expected [S, n, 2] with S >= 3")
    for name, value in (("max_speed", max_speed), ("max_acceleration", max_acceleration), ("dt", dt)):
        if not value > 0:
            raise ValueError(f"{name}: got {value}, must be greater than 0")
    speed = _speeds(ways.double(), max_speed, max_acceleration)
    passing = torch.cat([speed.new_zeros(1), (2 / (speed[1:] + speed[:-1]).clamp_min(1e-6)).cumsum(0)])
    lead = math.ceil(ramp / FINE)
    total = passing[-1].item() + 2 * lead * FINE
    steps = math.ceil(total / dt)
    fine = torch.arange(round(steps * dt / FINE) + 1, dtype=speed.dtype) * FINE - lead * FINE
    fine = fine.clamp(0, passing[-1].item())
    piece = (torch.searchsorted(passing, fine) - 1).clamp(0, len(passing) - 2)
    share = (fine - passing[piece]) / (passing[piece + 1] - passing[piece])
    at = smooth(piece + _within(share, speed[piece], speed[piece + 1]), lead)
    at = at[:: round(dt / FINE)].clamp(0, len(ways) - 1)
    return sample(ways.double(), at).to(ways.dtype)


def _speeds(ways: Tensor, max_speed: float, max_acceleration: float) -> Tensor:
    """The highest speed (samples a second) ``[S]`` at each sample, at rest at both ends."""
    slope = torch.gradient(ways, dim=0)[0]
    bend = torch.gradient(slope, dim=0)[0].norm(dim=-1).amax(-1)
    slope = slope.norm(dim=-1).amax(-1).clamp_min(1e-9)
    limit = torch.minimum((max_speed / slope).square(), max_acceleration / bend.clamp_min(1e-9))
    square = limit.tolist()
    gain = (2 * max_acceleration / slope).tolist()
    square[0] = square[-1] = 0.0
    for i in range(1, len(square)):
        square[i] = min(square[i], square[i - 1] + gain[i - 1])
    for i in range(len(square) - 2, -1, -1):
        square[i] = min(square[i], square[i + 1] + gain[i + 1])
    return torch.tensor(square, dtype=ways.dtype).sqrt()


def _within(share: Tensor, enter: Tensor, leave: Tensor) -> Tensor:
    """Share of the way between two samples after a share of the time, at constant acceleration."""
    mean = (enter + leave) / 2
    return share * (enter + share * (leave - enter) / 2) / mean.clamp_min(1e-9)
