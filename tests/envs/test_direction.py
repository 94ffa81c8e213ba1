"""The observed direction to the nearest obstacle, against closed forms and the exact unit vector."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from redig.envs import MapBatch, ObstacleMap, make_env, named_map, smoothed_direction
from redig.envs.maps import corridor
from redig.envs.occupancy import OccupancyMap


@given(st.floats(-0.5, 0.5), st.floats(-0.3, 0.3), st.floats(0.02, 0.2), st.floats(-3, 3))
def test_across_a_corridor_it_is_the_slope_of_two_walls_whatever_the_heading(y, x, reach, angle):
    ahead, left = (torch.tensor(v) for v in ((math.cos(angle), math.sin(angle)), (-math.sin(angle), math.cos(angle))))
    found = smoothed_direction(corridor(1.1, 2.0, angle), x * ahead + y * left, reach)
    # d = 0.55 - |y|: a difference along each axis, of which y changes by the share of the axis that lies across
    slopes = [(abs(y + reach * share) - abs(y - reach * share)) / (2 * reach) for share in left.tolist()]
    expected = torch.tensor(slopes)
    torch.testing.assert_close(found, expected / expected.norm().clamp_min(1), atol=1e-4, rtol=0)


def test_away_from_midlines_and_corners_it_is_the_unit_vector():
    points = torch.tensor([[0.0, 0.3], [0.5, -0.2], [-2.5, 2.0]])
    torch.testing.assert_close(smoothed_direction(corridor(), points, 0.1), corridor().nearest(points)[1])
    trunk = ObstacleMap(torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.0, 0.5]]), gap=1.0, bounds=(-3, -3, 3, 3))
    around = 2 * torch.stack([torch.linspace(0, 6, 30).cos(), torch.linspace(0, 6, 30).sin()], -1)
    torch.testing.assert_close(smoothed_direction(trunk, around, 0.1), trunk.nearest(around)[1], atol=2e-3, rtol=0)


@pytest.mark.parametrize("kind", ["corridor", "forest", "doorway", "bollards"])
def test_it_changes_no_faster_than_the_reach_allows(kind):
    obstacles, reach = named_map(f"{kind}:train", 4), 0.1
    way = torch.linspace(-2.5, 2.5, 1001)
    for line in (torch.stack([way, 0.1 + 0 * way], -1), torch.stack([0.3 + 0 * way, way], -1)):
        points = line.unsqueeze(1).expand(-1, 5, -1).unsqueeze(1).expand(-1, 4, -1, -1)
        change = smoothed_direction(obstacles, points, reach).diff(dim=0).abs()
        # of two distances a step changes each by no more than its length, and cutting at most doubles what it does
        assert change.max() <= 2 * 0.005 / reach + 1e-3


def test_the_unit_vector_jumps_where_it_does_not():
    either_side = torch.tensor([[0.0, -1e-4], [0.0, 1e-4]])
    assert corridor().nearest(either_side)[1].diff(dim=0).abs().max() == 2
    assert smoothed_direction(corridor(), either_side, 0.1).abs().max() < 2e-3


def test_every_kind_of_map_has_one():
    places = torch.tensor([[[0.0, 0.05]], [[0.0, 0.05]]])
    batch = MapBatch((corridor(1.1), corridor(0.9)))
    torch.testing.assert_close(smoothed_direction(batch, places, 0.1), torch.tensor([[[0.0, 0.5]], [[0.0, 0.5]]]))
    cells = torch.zeros(11, 60, dtype=torch.bool)
    grid = OccupancyMap(cells, 0.1, (-3.0, -0.55, 0.0), gap=1.1)  # walls beyond the grid, at -0.55 and 0.55 m
    found = smoothed_direction(grid, torch.tensor([[0.0, -0.2], [0.0, 0.0], [0.0, 0.2]]), 0.1)
    torch.testing.assert_close(found, torch.tensor([[0.0, -1.0], [0.0, 0.0], [0.0, 1.0]]), atol=1e-4, rtol=0)


def test_teams_observe_it_if_asked_to():
    plain, smooth = (make_env(2, seed=0, direction_smoothing=width) for width in (0.0, 0.1))
    for env in (plain, smooth):
        for agent in env.scenario.world.agents:
            agent.set_pos(torch.tensor([0.0, 0.02]), batch_index=None)
        env.scenario._quantities = None
    seen = [env.scenario.quantities["observation"][..., 7:] for env in (plain, smooth)]
    torch.testing.assert_close(seen[0], torch.tensor([0.0, 1.0]).expand(2, 5, 2))
    torch.testing.assert_close(seen[1], torch.tensor([0.0, 0.2]).expand(2, 5, 2))


@pytest.mark.parametrize("width", [-0.1, float("nan")])
def test_a_negative_width_is_refused(width):
    with pytest.raises(ValueError, match=f"direction_smoothing: got {width}"):
        make_env(2, direction_smoothing=width)
    with pytest.raises(ValueError, match=f"reach: got {width}"):
        smoothed_direction(corridor(), torch.zeros(2), width)
