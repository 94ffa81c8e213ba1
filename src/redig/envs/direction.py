"""The direction to the nearest obstacle as robots observe it: one that does not jump half way between two."""

from __future__ import annotations

import torch
from torch import Tensor

from redig.envs.map_batch import AnyMap


def smoothed_direction(obstacle_map: AnyMap, point: Tensor, reach: float) -> Tensor:
    """Minus the slope of the signed distance d by central differences, ``(d(p - h e_k) - d(p + h e_k)) / 2h``.

    The unit vector to the nearest obstacle turns around at once where another one becomes the nearest, as on the
    midline of a corridor, and a policy that sees it do so trembles there. This one is that unit vector where the same
    straight wall is the nearest within ``reach``, and passes through zero, in proportion, across a midline.

    Args:
        obstacle_map: with a signed distance.
        point: ``[*B, 2]`` (m).
        reach: h, how far to either side the differences reach (m).

    Returns:
        ``[*B, 2]``, of a length of at most 1, to which it is cut where differences around a corner make it longer.

    Raises:
        ValueError: if ``reach`` is not positive.

    Examples:
        >>> from redig.envs.maps import corridor
        >>> across = torch.tensor([[0.0, 0.0], [0.0, 0.025], [0.0, 0.25]])
        >>> smoothed_direction(corridor(1.1), across, reach=0.1)[:, 1].round(decimals=3)  # walls at -0.55 and 0.55 m
        tensor([0.0000, 0.2500, 1.0000])
    """
    if not reach > 0:
        raise ValueError(f"reach: got {reach}, must be greater than 0 m")
    along = reach * torch.eye(2, dtype=point.dtype, device=point.device).view(2, *[1] * (point.ndim - 1), 2)
    ahead, behind = obstacle_map.signed_distance(torch.stack([point + along, point - along]))  # each [2, *B]
    slope = (behind - ahead).movedim(0, -1) / (2 * reach)
    return slope / slope.norm(dim=-1, keepdim=True).clamp_min(1)


def observed_obstacle(obstacle_map: AnyMap, point: Tensor, smoothing: float = 0.0) -> tuple[Tensor, Tensor]:
    """What a robot at ``point`` ``[*B, 2]`` (m) observes of obstacles.

    Args:
        obstacle_map: with a signed distance.
        point: ``[*B, 2]`` (m).
        smoothing: reach of :func:`smoothed_direction` (m); 0: the unit vector.

    Returns:
        signed distance to the nearest ``[*B]`` (m), and the direction to it ``[*B, 2]``

    Examples:
        >>> from redig.envs.maps import corridor
        >>> distance, direction = observed_obstacle(corridor(1.1), torch.tensor([0.0, 0.05]), smoothing=0.1)
        >>> round(distance.item(), 3), round(direction[1].item(), 3)
        (0.5, 0.5)
    """
    if smoothing == 0:
        return obstacle_map.nearest(point)
    return obstacle_map.signed_distance(point), smoothed_direction(obstacle_map, point, smoothing)
