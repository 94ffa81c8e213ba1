from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.envs import corridor
from redig.planning import OccupancyGrid, astar, occupancy_grid, rrt


def points_on(path: torch.Tensor) -> list:
    share = torch.linspace(0, 1, 300).unsqueeze(-1)
    return torch.cat([a + share * (b - a) for a, b in pairwise(path)]).tolist()


@given(seed=st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_path_keeps_to_free_cells_and_is_not_shorter_than_the_straight_line(seed):
    grid = occupancy_grid(corridor(1.1))
    start, goal = torch.tensor([-3.1, 1.05]), torch.tensor([2.9, -0.95])
    path = rrt(grid, start, goal, seed=seed)
    assert torch.equal(path[0], start) and torch.equal(path[-1], goal)
    assert all(grid.is_free(point) for point in points_on(path))
    assert path.diff(dim=0).norm(dim=-1).sum() >= (goal - start).norm()


@given(seed=st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_no_path_where_astar_finds_none(seed):
    generator = torch.Generator().manual_seed(seed)
    occupied = torch.rand(6, 6, generator=generator) < 0.35
    occupied[0, 0] = occupied[5, 5] = False
    grid = OccupancyGrid(occupied, 1.0, (0.0, 0.0))
    try:
        astar(grid, (0.5, 0.5), (5.5, 5.5))
    except ValueError:
        with pytest.raises(RuntimeError, match="max_iterations=200"):
            rrt(grid, (0.5, 0.5), (5.5, 5.5), seed=seed, max_iterations=200)
    else:
        path = rrt(grid, (0.5, 0.5), (5.5, 5.5), seed=seed, max_iterations=20_000)
        assert all(grid.is_free(point) for point in points_on(path))


def test_the_seed_decides_the_path():
    grid = occupancy_grid(corridor(1.1))
    paths = [rrt(grid, (-3.0, 1.0), (3.0, -1.0), seed=seed) for seed in (0, 0, 1)]
    assert torch.equal(paths[0], paths[1])
    assert paths[0].shape != paths[2].shape or not torch.equal(paths[0], paths[2])


def test_too_few_iterations_and_a_point_outside_are_named():
    grid = occupancy_grid(corridor(1.1))
    with pytest.raises(RuntimeError, match=r"goal: .* was not reached .* max_iterations=1"):
        rrt(grid, (-3.0, 1.0), (3.0, 1.0), max_iterations=1)
    with pytest.raises(ValueError, match=r"start: got \(-9.0, 1.0\) m, outside the bounds"):
        rrt(grid, (-9.0, 1.0), (3.0, 1.0))
