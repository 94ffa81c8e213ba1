"""Obstacle maps as signed distance fields: one primitive, the rounded box, and any number of them.

A box with corner radius ``r`` covers rectangles (``r = 0``), round trunks (half size 0) and walls with soft corners, so
a new map is a new list of boxes and needs no new physics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class ObstacleMap:
    """Obstacles as rounded boxes, with the signed distance to the nearest one.

    Args:
        obstacles: ``[M, 6]``: centre x, y (m), half length, half breadth (m), heading (rad), corner radius (m).
        gap: breadth of the narrowest passage (m), which the contextual formation integrity refers to.
        bounds: ``(x_min, y_min, x_max, y_max)`` (m) of the region that planners may use.

    Raises:
        ValueError: if the obstacles do not have the shape ``[M, 6]``.

    Examples:
        >>> import torch
        >>> trunk = ObstacleMap(torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.0, 0.5]]), gap=1.0, bounds=(-2, -2, 2, 2))
        >>> distance, direction = trunk.nearest(torch.tensor([2.0, 0.0]))
        >>> round(distance.item(), 4), direction[0].item()
        (1.5, -1.0)
    """

    obstacles: Tensor
    gap: float
    bounds: tuple[float, float, float, float]

    def __post_init__(self) -> None:
        if self.obstacles.ndim != 2 or self.obstacles.shape[0] == 0 or self.obstacles.shape[1] != 6:
            raise ValueError(f"obstacles: got shape {list(self.obstacles.shape)}, expected [M, 6] with M >= 1")

    def to(self, device: torch.device | str) -> ObstacleMap:
        """The same map on another device."""
        return ObstacleMap(self.obstacles.to(device), self.gap, self.bounds)

    def nearest(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance to the nearest obstacle and the unit vector that points to it.

        Args:
            point: ``[*B, 2]`` (m).

        Returns:
            distance ``[*B]`` (m), negative inside an obstacle, and direction ``[*B, 2]``. Inside an obstacle the
            direction points away from the nearest way out of that obstacle.
        """
        local, excess, distance = self._boxes(point)
        distance, closest = distance.min(0, keepdim=True)  # [1, *B]
        pick = closest.unsqueeze(-1).expand(*closest.shape, 2)
        local, excess = local.gather(0, pick).squeeze(0), excess.gather(0, pick).squeeze(0)
        outside = excess.clamp_min(0)
        norm = outside.norm(dim=-1, keepdim=True)
        along_x = excess[..., 0] >= excess[..., 1]
        inside_axis = torch.stack([along_x, ~along_x], -1).to(point.dtype)
        sign = torch.where(local < 0, -1.0, 1.0).to(point.dtype)
        x, y = (sign * torch.where(norm > 0, outside / norm.clamp_min(1e-9), inside_axis)).unbind(-1)
        heading = self.obstacles[:, 4]
        cos, sin = heading.cos()[closest.squeeze(0)], heading.sin()[closest.squeeze(0)]
        return distance.squeeze(0), -torch.stack([cos * x - sin * y, sin * x + cos * y], -1)

    def signed_distance(self, point: Tensor) -> Tensor:
        """Signed distance (m) from ``point`` ``[*B, 2]`` to the nearest obstacle: ``[*B]``."""
        return self._boxes(point)[2].amin(0)

    def _boxes(self, point: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """In the frame of each box the point and how far it exceeds the half sizes, ``[M, *B, 2]``; its distance.

        Boxes come first, so that the innermost loops run over many points and not over a few boxes.
        """
        shape = (-1, *[1] * (point.ndim - 1))
        centre_x, centre_y, half_x, half_y, heading, radius = (o.view(shape) for o in self.obstacles.unbind(-1))
        cos, sin = heading.cos(), heading.sin()
        x, y = point[..., 0] - centre_x, point[..., 1] - centre_y  # [M, *B]
        x, y = cos * x + sin * y, cos * y - sin * x
        excess_x, excess_y = x.abs() - half_x, y.abs() - half_y
        excess = torch.stack([excess_x, excess_y], -1)
        inside = torch.maximum(excess_x, excess_y).clamp_max(0)
        return torch.stack([x, y], -1), excess, excess.clamp_min(0).norm(dim=-1) + inside - radius


def corridor(width: float = 1.1, length: float = 2.0, angle: float = 0.0, wall: float = 3.0) -> ObstacleMap:
    """A straight corridor through a wall, centred on the origin.

    Args:
        width: breadth of the corridor (m).
        length: length of the corridor, which is the thickness of the wall (m).
        angle: direction of the corridor (rad); 0 is along x.
        wall: how far the wall reaches to either side of the corridor (m).

    Raises:
        ValueError: if a size is not positive.

    Examples:
        >>> import torch
        >>> round(corridor(width=1.1).signed_distance(torch.zeros(2)).item(), 4)
        0.55
    """
    for name, value in (("corridor_width", width), ("corridor_length", length), ("wall", wall)):
        if not value > 0:
            raise ValueError(f"{name}: got {value}, must be greater than 0 m")
    offset = (width + wall) / 2
    across = (-math.sin(angle) * offset, math.cos(angle) * offset)
    box = [length / 2, wall / 2, angle, 0.0]
    obstacles = torch.tensor([[*across, *box], [-across[0], -across[1], *box]])
    reach = length / 2 + wall
    return ObstacleMap(obstacles, gap=width, bounds=(-reach, -reach, reach, reach))
