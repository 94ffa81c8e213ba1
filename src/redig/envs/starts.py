"""Where teams start and where they are to go: formations at both ends of their way, drawn at random around them."""

from __future__ import annotations

import torch
from torch import Tensor

from redig.envs.map_batch import AnyMap
from redig.envs.routes import route_poses


def start_and_goal(
    obstacle_map: AnyMap, angle: float, distance: float, num_envs: int, device: torch.device
) -> tuple[list[Tensor], tuple[float, float]]:
    """Poses of start and goal, and how far ahead of them the formations stand.

    Args:
        obstacle_map: whose route, if it has one, says all of it.
        angle: direction of travel through the origin, where there is no route (rad).
        distance: from the origin to start and goal, where there is no route (m).
        num_envs: number B of environments.
        device: of the poses.

    Returns:
        poses ``[B, 3]`` (m, m, rad) of start and goal, and two distances (m).

    Examples:
        >>> from redig.envs.maps import corridor
        >>> poses, ahead = start_and_goal(corridor(), 0.0, 2.75, num_envs=1, device=torch.device("cpu"))
        >>> poses[0], ahead
        (tensor([[0., 0., 0.]]), (-2.75, 2.75))
    """
    if obstacle_map.route is not None:
        return [pose.expand(num_envs, 3) for pose in route_poses(obstacle_map.route)], (0.0, 0.0)
    centre = torch.tensor([0.0, 0.0, angle], device=device).expand(num_envs, 3)
    return [centre, centre], (-distance, distance)


def draw_formation(
    pose: Tensor, ahead: float, offsets: Tensor, position_jitter: float, heading_jitter: float
) -> tuple[Tensor, Tensor]:
    """Formations ahead of poses, each moved and turned at random.

    Args:
        pose: ``[B, 3]`` (m, m, rad).
        ahead: from the pose to the formation's centre (m).
        offsets: the formation ``[n, 2]`` (m).
        position_jitter: half range of the shifts along and across (m).
        heading_jitter: half range of the turns (rad).

    Returns:
        headings, unit vectors ``[B, 2]``, and robots' places ``[B, n, 2]`` (m).

    Examples:
        >>> from redig.envs.formations import formation_offsets
        >>> heading, place = draw_formation(torch.zeros(1, 3), 2.0, formation_offsets("line", 3), 0.0, 0.0)
        >>> heading, place[0, 0]
        (tensor([[1., 0.]]), tensor([ 2., -1.]))
    """
    centre, heading = pose[:, :2], pose[:, 2:]
    axis = torch.cat([heading.cos(), heading.sin()], -1)
    along = ahead + position_jitter * (2 * torch.rand_like(heading) - 1)
    across = position_jitter * (2 * torch.rand_like(heading) - 1)
    centre = centre + along * axis + across * torch.stack([-axis[:, 1], axis[:, 0]], -1)
    heading = heading + heading_jitter * (2 * torch.rand_like(heading) - 1)
    cos, sin = heading.cos(), heading.sin()
    forward, left = offsets.unbind(-1)
    place = torch.stack([cos * forward - sin * left, sin * forward + cos * left], -1)
    return torch.cat([cos, sin], -1), centre.unsqueeze(1) + place


def check_places(start: Tensor, goal: Tensor, obstacle_map: AnyMap, radius: float, distance: float) -> None:
    """Check that no start or goal ``[B, n, 2]`` (m) lies inside a wall.

    Args:
        start: of all robots.
        goal: of all robots.
        obstacle_map: the walls.
        radius: of a robot (m).
        distance: which the error advises to change, where the map has no route (m).

    Raises:
        ValueError: naming the first that does.

    Examples:
        >>> from redig.envs.maps import corridor
        >>> inside, outside = torch.tensor([[[0.0, 1.0]]]), torch.tensor([[[2.0, 0.0]]])
        >>> check_places(outside, inside, corridor(), radius=0.1, distance=2.75)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        ValueError: start_distance: with 2.75 m the goal of robot 0 lies inside a wall, at [0.0, 1.0] m; choose ...
    """
    places = torch.stack([start, goal])
    inside = obstacle_map.signed_distance(places) < radius
    if inside.any():
        which, env, robot = inside.nonzero()[0].tolist()
        cause = f"start_distance: with {distance} m" if obstacle_map.route is None else "route: with it"
        at = [round(x, 2) for x in places[which, env, robot].tolist()]
        raise ValueError(
            f"{cause} the {('start', 'goal')[which]} of robot {robot} lies inside a wall, at {at} m; choose a "
            "larger distance or less jitter"
        )
