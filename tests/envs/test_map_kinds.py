"""The gap of each map against what a disc of that breadth can really reach."""

import math
from itertools import combinations, pairwise

import pytest
import torch
from scipy import ndimage

from redig.envs import bollards, curve, doorway, forest, narrowing, passages

CLOSED = [
    narrowing(),
    narrowing(gap=0.5, entrance=3.0, length=2.0),
    passages(),
    passages(gap=1.3, count=1, shift=0.0),
    passages(gap=0.6, count=2, spacing=1.0, shift=0.7),
    curve(),
    curve(gap=0.7, radius=2.5, turn=-0.8),
    curve(gap=1.4, radius=2.0, turn=2.5),
    doorway(),
    doorway(gap=0.5, thickness=0.4, hallway=4.4, offset=-0.5),
]


def connected(obstacle_map, clearance, step=0.025):
    """Whether a disc of a radius (m) gets from start to goal within the bounds, by flooding a fine grid."""
    x_min, y_min, x_max, y_max = obstacle_map.bounds
    x, y = torch.arange(x_min, x_max, step), torch.arange(y_min, y_max, step)
    points = torch.stack(torch.meshgrid(x, y, indexing="ij"), -1)
    labels, _ = ndimage.label((obstacle_map.signed_distance(points) >= clearance).numpy())
    ends = ((obstacle_map.route[[0, -1]] - torch.tensor([x_min, y_min])) / step).round().long()
    start, goal = (labels[i, j] for i, j in ends.tolist())
    assert start and goal
    return start == goal


@pytest.mark.parametrize("obstacle_map", CLOSED)
def test_the_gap_is_the_narrowest_place_and_there_is_no_way_around(obstacle_map):
    assert connected(obstacle_map, obstacle_map.gap / 2 - 0.03)
    assert not connected(obstacle_map, obstacle_map.gap / 2 + 0.01)


@pytest.mark.parametrize("obstacle_map", [*CLOSED, bollards(), bollards(gap=0.5, radius=0.6)])
def test_the_route_keeps_to_the_middle_of_the_passage(obstacle_map):
    share = torch.linspace(0, 1, 500).unsqueeze(-1)
    way = torch.cat([torch.lerp(a, b, share) for a, b in pairwise(obstacle_map.route)])
    nearest = obstacle_map.signed_distance(way).min().item()
    assert nearest <= obstacle_map.gap / 2 + 1e-4
    if len(obstacle_map.route) > 2 and obstacle_map.obstacles[:, 4].eq(0).all():
        assert nearest > 0.15  # between passages that do not face each other the way cuts the corners
    else:
        assert nearest == pytest.approx(obstacle_map.gap / 2, abs=5e-3)


def test_a_curve_turns_as_told_and_begins_and_ends_on_the_axis():
    for turn in (1.2, -0.7):
        route = curve(radius=3.0, turn=turn, approach=2.0).route
        first, last = route[1] - route[0], route[-1] - route[-2]
        bend = torch.atan2(first[0] * last[1] - first[1] * last[0], first @ last)
        assert bend.item() == pytest.approx(turn, abs=1e-5)
        assert first.norm().item() == pytest.approx(2.0, abs=1e-5)
        assert route[[0, -1], 1].abs().max() < 1e-5
        arc = route[1:-1].diff(dim=0).norm(dim=-1).sum().item()
        assert arc == pytest.approx(3.0 * abs(turn), rel=0.01)


def test_trunks_stand_apart_within_the_forest():
    for seed in range(5):
        wood = forest(gap=0.7, count=8, trunk=(0.1, 0.2), length=3.0, breadth=4.0, seed=seed)
        x, y, radius = wood.obstacles[:, 0], wood.obstacles[:, 1], wood.obstacles[:, 5]
        apart = [
            math.dist((x[i], y[i]), (x[j], y[j])) - radius[i] - radius[j] for i, j in combinations(range(len(x)), 2)
        ]
        assert min(apart) == pytest.approx(wood.gap, abs=1e-5)
        assert wood.gap >= 0.7
        assert (x.abs() + radius).max() <= 1.5 + 1e-6
        assert (y.abs() + radius).max() <= 2.0 + 1e-6
        assert radius.min() >= 0.1 - 1e-6 and radius.max() <= 0.2 + 1e-6
    assert not torch.equal(forest(seed=0).obstacles[:2], forest(seed=1).obstacles[:2])
    assert len(forest(gap=0.3, count=4).obstacles) == 4


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (narrowing, {"gap": 0.0}, "gap: got 0.0, must be greater than 0 m"),
        (narrowing, {"gap": 1.0, "entrance": 1.0}, "entrance: got 1.0, must be greater than gap = 1.0 m"),
        (passages, {"length": -1.0}, "length: got -1.0"),
        (passages, {"count": 0}, "count: got 0, must be at least 1"),
        (passages, {"shift": -0.1}, "shift: got -0.1, must not be negative"),
        (passages, {"gap": 1.0, "spacing": 0.9}, "spacing: got 0.9, must be at least gap = 1.0 m"),
        (curve, {"turn": 0.0}, "turn: got 0.0, must not be 0"),
        (curve, {"turn": 3.5}, "turn: got 3.5, .* within ±3 rad"),
        (curve, {"radius": 0.5, "gap": 1.0}, "radius: got 0.5, must be greater than half the gap"),
        (curve, {"approach": math.nan}, "approach: got nan"),
        (bollards, {"radius": 0.0}, "radius: got 0.0"),
        (forest, {"count": 1}, "count: got 1, must be at least 2"),
        (forest, {"gap": 9.0}, "gap: got 9.0, with which .* no room for two trunks"),
        (forest, {"trunk": (0.3, 0.2)}, r"trunk: got \(0.3, 0.2\)"),
        (doorway, {"thickness": -0.2}, "thickness: got -0.2"),
        (doorway, {"gap": 1.0, "hallway": 3.0, "offset": 1.0}, "offset: got 1.0, with which the door of 1.0 m is not"),
    ],
)
def test_bad_sizes_are_named(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)
