import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.envs import ObstacleMap, corridor
from redig.planning.centre_path import centre_path, free_width, normals, team_grid


def turned(x: float, y: float, angle: float) -> torch.Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([cos * x - sin * y, sin * x + cos * y])


@given(
    width=st.floats(0.5, 1.6),
    angle=st.floats(-1.5, 1.5),
    start=st.floats(-0.4, 0.4),
    goal=st.floats(-0.4, 0.4),
)
@settings(max_examples=12, deadline=None)
def test_the_path_keeps_to_the_middle_of_a_corridor(width, angle, start, goal):
    obstacle_map = corridor(width, angle=angle)
    grid = team_grid(obstacle_map, 0.1, 1.2)
    first, last = turned(-2.75, start, angle), turned(2.75, goal, angle)
    path = centre_path(obstacle_map, grid, first, last, 1.2)
    assert torch.allclose(path[[0, -1]], torch.stack([first, last]), atol=1e-5)
    along = path @ turned(1.0, 0.0, angle)
    across = path @ turned(0.0, 1.0, angle)
    assert across[along.abs() < 0.6].abs().max() < 0.005
    assert obstacle_map.signed_distance(path).min() > width / 2 - 0.03
    steps = path.diff(dim=0).norm(dim=-1)
    assert steps.max() < 1.2 * steps.min()


def test_beside_a_single_obstacle_the_path_keeps_half_the_gap():
    block = ObstacleMap(torch.tensor([[0.0, -1.0, 0.5, 1.1, 0.0, 0.0]]), gap=1.0, bounds=(-4, -4, 4, 4))
    grid = team_grid(block, 0.1, 1.2)
    path = centre_path(block, grid, torch.tensor([-2.5, 0.0]), torch.tensor([2.5, 0.0]), 1.2)
    assert block.signed_distance(path).min() > 0.4


def test_free_width_is_that_of_the_corridor():
    path = torch.stack([torch.linspace(-0.5, 0.5, 11), torch.full((11,), 0.13)], -1)
    left, right = free_width(corridor(0.9), path, reach=1.0)
    assert torch.allclose(left, torch.full((11,), 0.45 - 0.13), atol=1e-4)
    assert torch.allclose(right, torch.full((11,), 0.45 + 0.13), atol=1e-4)
    left, right = free_width(corridor(0.9), path - torch.tensor([3.0, 0.0]), reach=1.0)
    assert torch.equal(left, torch.ones(11)) and torch.equal(right, torch.ones(11))


def test_normals_are_unit_vectors_across():
    angle = torch.linspace(0, 3, 50)
    circle = torch.stack([angle.cos(), angle.sin()], -1)
    assert torch.allclose(normals(circle)[1:-1], -circle[1:-1], atol=1e-3)


def test_too_narrow_a_gap_is_named():
    with pytest.raises(ValueError, match=r"obstacle_map: a gap of 0.2 m is too narrow"):
        team_grid(corridor(0.2), 0.1, 1.0)
