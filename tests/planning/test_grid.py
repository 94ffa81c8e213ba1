import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.envs import ObstacleMap, corridor
from redig.planning import OccupancyGrid, occupancy_grid
from redig.planning.grid import shortcut


def random_grid(seed: int, density: float = 0.3, height: int = 9, width: int = 12) -> OccupancyGrid:
    generator = torch.Generator().manual_seed(seed)
    return OccupancyGrid(torch.rand(height, width, generator=generator) < density, 0.5, (-1.0, 2.0))


def test_cells_near_a_trunk_are_occupied():
    trunk = ObstacleMap(torch.tensor([[0.3, -0.2, 0.0, 0.0, 0.0, 0.5]]), gap=1.0, bounds=(-2.0, -1.5, 2.0, 1.5))
    grid = occupancy_grid(trunk, resolution=0.1, inflation=0.25)
    assert grid.occupied.shape == (30, 40)
    for row in range(30):
        for column in range(40):
            x, y = -2 + (column + 0.5) * 0.1, -1.5 + (row + 0.5) * 0.1
            distance = math.hypot(x - 0.3, y + 0.2) - 0.5
            if abs(distance - 0.25) > 1e-5:
                assert grid.occupied[row, column] == (distance < 0.25)


def test_free_space_of_the_corridor_is_connected_through_its_middle():
    grid = occupancy_grid(corridor(width=1.1, length=2.0))
    for x in torch.linspace(-3.7, 3.7, 50).tolist():
        assert grid.is_free((x, 0.0))
    assert not grid.is_free((0.0, 0.55 - 0.2))
    assert not grid.is_free((-1.1, 2.0))  # in front of the wall, but closer than the inflation
    assert grid.is_free((-3.7, 1.1)) and grid.is_free((3.7, -1.1))


@given(seed=st.integers(0, 10**6))
@settings(max_examples=50, deadline=None)
def test_cell_and_centre_are_inverse_and_free_agrees_with_the_matrix(seed):
    grid = random_grid(seed)
    for row in range(9):
        for column in range(12):
            centre = (-1.0 + (column + 0.5) * 0.5, 2.0 + (row + 0.5) * 0.5)
            assert grid.centre(grid.cell(centre)) == pytest.approx(centre)
            assert grid.is_free(centre) == (not grid.occupied[row, column].item())
    assert not grid.is_free((-1.01, 3.0))
    assert not grid.is_free((5.01, 3.0))
    assert not grid.is_free((0.0, 1.99))
    assert not grid.is_free((0.0, 6.51))


@given(seed=st.integers(0, 10**6), x=st.floats(-0.99, 4.99), y=st.floats(2.01, 6.49))
@settings(max_examples=50, deadline=None)
def test_nearest_free_cell_equals_a_search_over_all_cells(seed, x, y):
    grid = random_grid(seed, density=0.7)
    free = [(-1.0 + (c + 0.5) * 0.5, 2.0 + (r + 0.5) * 0.5) for r, c in (~grid.occupied).nonzero().tolist()]
    best = min(math.dist(point, (x, y)) for point in free)
    found = grid.centre(grid.nearest_free("start", (x, y)))
    if grid.is_free((x, y)):
        assert max(abs(found[0] - x), abs(found[1] - y)) <= 0.25 + 1e-9
    else:
        assert math.dist(found, (x, y)) == pytest.approx(best, abs=1e-6)


def crosses_cell(start, end, low, high) -> bool:
    """Slab test: whether a segment meets an axis-aligned square."""
    enter, leave = 0.0, 1.0
    for a, b, lo, hi in zip(start, end, low, high, strict=True):
        if a == b:
            if not lo <= a <= hi:
                return False
            continue
        first, second = sorted(((lo - a) / (b - a), (hi - a) / (b - a)))
        enter, leave = max(enter, first), min(leave, second)
    return enter <= leave


@given(seed=st.integers(0, 10**6))
@settings(max_examples=100, deadline=None)
def test_line_of_sight_equals_the_slab_test_against_every_occupied_cell(seed):
    grid = random_grid(seed, density=0.1)
    generator = torch.Generator().manual_seed(seed + 1)
    corner, size = torch.tensor([-1.0, 2.0]), torch.tensor([6.0, 4.5])
    for _ in range(10):
        start, end = (corner + size * (0.01 + 0.98 * torch.rand(2, 2, generator=generator))).tolist()
        hit = any(
            crosses_cell(start, end, (-1 + 0.5 * c, 2 + 0.5 * r), (-0.5 + 0.5 * c, 2.5 + 0.5 * r))
            for r, c in grid.occupied.nonzero().tolist()
        )
        assert grid.line_of_sight(start, end) == (not hit)
        assert grid.line_of_sight(end, start) == (not hit)


def test_line_of_sight_along_an_axis_and_across_a_corner():
    occupied = torch.zeros(3, 3, dtype=torch.bool)
    occupied[0, 1] = True
    grid = OccupancyGrid(occupied, 1.0, (0.0, 0.0))
    assert grid.line_of_sight((0.5, 0.2), (0.5, 2.8))
    assert not grid.line_of_sight((1.5, 0.2), (1.5, 2.8))
    assert not grid.line_of_sight((0.5, 0.5), (1.5, 1.5))  # touches the occupied cell's corner
    assert not grid.line_of_sight((1.0, 0.1), (1.0, 0.9))  # along its edge


def test_shortcut_keeps_what_turns_around_an_obstacle():
    occupied = torch.zeros(3, 3, dtype=torch.bool)
    occupied[1, 1] = True
    grid = OccupancyGrid(occupied, 1.0, (0.0, 0.0))
    around = [(0.5, 0.5), (1.5, 0.5), (2.5, 0.5), (2.5, 1.5), (2.5, 2.5)]
    assert shortcut(grid, around) == [(0.5, 0.5), (2.5, 0.5), (2.5, 2.5)]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: OccupancyGrid(torch.zeros(3, 3), 0.1, (0.0, 0.0)), "occupied: got torch.float32"),
        (lambda: OccupancyGrid(torch.zeros(3, dtype=torch.bool), 0.1, (0.0, 0.0)), "occupied: got"),
        (lambda: OccupancyGrid(torch.zeros(3, 3, dtype=torch.bool), 0.0, (0.0, 0.0)), "resolution: got 0.0"),
        (lambda: occupancy_grid(corridor(), resolution=-0.1), "resolution: got -0.1"),
        (lambda: occupancy_grid(corridor(), inflation=-0.1), "inflation: got -0.1"),
    ],
)
def test_bad_arguments_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
