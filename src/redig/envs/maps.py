"""Obstacle maps as signed distance fields: one primitive, the rounded box, and any number of them.

A box with corner radius ``r`` covers rectangles (``r = 0``), round trunks (half size 0) and walls with soft corners, so
a new map is a new list of boxes and needs no new physics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from redig.envs.routes import check_route


@dataclass(frozen=True)
class ObstacleMap:
    """Obstacles as rounded boxes, with the signed distance to the nearest one.

    Args:
        obstacles: ``[M, 6]``: centre x, y (m), half length, half breadth (m), heading (rad), corner radius (m).
        gap: breadth of the narrowest passage (m), which the contextual formation integrity refers to.
        bounds: ``(x_min, y_min, x_max, y_max)`` (m) of the region that planners may use.
        route: the team's way ``[W, 2]`` (m), from the centre of its start formation to that of its goal formation,
            which head along the first and the last segment. ``None``: a straight way through the origin, which the
            scenario's ``start_distance`` and ``corridor_angle`` give.

    Raises:
        ValueError: if the obstacles do not have the shape ``[M, 6]``, or the route is not one.

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
    route: Tensor | None = None

    def __post_init__(self) -> None:
        if self.obstacles.ndim != 2 or self.obstacles.shape[0] == 0 or self.obstacles.shape[1] != 6:
            raise ValueError(f"obstacles: got shape {list(self.obstacles.shape)}, expected [M, 6] with M >= 1")
        if self.route is not None:
            check_route(self.route)

    def to(self, device: torch.device | str) -> ObstacleMap:
        """The same map on another device."""
        route = None if self.route is None else self.route.to(device)
        return replace(self, obstacles=self.obstacles.to(device), route=route)

    def nearest(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance to the nearest obstacle and the unit vector that points to it.

        Args:
            point: ``[*B, 2]`` (m).

        Returns:
            distance ``[*B]`` (m), negative inside an obstacle, and direction ``[*B, 2]``. Inside an obstacle the
            direction points away from the nearest way out of that obstacle.
        """
        return nearest_box(self.obstacles, point)

    def signed_distance(self, point: Tensor) -> Tensor:
        """Signed distance (m) from ``point`` ``[*B, 2]`` to the nearest obstacle: ``[*B]``."""
        return box_distances(self.obstacles, point)[2].amin(0)


def box_distances(obstacles: Tensor, point: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """In the frame of each rounded box the point and how far it exceeds the half sizes, and the signed distance.

    Boxes come first, so that the innermost loops run over many points and not over a few boxes.

    Args:
        obstacles: ``[M, *E, 6]``, see :class:`ObstacleMap`; ``E`` is empty, or broadcasts against ``B``.
        point: ``[*B, 2]`` (m).

    Returns:
        place ``[M, *B, 2]``, excess ``[M, *B, 2]`` and distance ``[M, *B]`` (m).

    Examples:
        >>> import torch
        >>> square = torch.tensor([[0.0, 0.0, 1.0, 1.0, 0.0, 0.0]])
        >>> box_distances(square, torch.tensor([[4.0, 5.0], [0.0, 0.0]]))[2]
        tensor([[ 5., -1.]])
    """
    centre_x, centre_y, half_x, half_y, heading, radius = _aligned(obstacles, point).unbind(-1)
    cos, sin = heading.cos(), heading.sin()
    x, y = point[..., 0] - centre_x, point[..., 1] - centre_y  # [M, *B]
    x, y = cos * x + sin * y, cos * y - sin * x
    excess_x, excess_y = x.abs() - half_x, y.abs() - half_y
    excess = torch.stack([excess_x, excess_y], -1)
    inside = torch.maximum(excess_x, excess_y).clamp_max(0)
    return torch.stack([x, y], -1), excess, excess.clamp_min(0).norm(dim=-1) + inside - radius


def nearest_box(obstacles: Tensor, point: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance ``[*B]`` (m) to the nearest rounded box and the unit vector to it, see ``ObstacleMap.nearest``.

    Args:
        obstacles: ``[M, *E, 6]``; ``E`` is empty, or broadcasts against ``B``.
        point: ``[*B, 2]`` (m).

    Examples:
        >>> import torch
        >>> square = torch.tensor([[0.0, 0.0, 1.0, 1.0, 0.0, 0.0]])
        >>> nearest_box(square, torch.tensor([3.0, 0.0]))
        (tensor(2.), tensor([-1., -0.]))
    """
    local, excess, distance = box_distances(obstacles, point)
    distance, closest = distance.min(0, keepdim=True)  # [1, *B]
    pick = closest.unsqueeze(-1).expand(*closest.shape, 2)
    local, excess = local.gather(0, pick).squeeze(0), excess.gather(0, pick).squeeze(0)
    outside = excess.clamp_min(0)
    norm = outside.norm(dim=-1, keepdim=True)
    along_x = excess[..., 0] >= excess[..., 1]
    inside_axis = torch.stack([along_x, ~along_x], -1).to(point.dtype)
    sign = torch.where(local < 0, -1.0, 1.0).to(point.dtype)
    x, y = (sign * torch.where(norm > 0, outside / norm.clamp_min(1e-9), inside_axis)).unbind(-1)
    heading, every = _aligned(obstacles, point)[..., 4], (len(obstacles), *closest.shape[1:])
    cos, sin = (value.expand(every).gather(0, closest).squeeze(0) for value in (heading.cos(), heading.sin()))
    return distance.squeeze(0), -torch.stack([cos * x - sin * y, sin * x + cos * y], -1)


def _aligned(obstacles: Tensor, point: Tensor) -> Tensor:
    """Obstacles ``[M, *E, 6]`` with dimensions of size one, so that each parameter broadcasts against ``[M, *B]``."""
    own = obstacles.shape[1:-1]
    return obstacles.view(len(obstacles), *[1] * (point.ndim - 1 - len(own)), *own, 6)


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
    check_positive(corridor_width=width, corridor_length=length, wall=wall)
    offset = (width + wall) / 2
    across = (-math.sin(angle) * offset, math.cos(angle) * offset)
    box = [length / 2, wall / 2, angle, 0.0]
    obstacles = torch.tensor([[*across, *box], [-across[0], -across[1], *box]])
    reach = length / 2 + wall
    return ObstacleMap(obstacles, gap=width, bounds=(-reach, -reach, reach, reach))


def check_positive(**sizes: float) -> None:
    """Check sizes (m) by their names.

    Raises:
        ValueError: naming the first that is not positive.

    Examples:
        >>> check_positive(gap=1.1, length=0.0)
        Traceback (most recent call last):
        ...
        ValueError: length: got 0.0, must be greater than 0 m
    """
    for name, value in sizes.items():
        if not value > 0:
            raise ValueError(f"{name}: got {value}, must be greater than 0 m")
