import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.envs.routes import check_route, pad_routes, route_heading, route_poses, turned_along


def random_route(seed, points=6):
    return torch.from_numpy(np.random.default_rng(seed).uniform(-3, 3, (points, 2)))


def nearest_segment(route, point):
    """By walking along the route in small steps."""
    best, heading = math.inf, None
    for a, b in pairwise(route):
        distance = np.linalg.norm(a + np.linspace(0, 1, 2001)[:, None] * (b - a) - point, axis=-1).min()
        if distance < best:
            best, heading = distance, (b - a) / np.hypot(*(b - a))
    return best, heading


@given(st.integers(0, 10_000))
@settings(max_examples=8, deadline=None)
def test_heading_is_that_of_the_nearest_segment(seed):
    route = random_route(seed)
    for point in np.random.default_rng(seed + 1).uniform(-4, 4, (3, 2)):
        found = route_heading(route, torch.from_numpy(point))
        distance, expected = nearest_segment(route.numpy(), point)
        if not np.allclose(found, expected):  # as near to another segment, then
            others = [
                nearest_segment(route[i : i + 2].numpy(), point)
                for i in range(5)
                if np.allclose(route[i + 1] - route[i], found * (route[i + 1] - route[i]).norm())
            ]
            assert min(other for other, _ in others) == pytest.approx(distance, abs=5e-3)


def test_a_route_for_each_point_is_as_each_alone():
    routes, points = torch.stack([random_route(i) for i in range(4)]), random_route(9, 4)
    together = route_heading(routes, points)
    for i in range(4):
        torch.testing.assert_close(together[i], route_heading(routes[i], points[i]))


def test_poses_are_the_ends():
    start, goal = route_poses(torch.tensor([[1.0, 2.0], [1.0, 3.0], [-1.0, 3.0], [-2.0, 2.0]]))
    torch.testing.assert_close(start, torch.tensor([1.0, 2.0, math.pi / 2]))
    torch.testing.assert_close(goal, torch.tensor([-2.0, 2.0, -3 * math.pi / 4]))


@given(st.floats(-3, 3), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_the_heading_turns_with_the_route_and_keeps_what_the_goal_adds(extra, seed):
    route = random_route(seed)
    points = random_route(seed + 1, 7)
    last = route_heading(route, route[-1] + 1e-9 * (route[-1] - route[-2]))
    angle = torch.atan2(*last.flip(-1)) + extra
    found = turned_along(route, points, torch.stack([angle.cos(), angle.sin()]).expand(7, 2))
    here = route_heading(route, points)
    expected = torch.atan2(here[:, 1], here[:, 0]) + extra
    torch.testing.assert_close(found, torch.stack([expected.cos(), expected.sin()], -1), atol=1e-6, rtol=0)


def test_padding_changes_no_heading():
    routes = [random_route(i, points) for i, points in enumerate((2, 5, 3))]
    padded, points = pad_routes(routes), random_route(9, 50)
    assert padded.shape == (3, 5, 2)
    for route, longer in zip(routes, padded, strict=True):
        torch.testing.assert_close(route_heading(longer, points), route_heading(route, points))
        torch.testing.assert_close(torch.stack(route_poses(longer)), torch.stack(route_poses(route)))


@pytest.mark.parametrize(
    ("route", "message"),
    [
        (torch.zeros(1, 2), r"route: got shape \[1, 2\], expected \[W, 2\]"),
        (torch.zeros(3, 3), r"route: got shape \[3, 3\]"),
        (torch.tensor([[0.0, 0.0], [math.nan, 0.0]]), "route: got a coordinate that is not finite"),
        (
            torch.tensor([[0.0, 0.0], [1.0, 2.0], [1.0, 2.0]]),
            r"route: successive points must differ, got twice \[1.0, 2",
        ),
    ],
)
def test_bad_routes_are_refused(route, message):
    with pytest.raises(ValueError, match=message):
        check_route(route)
