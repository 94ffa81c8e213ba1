import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import lil_matrix
from scipy.sparse.csgraph import dijkstra

from redig.envs import ObstacleMap, corridor
from redig.planning import OccupancyGrid, astar, occupancy_grid
from redig.planning.astar import shortest_cells


def eight_connected_graph(occupied: torch.Tensor) -> lil_matrix:
    """Costs between free cells ``row * width + column``; a diagonal needs both cells beside it free."""
    height, width = occupied.shape
    graph = lil_matrix((height * width, height * width))

    def free(r, c):
        return 0 <= r < height and 0 <= c < width and not occupied[r, c]

    for r in range(height):
        for c in range(width):
            for dr in (-1, 0, 1):
                for dc in (-1, 0, 1):
                    if (dr or dc) and free(r, c) and free(r + dr, c + dc) and free(r, c + dc) and free(r + dr, c):
                        graph[r * width + c, (r + dr) * width + c + dc] = math.hypot(dr, dc)
    return graph


def length(path: torch.Tensor) -> float:
    return path.diff(dim=0).norm(dim=-1).sum().item()


def points_on(path: torch.Tensor, pieces: int = 400) -> list:
    share = torch.linspace(0, 1, pieces).unsqueeze(-1)
    return torch.cat([a + share * (b - a) for a, b in pairwise(path)]).tolist()


@given(seed=st.integers(0, 10**6), density=st.floats(0, 0.5))
@settings(max_examples=40, deadline=None)
def test_length_equals_dijkstra(seed, density):
    generator = torch.Generator().manual_seed(seed)
    occupied = torch.rand(8, 10, generator=generator) < density
    occupied[2, 3] = False
    grid = OccupancyGrid(occupied, 1.0, (0.0, 0.0))
    expected = dijkstra(eight_connected_graph(occupied), indices=2 * 10 + 3)
    for r, c in (~occupied).nonzero().tolist():
        cells, found = shortest_cells(grid, grid.cell((3.5, 2.5)), grid.cell((c + 0.5, r + 0.5)))
        assert found == pytest.approx(expected[r * 10 + c])
        assert bool(cells) == math.isfinite(expected[r * 10 + c])
        centres = [grid.centre(cell) for cell in cells]
        assert sum(map(math.dist, centres, centres[1:])) == pytest.approx(found if cells else 0)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=40, deadline=None)
def test_path_keeps_to_free_cells_and_is_no_longer_than_the_grid_path(seed):
    generator = torch.Generator().manual_seed(seed)
    trunks = torch.zeros(8, 6)
    trunks[:, :2] = 4 * torch.rand(8, 2, generator=generator) - 2
    trunks[:, 5] = 0.1 + 0.4 * torch.rand(8, generator=generator)
    forest = ObstacleMap(trunks, gap=0.5, bounds=(-3.0, -3.0, 3.0, 3.0))
    grid = occupancy_grid(forest, resolution=0.1, inflation=0.25)
    start, goal = (-2.83, -2.6), (2.77, 2.91)
    path = astar(grid, start, goal)
    assert torch.allclose(path[0], torch.tensor(start)) and torch.allclose(path[-1], torch.tensor(goal))
    assert all(grid.is_free(point) for point in points_on(path))
    assert forest.signed_distance(torch.tensor(points_on(path))).min() >= 0.25 - 0.1 / math.sqrt(2) - 1e-4
    straight = math.dist(start, goal)
    on_grid = 0.1 * shortest_cells(grid, grid.cell(start), grid.cell(goal))[1]
    assert straight - 1e-4 <= length(path) <= on_grid + 2 * 0.1  # the ends lie off their cells' centres


def test_path_through_the_corridor_is_pulled_tight():
    path = astar(occupancy_grid(corridor(1.1)), (-3.0, 1.0), (3.0, 1.0))
    assert len(path) <= 5
    assert length(path) < 6.4  # along the wall it is about 6.25 m; the staircase is longer
    assert path[:, 1].min() > 0.2  # it bends no further than it must


def test_start_and_goal_near_a_wall_are_connected_to_the_nearest_free_cell():
    grid = occupancy_grid(corridor(1.1))
    start, goal = (-1.12, 1.5), (1.12, 1.5)  # 0.12 m from the wall
    path = astar(grid, start, goal)
    assert path[0].tolist() == pytest.approx(start) and path[-1].tolist() == pytest.approx(goal)
    assert all(grid.is_free(point) for point in points_on(path[1:-1]))
    assert (path[1] - path[0]).norm() < 0.25


def test_unreachable_goal_is_named():
    occupied = torch.zeros(5, 9, dtype=torch.bool)
    occupied[:, 4] = True
    with pytest.raises(ValueError, match=r"goal: \(8.5, 2.5\) m cannot be reached from start \(0.5, 2.5\) m"):
        astar(OccupancyGrid(occupied, 1.0, (0.0, 0.0)), (0.5, 2.5), (8.5, 2.5))


@pytest.mark.parametrize("name", ["start", "goal"])
def test_a_point_outside_is_named(name):
    ends = {"start": (0.0, 0.0), "goal": (1.0, 0.0), name: (9.0, 0.0)}
    with pytest.raises(ValueError, match=rf"{name}: got \(9.0, 0.0\) m, outside the bounds"):
        astar(occupancy_grid(corridor()), **ends)


def test_a_grid_without_a_free_cell_is_refused():
    full = OccupancyGrid(torch.ones(4, 4, dtype=torch.bool), 1.0, (0.0, 0.0))
    with pytest.raises(ValueError, match="every cell of the grid is occupied"):
        astar(full, (0.5, 0.5), (3.5, 3.5))
