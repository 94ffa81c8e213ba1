"""Path tracking: velocity commands that lead each robot along its own path at its own speed."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def pad_paths(paths: Sequence[Tensor]) -> Tensor:
    """Paths of ``[W_i, 2]`` (m) as one tensor ``[N, max W_i, 2]``; the last way point is repeated.

    Examples:
        >>> import torch
        >>> pad_paths([torch.zeros(2, 2), torch.ones(3, 2)])[0]
        tensor([[0., 0.],
                [0., 0.],
                [0., 0.]])
    """
    longest = max(len(path) for path in paths)
    return torch.stack([torch.cat([path, path[-1:].expand(longest - len(path), 2)]) for path in paths])


class PathTracker:
    """Pure pursuit: steer to the point that lies ``lookahead`` further along the path than the robot.

    Robots keep their own speed and do not know of each other. Near its goal a robot slows down no more than it must to
    stop there: ``min(speed, sqrt(2 * 0.75 a r), r / (2 dt))`` with ``r`` metres left and ``a`` the acceleration limit.

    Args:
        paths: way points ``[*B, W, 2]`` (m), ``W >= 2``, padded with the last one, see :func:`pad_paths`.
        speed: ``[*B]`` (m/s).
        max_acceleration: of a robot (m/s²).
        dt: time step (s).
        lookahead: distance along the path (m).

    Raises:
        ValueError: if the shapes do not fit together.

    Examples:
        >>> import torch
        >>> tracker = PathTracker(torch.tensor([[[0.0, 0.0], [4.0, 0.0]]]), torch.tensor([0.5]))
        >>> tracker(torch.tensor([[1.0, 0.0]]))
        tensor([[0.5000, 0.0000]])
    """

    def __init__(
        self,
        paths: Tensor,
        speed: Tensor,
        max_acceleration: float = 2.0,
        dt: float = 0.1,
        lookahead: float = 0.3,
    ) -> None:
        if paths.ndim < 3 or paths.shape[-2] < 2 or paths.shape[-1] != 2:
            raise ValueError(f"paths: got shape {list(paths.shape)}, expected [*B, W, 2] with W >= 2")
        if speed.shape != paths.shape[:-2]:
            raise ValueError(f"speed: got shape {list(speed.shape)}, expected {list(paths.shape[:-2])}")
        self.paths, self.speed = paths, speed
        self.braking, self.dt, self.lookahead = 0.75 * max_acceleration, dt, lookahead
        self.segments = paths.diff(dim=-2)  # [*B, W - 1, 2]
        self.lengths = self.segments.norm(dim=-1)
        self.travelled = torch.nn.functional.pad(self.lengths.cumsum(-1), (1, 0))  # way to each way point [*B, W]

    def __call__(self, position: Tensor) -> Tensor:
        """Velocity commands ``[*B, 2]`` (m/s) for robots at ``position`` ``[*B, 2]`` (m)."""
        along = self._progress(position)
        total = self.travelled[..., -1:]
        to_target = self._point_at((along + self.lookahead).minimum(total)) - position
        to_goal = (self.paths[..., -1, :] - position).norm(dim=-1)
        left = (total - along).squeeze(-1).maximum(to_goal)
        speed = self.speed.minimum((2 * self.braking * left).sqrt()).minimum(left / (2 * self.dt))
        return to_target / to_target.norm(dim=-1, keepdim=True).clamp_min(1e-9) * speed.unsqueeze(-1)

    def _progress(self, position: Tensor) -> Tensor:
        """Distance along the path ``[*B, 1]`` (m) of its point nearest to the robot."""
        offset = position.unsqueeze(-2) - self.paths[..., :-1, :]
        fraction = (offset * self.segments).sum(-1) / self.lengths.square().clamp_min(1e-12)
        fraction = fraction.clamp(0, 1)
        gap = (offset - fraction.unsqueeze(-1) * self.segments).norm(dim=-1)
        nearest = gap.argmin(-1, keepdim=True)
        return (self.travelled[..., :-1] + fraction * self.lengths).gather(-1, nearest)

    def _point_at(self, along: Tensor) -> Tensor:
        """The point ``[*B, 2]`` (m) of each path at a distance ``[*B, 1]`` (m) along it."""
        segment = (torch.searchsorted(self.travelled, along) - 1).clamp_min(0)
        pick = segment.unsqueeze(-1).expand(*segment.shape, 2)
        fraction = (along - self.travelled.gather(-1, segment)) / self.lengths.gather(-1, segment).clamp_min(1e-12)
        point = self.paths.gather(-2, pick) + fraction.unsqueeze(-1) * self.segments.gather(-2, pick)
        return point.squeeze(-2)


def pad_references(references: Sequence[Tensor]) -> Tensor:
    """Positions over time ``[T_i, n, 2]`` (m) as one tensor ``[N, max T_i, n, 2]``; the last position is repeated.

    Examples:
        >>> import torch
        >>> pad_references([torch.zeros(2, 5, 2), torch.zeros(3, 5, 2)]).shape
        torch.Size([2, 3, 5, 2])
    """
    longest = max(len(reference) for reference in references)
    return torch.stack([torch.cat([r, r[-1:].expand(longest - len(r), -1, -1)]) for r in references])


class ReferenceTracker:
    """Follow positions planned over time: the planned velocity, plus a share of what is missing to the position.

    Args:
        references: planned positions of B teams ``[B, T, n, 2]`` (m) at times 0, ``dt``, ...
        dt: time step (s).
        gain: velocity for each metre of error (1/s).

    Raises:
        ValueError: if the shape is not ``[B, T, n, 2]``.

    Examples:
        >>> import torch
        >>> tracker = ReferenceTracker(torch.tensor([0.0, 0.1, 0.2])[None, :, None, None].expand(1, 3, 1, 2), dt=0.1)
        >>> tracker(torch.tensor([[[0.0, 0.1]]]), step=torch.tensor([0]))
        tensor([[[1.0000, 0.7000]]])
    """

    def __init__(self, references: Tensor, dt: float = 0.1, gain: float = 3.0) -> None:
        if references.ndim != 4 or references.shape[-1] != 2:
            raise ValueError(f"references: got shape {list(references.shape)}, expected [B, T, n, 2]")
        self.references, self.dt, self.gain = references, dt, gain

    def __call__(self, position: Tensor, step: Tensor) -> Tensor:
        """Velocity commands ``[B, n, 2]`` (m/s) for robots at ``position`` ``[B, n, 2]`` (m) at ``step`` ``[B]``."""
        team, last = torch.arange(len(position), device=position.device), self.references.shape[1] - 1
        now = self.references[team, step.clamp(0, last)]
        following = self.references[team, (step + 1).clamp(0, last)]
        return (following - now) / self.dt + self.gain * (now - position)
