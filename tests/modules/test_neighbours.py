import math

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from redig.modules import radius_adjacency, radius_edges

seeds = st.integers(0, 2**31)
coarse = st.integers(-6, 6).map(lambda x: x / 2)  # many robots at one place, and pairs exactly at the radius


def double_loop(teams, radius):
    """All pairs (neighbour, robot) of teams ``[B, n, 2]``, robots numbered through all teams."""
    pairs = set()
    for b, team in enumerate(teams.tolist()):
        for i, own in enumerate(team):
            for j, other in enumerate(team):
                if i != j and math.dist(own, other) <= radius:
                    pairs.add((b * len(team) + j, b * len(team) + i))
    return pairs


def as_set(edge_index):
    """The edges as pairs, each there once."""
    pairs = list(zip(*edge_index.tolist(), strict=True))
    assert len(pairs) == len(set(pairs))
    return set(pairs)


def as_edges(adjacency):
    """The edges of a matrix ``[*B, n, n]``."""
    n = adjacency.shape[-1]
    team, robot, other = adjacency.reshape(-1, n, n).nonzero().T
    return as_set(torch.stack([team * n + other, team * n + robot]))


def random_teams(batch, n, seed, spread=2.0, dtype=torch.float64):
    return spread * torch.randn(*batch, n, 2, dtype=dtype, generator=torch.Generator().manual_seed(seed))


@settings(deadline=None)
@given(n=st.integers(1, 8), seed=seeds, radius=st.floats(0.1, 5))
def test_adjacency_equals_a_double_loop(n, seed, radius):
    position = random_teams((1,), n, seed)
    assert as_edges(radius_adjacency(position, radius)) == double_loop(position, radius)


@settings(deadline=None)
@given(batch=st.integers(1, 3), n=st.integers(1, 30), seed=seeds, radius=st.floats(0.1, 5), spread=st.floats(0.1, 50))
def test_edges_equal_a_double_loop(batch, n, seed, radius, spread):
    position = random_teams((batch,), n, seed, spread)
    assert as_set(radius_edges(position, radius)) == double_loop(position, radius)


@settings(deadline=None)
@given(
    team=st.lists(st.tuples(coarse, coarse), min_size=1, max_size=12),
    radius=st.sampled_from([0.5, 1.0, 1.5, 2.0, 2.5]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    centre=st.sampled_from([0.0, 500.5, -4096.0]),
)
@example(team=[(0.0, 0.0)] * 4, radius=1.0, dtype=torch.float32, centre=0.0)
def test_robots_on_a_grid(team, radius, dtype, centre):
    """Coordinates that all types hold exactly: which of the pairs at the radius itself count is no matter of digits."""
    position = torch.tensor([team, team], dtype=dtype) + centre
    expected = double_loop(position, radius)
    assert as_set(radius_edges(position, radius)) == expected
    assert as_edges(radius_adjacency(position, radius)) == expected


@settings(deadline=None)
@given(
    n=st.integers(2, 20),
    seed=seeds,
    scale=st.sampled_from([1e-3, 1.0, 30.0, 1e4, 1e7, 1e30]),
    centre=st.sampled_from([0.0, 0.1, 1e3, 1e6, -1e8]),
)
def test_edges_are_those_of_the_adjacency_to_the_last_bit(n, seed, scale, centre):
    """Float32 far from the origin, and robots far apart: the radius is a distance that occurs, or just missed."""
    position = random_teams((2,), n, seed, scale, torch.float32) + centre
    position[:, 1] = position[:, 0] + 1.0
    exact = (position[0, -1] - position[0, 0]).square().sum().sqrt().item()
    for radius in (exact, exact * (1 - 1e-7), 1.0, 2.0):
        if 0 < radius < math.inf:
            assert as_set(radius_edges(position, radius)) == as_edges(radius_adjacency(position, radius))


@pytest.mark.parametrize("neighbours", [1, 4, 40])
def test_edges_of_a_large_team_equal_a_tree_search(neighbours):
    side = math.sqrt(2000 * math.pi * 2.0**2 / neighbours)
    position = side * torch.rand(2000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    pairs = KDTree(position.numpy()).query_pairs(2.0)
    assert as_set(radius_edges(position, 2.0)) == pairs | {(j, i) for i, j in pairs}


@pytest.mark.parametrize("odd", [math.nan, math.inf, -math.inf, 1e38, -1e20])
def test_a_lost_robot_hears_nobody_and_breaks_nothing(odd):
    position = random_teams((2,), 6, 0, dtype=torch.float32)
    expected = {pair for pair in double_loop(position, 2.0) if 3 not in pair}
    position[0, 3, 1] = odd
    assert as_set(radius_edges(position, 2.0)) == expected
    assert as_edges(radius_adjacency(position, 2.0)) == expected


def test_rounding_at_the_edge_of_a_cell():
    """The difference of 2 and -1e-9 is 2 in float32, though they are more than a radius apart."""
    position = torch.tensor([[-1e-9, 0.0], [0.0, 0.0], [2.0, 0.0]])
    assert as_set(radius_edges(position, 2.0)) == as_edges(radius_adjacency(position, 2.0))
    assert as_set(radius_edges(position.flip(-1), 2.0)) == as_edges(radius_adjacency(position.flip(-1), 2.0))


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (-1.0, 1.0)])
@pytest.mark.parametrize("distance", [4095, 4096, 8191, 8192, 8193, 16384, 8193 * 8193])
def test_robots_far_from_their_team_stay_in_it(direction, distance):
    """Where team 0 has its outlier, team 1 has robots; cells are numbered through all teams."""
    place = distance * 1.01 * torch.tensor(direction, dtype=torch.float64)
    teams = torch.stack([torch.stack([0 * place, 0 * place, place]), torch.stack([2 * place, 2 * place, place])])
    for position in (teams, teams.flip(0)):
        assert as_set(radius_edges(position, 1.0)) == {(0, 1), (1, 0), (3, 4), (4, 3)}


def test_order_and_type_of_the_edges():
    edge_index = radius_edges(random_teams((3, 2), 9, 0), 2.0)
    assert edge_index.dtype == torch.int64
    assert (edge_index[1].diff() >= 0).all()
    assert torch.equal(edge_index[0] // 9, edge_index[1] // 9)  # never across teams
    assert not radius_edges(random_teams((), 4, 0).requires_grad_(), 2.0).requires_grad


@pytest.mark.parametrize("shape", [(1, 2), (4, 1, 2), (0, 5, 2), (3, 0, 2), (2, 0, 5, 2)])
def test_nobody_to_hear(shape):
    assert radius_edges(torch.zeros(shape), 2.0).shape == (2, 0)
    assert radius_adjacency(torch.zeros(shape), 2.0).sum() == 0


def test_radius_without_end():
    assert radius_edges(random_teams((), 5, 0), math.inf).shape == (2, 20)


def test_adjacency_includes_the_radius_itself():
    position = torch.tensor([[0.0, 0.0], [2.0, 0.0], [4.5, 0.0]])
    assert radius_adjacency(position, 2.0).tolist() == [[False, True, False], [True, False, False], [False] * 3]


@pytest.mark.parametrize("n", [5, 40])
def test_neighbours_do_not_depend_on_where_the_team_is(n):
    line = torch.stack([torch.arange(n) * 1.0, torch.zeros(n)], -1)
    expected = (torch.arange(n)[:, None] - torch.arange(n)).abs()  # 2 m reaches the second neighbour, 1.99 m the first
    for centre in (0.0, 500.3):
        for radius, reached in ((1.99, expected == 1), (2.01, (expected == 1) | (expected == 2))):
            assert torch.equal(radius_adjacency(line + centre, radius), reached)
            assert as_set(radius_edges(line + centre, radius)) == as_edges(reached)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_positions_in_half_precision(dtype):
    position = torch.tensor([[0.0, 0.0], [1.0, 0.0], [3.5, 0.0]], dtype=dtype)
    assert torch.equal(radius_adjacency(position, 2.0), radius_adjacency(position.float(), 2.0))
    assert torch.equal(radius_edges(position, 2.0), radius_edges(position.float(), 2.0))


@pytest.mark.parametrize("search", [radius_adjacency, radius_edges])
def test_rank_of_positions(search):
    with pytest.raises(ValueError, match=r"position: got shape \[2\], expected \[\*B, n, 2\]"):
        search(torch.zeros(2), 1.0)
