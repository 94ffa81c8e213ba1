import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from redig.deploy.proximity import LaserScan, OccupancyGrid, to_robot, to_world
from redig.envs.direction import smoothed_direction
from redig.envs.maps import ObstacleMap, corridor

grids = arrays(bool, st.tuples(st.integers(1, 6), st.integers(1, 6))).filter(lambda cells: not cells.all())
angles = st.floats(-math.pi, math.pi)


def assert_near(found, distance, direction):
    np.testing.assert_allclose([found.distance, *found.direction], [distance, *direction], atol=1e-9)


def cell_by_cell(cells, resolution, x, y):
    """Signed distance in the frame of the grid: all cells, and a wide border of occupied ones."""
    border, best = 10, {True: math.inf, False: math.inf}
    cells = np.pad(cells, border, constant_values=True)
    own = None
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            left, low = (column - border) * resolution, (row - border) * resolution
            dx = max(left - x, 0.0, x - left - resolution)
            dy = max(low - y, 0.0, y - low - resolution)
            kind = bool(cells[row, column])
            best[kind] = min(best[kind], math.hypot(dx, dy))
            if left <= x < left + resolution and low <= y < low + resolution:
                own = kind
    return -best[False] if own else best[True]


@given(grids, st.sampled_from([0.05, 1.0, 2.5]), st.floats(-3, 9), st.floats(-3, 9), angles, angles)
def test_distance_is_that_of_a_search_through_all_cells(cells, resolution, x, y, yaw, heading):
    grid = OccupancyGrid(cells, resolution, (3.0, -2.0, yaw))
    x, y = x * resolution, y * resolution
    dx, dy = to_world((x, y), yaw)
    place = 3.0 + dx, -2.0 + dy
    distance, direction = grid.nearest(place)
    assert distance == pytest.approx(cell_by_cell(cells, resolution, x, y), abs=1e-9)
    assert math.hypot(*direction) == pytest.approx(1.0)
    assert abs(distance) < 1e-6 or not own_kind_within(grid, place, distance, direction)
    seen = grid.nearest_from(place, heading)
    assert seen.distance == distance
    np.testing.assert_allclose(to_world(seen.direction, heading), direction, atol=1e-12)


def own_kind_within(grid, place, distance, direction):
    """Whether a step a little beyond the distance, along the direction, is still in a cell of the same kind."""
    beyond = distance + math.copysign(1e-7, distance)
    after = grid.nearest((place[0] + beyond * direction[0], place[1] + beyond * direction[1])).distance
    return after * distance > 0 and abs(after) > 1e-6


def test_outside_the_grid_all_is_occupied():
    grid = OccupancyGrid(np.zeros((10, 20), bool), 0.1, (-1.0, -0.5, 0.0))
    assert_near(grid.nearest((0.0, 0.25)), 0.25, (0.0, 1.0))
    assert_near(grid.nearest((1.5, 0.0)), -0.5, (1.0, 0.0))
    assert grid.nearest((50.0, 0.0)).distance == pytest.approx(-49.0)


def test_a_map_of_boxes_drawn_into_cells_gives_the_same_as_the_map():
    """The obstacle maps of training, whose boxes here end where cells do."""
    boxes = torch.tensor([[1.0, 1.5, 0.5, 1.0, 0.0, 0.0], [3.0, 3.0, 0.25, 0.75, 0.0, 0.0]], dtype=torch.float64)
    centres = 0.025 + 0.05 * torch.arange(100, dtype=torch.float64)
    y, x = torch.meshgrid(centres, centres, indexing="ij")
    obstacles = ObstacleMap(boxes, gap=1.0, bounds=(0, 0, 5, 5))
    grid = OccupancyGrid((obstacles.signed_distance(torch.stack([x, y], -1)) < 0).numpy(), 0.05)
    places = 1.2 + 2.4 * np.random.default_rng(0).random((200, 2))  # nearer to a box than to the border
    checked = 0
    for place in places:
        expected, direction = obstacles.nearest(torch.from_numpy(place))
        if abs(expected) > min(*place, *(5 - place)) or expected < -0.2:
            continue
        found = grid.nearest(tuple(place))
        assert found.distance == pytest.approx(expected.item(), abs=1e-9)
        if abs(expected) > 1e-6 and expected > 0:
            gaps = [ObstacleMap(box[None], 1.0, (0, 0, 5, 5)).signed_distance(torch.from_numpy(place)) for box in boxes]
            if abs(gaps[0] - gaps[1]) > 1e-6:  # else there are two nearest obstacles
                np.testing.assert_allclose(found.direction, direction.numpy(), atol=1e-9)
        checked += 1
    assert checked > 100


def test_the_smoothed_direction_is_that_of_training():
    y, x = torch.meshgrid(-2.975 + 0.05 * torch.arange(120), -2.975 + 0.05 * torch.arange(120), indexing="ij")
    walls = corridor(1.1, 2.0)
    grid = OccupancyGrid((walls.signed_distance(torch.stack([x, y], -1)) < 0).numpy(), 0.05, (-3.0, -3.0, 0.0))
    for place in ((0.0, 0.0), (0.3, 0.03), (-0.2, -0.07), (0.4, 0.3)):
        found = grid.nearest(place, smoothing=0.1)
        assert found.distance == grid.nearest(place).distance
        expected = smoothed_direction(walls, torch.tensor(place), 0.1)
        np.testing.assert_allclose(found.direction, expected.numpy(), atol=1e-6)
    heading = 0.5
    turned = grid.nearest_from((0.3, 0.03), heading, smoothing=0.1)
    np.testing.assert_allclose(to_world(turned.direction, heading), grid.nearest((0.3, 0.03), 0.1).direction)


def test_a_scan_between_two_walls_gives_the_smoothed_direction():
    beams = np.radians(np.arange(-180.0, 180.0, 0.25))
    for y in (-0.2, -0.05, 0.0, 0.02):  # of the robot, walls at -0.5 and 0.5 m
        with np.errstate(divide="ignore"):
            ranges = np.where(beams > 0, 0.5 - y, 0.5 + y) / np.abs(np.sin(beams))
        scan = LaserScan(-math.pi, math.radians(0.25), 0.05, 5.0, ranges)
        distance, direction = scan.nearest(smoothing=0.1)
        assert distance == pytest.approx(0.5 - abs(y), abs=1e-3)
        np.testing.assert_allclose(direction, (0.0, np.clip(y / 0.1, -1, 1)), atol=2e-3)


def test_grids_that_are_none():
    cells = np.zeros((3, 3), bool)
    for bad in (cells[0], cells.astype(int), np.ones((3, 3), bool)):
        with pytest.raises(ValueError, match="occupied: got"):
            OccupancyGrid(bad, 0.1)
    for resolution in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="resolution: got"):
            OccupancyGrid(cells, resolution)
    for origin in ((0.0, 0.0), (0.0, math.nan, 0.0)):
        with pytest.raises(ValueError, match="origin: got"):
            OccupancyGrid(cells, 0.1, origin)


@given(angles, angles)
def test_turning_there_and_back(angle, heading):
    vector = math.cos(angle), math.sin(angle)
    np.testing.assert_allclose(to_robot(to_world(vector, heading), heading), vector, atol=1e-12)
    turned = to_world(vector, heading)
    assert math.remainder(math.atan2(turned[1], turned[0]) - angle - heading, 2 * math.pi) == pytest.approx(0, abs=1e-9)


readings = st.one_of(st.floats(0.0, 12.0), st.sampled_from([math.nan, math.inf, -math.inf, 0.1, 8.0]))


@given(st.lists(readings, min_size=1, max_size=20), angles, angles, st.floats(-0.2, 0.2))
def test_scan_is_that_of_a_loop_over_its_beams(ranges, angle_min, yaw, x):
    scan = LaserScan(angle_min, 0.1, 0.1, 8.0, ranges, (x, 0.05, yaw))
    best, towards = math.inf, (0.0, 0.0)
    for i, reading in enumerate(ranges):
        if reading == -math.inf:
            reading = 0.1
        if math.isnan(reading) or reading < 0.1 or reading > 8.0:
            continue
        angle = yaw + angle_min + 0.1 * i
        point = x + reading * math.cos(angle), 0.05 + reading * math.sin(angle)
        if math.hypot(*point) < best:
            best, towards = math.hypot(*point), point
    found = scan.nearest()
    if best == math.inf:
        assert found == (8.0, (0.0, 0.0))
    else:
        assert found.distance == pytest.approx(best)
        np.testing.assert_allclose(np.multiply(found.distance, found.direction), towards, atol=1e-9)


def test_teammates_in_a_scan_are_ignored():
    scan = LaserScan(-math.pi / 2, math.pi / 2, 0.1, 8.0, [2.0, 0.7, 3.0])
    assert_near(scan.nearest(ignore=[(0.8, 0.0)], ignore_radius=0.15), 2.0, (0.0, -1.0))
    assert scan.nearest(ignore=[(0.8, 0.0)], ignore_radius=0.05).distance == pytest.approx(0.7)
    assert scan.nearest(ignore=[(0.0, 0.0)], ignore_radius=9.0) == (8.0, (0.0, 0.0))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"ranges": []}, "ranges: got shape"),
        ({"ranges": [[1.0]]}, "ranges: got shape"),
        ({"angle_min": math.nan}, "angle_min: got nan"),
        ({"range_max": math.inf}, "range_max: got inf"),
        ({"range_min": 9.0}, "range_min: got 9.0, must be from 0 to range_max"),
        ({"mount": (0.0, 0.0)}, "mount: got"),
    ],
)
def test_scans_that_are_none(change, message):
    fields = {"angle_min": 0.0, "angle_increment": 0.1, "range_min": 0.1, "range_max": 8.0, "ranges": [1.0]}
    with pytest.raises(ValueError, match=message):
        LaserScan(**fields | change)
