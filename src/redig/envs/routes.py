"""Routes: the way of a team through a map as a polyline, and its heading at any place."""

from __future__ import annotations

import torch
from torch import Tensor


def check_route(route: Tensor) -> None:
    """Raise unless ``route`` is a polyline ``[W, 2]`` (m) of at least two points, no two successive ones equal.

    Raises:
        ValueError: if it is not.

    Examples:
        >>> check_route(torch.tensor([[0.0, 0.0], [0.0, 0.0]]))
        Traceback (most recent call last):
        ...
        ValueError: route: successive points must differ, got twice [0.0, 0.0] m
    """
    if route.ndim != 2 or route.shape[0] < 2 or route.shape[1] != 2:
        raise ValueError(f"route: got shape {list(route.shape)}, expected [W, 2] with W >= 2")
    if not route.isfinite().all():
        raise ValueError("route: got a coordinate that is not finite")
    still = (route.diff(dim=0) == 0).all(-1)
    if still.any():
        raise ValueError(f"route: successive points must differ, got twice {route[:-1][still][0].tolist()} m")


def route_poses(route: Tensor) -> tuple[Tensor, Tensor]:
    """Pose at the start and at the goal: x, y (m) and heading (rad) of the first and of the last segment.

    Args:
        route: ``[*E, W, 2]`` (m).

    Returns:
        start ``[*E, 3]`` and goal ``[*E, 3]``.

    Examples:
        >>> start, goal = route_poses(torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0]]))
        >>> start, goal
        (tensor([0., 0., 0.]), tensor([2.0000, 3.0000, 1.5708]))
    """
    x, y = route.diff(dim=-2).unbind(-1)
    heading = torch.atan2(y, x)  # [*E, W - 1]
    return (
        torch.cat([route[..., 0, :], heading[..., :1]], -1),
        torch.cat([route[..., -1, :], heading[..., -1:]], -1),
    )


def route_heading(route: Tensor, point: Tensor) -> Tensor:
    """Unit vector along the segment of a route that is nearest to a point.

    Args:
        route: ``[*E, W, 2]`` (m); ``E`` is empty or equal to ``B``.
        point: ``[*B, 2]`` (m).

    Returns:
        ``[*B, 2]``.

    Examples:
        >>> corner = torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0]])
        >>> route_heading(corner, torch.tensor([[0.5, 0.3], [1.9, 1.0]]))
        tensor([[1., 0.],
                [0., 1.]])
    """
    segments = route.diff(dim=-2)  # [*E, W - 1, 2]
    squared = segments.square().sum(-1)
    offset = point.unsqueeze(-2) - route[..., :-1, :]  # [*B, W - 1, 2]
    share = ((offset * segments).sum(-1) / squared).clamp(0, 1)
    nearest = (offset - share.unsqueeze(-1) * segments).square().sum(-1).argmin(-1)
    unit = (segments / squared.sqrt().unsqueeze(-1)).expand(*nearest.shape, *segments.shape[-2:])
    pick = nearest[..., None, None].expand(*nearest.shape, 1, 2)
    return unit.gather(-2, pick).squeeze(-2)


def turned_along(route: Tensor, point: Tensor, at_goal: Tensor) -> Tensor:
    """The heading at a point if it is ``at_goal`` at the end of the route: turned back as the route turns until there.

    Args:
        route: ``[*E, W, 2]`` (m); ``E`` is empty or equal to ``B``.
        point: ``[*B, 2]`` (m).
        at_goal: unit vector ``[*B, 2]``.

    Returns:
        unit vector ``[*B, 2]``.

    Examples:
        >>> corner = torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0]])  # a quarter turn to the left
        >>> turned_along(corner, torch.tensor([0.5, 0.0]), at_goal=torch.tensor([0.0, 1.0]))
        tensor([1., 0.])
    """
    here = route_heading(route, point)
    last = route[..., -1, :] - route[..., -2, :]
    last = last / last.norm(dim=-1, keepdim=True)
    cos = (last * here).sum(-1)
    sin = last[..., 0] * here[..., 1] - last[..., 1] * here[..., 0]
    x, y = at_goal.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], -1)


def pad_routes(routes: list[Tensor]) -> Tensor:
    """Routes of ``[W_i, 2]`` (m) as one tensor ``[N, max W_i, 2]``: the last segment is cut into equal pieces.

    Examples:
        >>> pad_routes([torch.tensor([[0.0, 0.0], [2.0, 0.0]]), torch.zeros(3, 2)])[0]
        tensor([[0., 0.],
                [1., 0.],
                [2., 0.]])
    """
    longest = max(len(route) for route in routes)
    padded = []
    for route in routes:
        share = torch.linspace(0, 1, longest - len(route) + 2, dtype=route.dtype, device=route.device).unsqueeze(-1)
        padded.append(torch.cat([route[:-2], torch.lerp(route[-2], route[-1], share)]))
    return torch.stack(padded)
