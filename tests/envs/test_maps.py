import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path

from redig.envs.maps import ObstacleMap, corridor

BOUNDS = (-5.0, -5.0, 5.0, 5.0)


def boundary(obstacle, edge_points=300, arc_points=100):
    """The outline of a rounded box, point by point and counter-clockwise: four arcs and the edges between them."""
    x, y, length, breadth, heading, radius = obstacle
    arcs = []
    for quarter, (sx, sy) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)]):
        angle = np.linspace(quarter * np.pi / 2, (quarter + 1) * np.pi / 2, arc_points)
        arcs.append(np.stack([sx * length + radius * np.cos(angle), sy * breadth + radius * np.sin(angle)], -1))
    edges = [np.linspace(arcs[i][-1], arcs[(i + 1) % 4][0], edge_points) for i in range(4)]
    local = np.concatenate([part for pair in zip(arcs, edges, strict=True) for part in pair])
    cos, sin = np.cos(heading), np.sin(heading)
    return local @ np.array([[cos, sin], [-sin, cos]]) + np.array([x, y])


def brute_force_distance(obstacles, points):
    """Signed distance by looking at every point of every outline."""
    distances = []
    for obstacle in obstacles:
        outline = boundary(obstacle)
        distance = np.linalg.norm(points[:, None] - outline[None], axis=-1).min(1)
        distances.append(np.where(Path(outline).contains_points(points), -distance, distance))
    return np.min(distances, axis=0)


box = st.tuples(
    st.floats(-2, 2),
    st.floats(-2, 2),
    st.floats(0, 1.5),
    st.floats(0, 1.5),
    st.floats(-math.pi, math.pi),
    st.floats(0.05, 0.6),
)
maps = st.lists(box, min_size=1, max_size=3)


def make_map(obstacles):
    return ObstacleMap(torch.tensor(obstacles, dtype=torch.float64), gap=1.0, bounds=BOUNDS)


def random_points(seed, count=60):
    return np.random.default_rng(seed).uniform(-4, 4, (count, 2))


@given(maps, st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_signed_distance_agrees_with_a_dense_outline(obstacles, seed):
    points = random_points(seed)
    found = make_map(obstacles).signed_distance(torch.from_numpy(points)).numpy()
    np.testing.assert_allclose(found, brute_force_distance(obstacles, points), atol=0.01)


@given(maps, st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_direction_is_minus_the_gradient_and_has_length_one(obstacles, seed):
    obstacle_map, step = make_map(obstacles), 1e-6
    point = torch.from_numpy(random_points(seed))
    _, direction = obstacle_map.nearest(point)
    torch.testing.assert_close(direction.norm(dim=-1), torch.ones(len(point), dtype=torch.float64))
    slopes = []
    for shift in torch.eye(2, dtype=torch.float64) * step:
        ahead, behind = obstacle_map.signed_distance(point + shift), obstacle_map.signed_distance(point - shift)
        slopes.append((ahead - behind) / (2 * step))
    gradient = torch.stack(slopes, -1)
    smooth = (gradient.norm(dim=-1) - 1).abs() < 1e-4  # on a ridge between two sides there is no gradient
    assert smooth.float().mean() > 0.9
    torch.testing.assert_close(direction[smooth], -gradient[smooth], atol=1e-3, rtol=0)


@given(box, st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_from_inside_one_obstacle_the_direction_leads_straight_out(obstacle, seed):
    x, y, length, breadth, _, radius = obstacle
    reach = np.hypot(length, breadth) + radius
    centre = np.array([x, y])
    point = torch.from_numpy(centre + np.random.default_rng(seed).uniform(-reach, reach, (60, 2)))
    obstacle_map = make_map([obstacle])
    distance, direction = obstacle_map.nearest(point)
    inside = distance < 0
    surface = point[inside] + direction[inside] * distance[inside].unsqueeze(-1)
    on_it = obstacle_map.signed_distance(surface)
    torch.testing.assert_close(on_it, torch.zeros_like(on_it), atol=1e-9, rtol=0)


def test_a_trunk_and_a_square_by_hand():
    trunk = make_map([(1.0, 2.0, 0.0, 0.0, 0.3, 0.5)])
    distance, direction = trunk.nearest(torch.tensor([[1.0, 5.0], [1.1, 2.0]], dtype=torch.float64))
    torch.testing.assert_close(distance, torch.tensor([2.5, -0.4], dtype=torch.float64))
    torch.testing.assert_close(direction, torch.tensor([[0.0, -1.0], [-1.0, 0.0]], dtype=torch.float64))
    square = make_map([(0.0, 0.0, 1.0, 1.0, math.pi / 4, 0.0)])  # its corners lie on the axes
    distance, direction = square.nearest(torch.tensor([[3.0, 0.0], [0.0, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(distance, torch.tensor([3 - math.sqrt(2), -1.0], dtype=torch.float64))
    torch.testing.assert_close(direction[0], torch.tensor([-1.0, 0.0], dtype=torch.float64))
    assert direction[1].norm().item() == pytest.approx(1)  # at the centre any way out is as good


def test_batch_dimensions_are_kept():
    distance, direction = corridor().nearest(torch.zeros(3, 4, 5, 2))
    assert distance.shape == (3, 4, 5)
    assert direction.shape == (3, 4, 5, 2)


@pytest.mark.parametrize("angle", [0.0, math.pi / 2, 0.7])
def test_corridor_is_open_along_its_direction_and_closed_beside_it(angle):
    width, length, wall = 1.4, 3.0, 2.0
    obstacle_map = corridor(width, length, angle, wall)
    assert obstacle_map.gap == width
    along = torch.tensor([math.cos(angle), math.sin(angle)])
    across = torch.tensor([-math.sin(angle), math.cos(angle)])
    for forward in (-1.4, 0.0, 1.4):
        for left in (-0.5, 0.0, 0.6):
            distance, direction = obstacle_map.nearest(forward * along + left * across)
            assert distance.item() == pytest.approx(width / 2 - abs(left), abs=1e-5)
            if left:
                torch.testing.assert_close(direction, math.copysign(1, left) * across, atol=1e-5, rtol=0)
    assert obstacle_map.signed_distance(1.2 * across).item() == pytest.approx(-0.5, abs=1e-5)
    assert obstacle_map.signed_distance(2.5 * along + 1.2 * across).item() == pytest.approx(1.0, abs=1e-5)
    assert obstacle_map.signed_distance((width / 2 + wall + 0.25) * across).item() == pytest.approx(0.25, abs=1e-5)


def test_moving_a_map_to_a_device_keeps_it():
    original = corridor(1.3, 2.5, 0.4)
    moved = original.to("cpu")
    assert torch.equal(moved.obstacles, original.obstacles)
    assert (moved.gap, moved.bounds) == (original.gap, original.bounds)


@pytest.mark.parametrize("shape", [(6,), (0, 6), (2, 5), (1, 2, 6)])
def test_obstacles_of_a_wrong_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r"obstacles: got shape .*expected \[M, 6\]"):
        ObstacleMap(torch.zeros(shape), gap=1.0, bounds=BOUNDS)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [({"width": 0.0}, "corridor_width"), ({"length": -1.0}, "corridor_length"), ({"wall": math.nan}, "wall")],
)
def test_corridor_sizes_must_be_positive(arguments, name):
    with pytest.raises(ValueError, match=f"^{name}: got .*greater than 0"):
        corridor(**arguments)
