import math
from itertools import combinations

import pytest
import torch

from redig.envs import ObstacleMap, corridor, formation_integrity, formation_offsets
from redig.planning.virtual_structure import StructurePlanner, place

RADIUS, LIMITS = 0.1, (1.0, 2.0, 0.1)  # m; m/s, m/s², s


def turned(points: torch.Tensor, angle: float) -> torch.Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    return points @ torch.tensor([[cos, sin], [-sin, cos]])


def plan(formation: str, n: int, obstacle_map: ObstacleMap, angle=0.0, jitter=0.0, **options) -> tuple:
    offsets = formation_offsets(formation, n)
    structure = StructurePlanner(obstacle_map, formation, offsets, RADIUS, **options)
    start = turned(turned(offsets, jitter) + torch.tensor([-2.75, jitter]), angle)
    goal = turned(turned(offsets, -jitter) + torch.tensor([2.75, 0.5 * jitter]), angle)
    return start, goal, structure(start, goal, *LIMITS)


def assert_clear(position: torch.Tensor, obstacle_map: ObstacleMap) -> None:
    assert obstacle_map.signed_distance(position).min() > RADIUS
    for a, b in combinations(position.unbind(1), 2):
        assert (a - b).norm(dim=-1).min() > 2 * RADIUS


@pytest.mark.parametrize("width", [0.6, 1.1, 1.6])
@pytest.mark.parametrize(
    ("formation", "n"), [("wedge", 3), ("wedge", 5), ("circle", 5), ("circle", 6), ("line", 4), ("line", 5)]
)
def test_no_robot_touches_anything_and_all_arrive(formation, n, width):
    obstacle_map = corridor(width, angle=0.4)
    start, goal, position = plan(formation, n, obstacle_map, angle=0.4, jitter=0.1)
    assert torch.allclose(position[[0, -1]], torch.stack([start, goal]), atol=1e-5)
    assert_clear(position, obstacle_map)
    velocity = position.diff(dim=0) / 0.1
    assert velocity.norm(dim=-1).max() < 1.03
    assert (velocity.diff(dim=0) / 0.1).norm(dim=-1).max() < 2.2


@pytest.mark.parametrize(("formation", "n"), [("wedge", 5), ("circle", 5), ("line", 5), ("line", 4)])
def test_the_shape_keeps_its_integrity_where_that_costs_little(formation, n):
    _, _, position = plan(formation, n, corridor())
    assert formation_integrity(formation, position).mean() > 0.97


def test_where_there_is_room_the_shape_is_rigid_and_the_way_straight():
    far_away = ObstacleMap(torch.tensor([[0.0, 50.0, 1.0, 1.0, 0.0, 0.0]]), gap=3.0, bounds=(-4, -4, 4, 4))
    start, _, position = plan("wedge", 5, far_away)
    offsets = start - start.mean(0)
    assert torch.allclose(position - position.mean(1, keepdim=True), offsets.expand_as(position), atol=1e-4)
    assert position.mean(1)[:, 1].abs().max() < 1e-4


def test_time_is_worth_more_integrity_when_it_costs_more():
    quick, whole = (plan("circle", 5, corridor(), delay_cost=cost)[2] for cost in (1.0, 0.1))
    assert len(quick) < len(whole) - 4
    assert formation_integrity("circle", quick).mean() < formation_integrity("circle", whole).mean() - 0.1


def test_the_formation_is_restored_between_two_passages():
    walls = torch.cat([corridor(1.1, 0.5).obstacles, corridor(1.1, 0.5).obstacles])
    walls[:2, 0], walls[2:, 0] = -3.5, 3.5
    two = ObstacleMap(walls, gap=1.1, bounds=(-8.0, -4.0, 8.0, 4.0))
    offsets = formation_offsets("wedge", 5)
    structure = StructurePlanner(two, "wedge", offsets, RADIUS)
    position = structure(offsets - torch.tensor([7.0, 0.0]), offsets + torch.tensor([7.0, 0.0]), *LIMITS)
    assert_clear(position, two)
    breadth = position[..., 1].amax(-1) - position[..., 1].amin(-1)
    x = position.mean(1)[:, 0]
    assert breadth[(x.abs() - 3.5).abs() < 0.3].max() < 0.95
    assert breadth[x.abs() < 0.2].min() > 1.9


def test_passages_that_are_not_in_line():
    walls = torch.cat([corridor(1.1, 0.5).obstacles, corridor(1.1, 0.5).obstacles])
    walls[:2, 0], walls[2:, 0] = -2.5, 2.5
    walls[:2, 1] += 0.6
    walls[2:, 1] -= 0.6
    chicane = ObstacleMap(walls, gap=1.1, bounds=(-8.0, -4.0, 8.0, 4.0))
    offsets = formation_offsets("line", 4)
    structure = StructurePlanner(chicane, "line", offsets, RADIUS)
    position = structure(offsets - torch.tensor([6.0, 0.0]), offsets + torch.tensor([6.0, 0.0]), *LIMITS)
    assert_clear(position, chicane)


def test_five_abreast_slant_to_keep_apart():
    """In 1.1 m they have 1.7 cm between them; slanted as much as is needed they keep the clearance, and stay a line."""
    structure = StructurePlanner(corridor(), "line", formation_offsets("line", 5), RADIUS, clearance=0.05)
    path = torch.stack([torch.linspace(-2.75, 2.75, 276), torch.zeros(276)], -1)
    places = structure.squeezed(path)
    assert torch.pdist(places).min().item() == pytest.approx(0.25, abs=0.01)
    assert formation_integrity("line", places).item() == pytest.approx(1.0, abs=1e-5)
    assert places[:, 1].abs().max().item() == pytest.approx(0.4, abs=2e-3)


def test_places_follow_a_bent_path():
    angle = torch.linspace(0, 1.5, 400)
    arc = 3 * torch.stack([angle.sin(), 1 - angle.cos()], -1)  # centre of the bend to the left, at (0, 3)
    where = place(arc, torch.tensor([[0.0, 0.5], [0.0, -0.5], [0.6, 0.0]]).expand(400, 3, 2))
    from_centre = (where - torch.tensor([0.0, 3.0])).norm(dim=-1)[5:200]
    assert torch.allclose(from_centre, torch.tensor([2.5, 3.5, 3.0]).expand(195, 3), atol=2e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clearance": 0.0}, "clearance: got 0.0"),
        ({"effort": 0.0}, "effort: got 0.0"),
        ({"effort": 1.5}, "effort: got 1.5"),
        ({"corner": 0.0}, "corner: got 0.0"),
        ({"approach": -1.0}, "approach: got -1.0"),
    ],
)
def test_bad_arguments_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        StructurePlanner(corridor(), "wedge", formation_offsets("wedge", 5), RADIUS, **options)


def test_a_place_too_narrow_for_a_robot_is_named():
    narrow = corridor(0.25)
    lying = ObstacleMap(narrow.obstacles, gap=0.6, bounds=narrow.bounds)  # its gap is not what it says
    offsets = formation_offsets("wedge", 5)
    structure = StructurePlanner(lying, "wedge", offsets, RADIUS)
    path = torch.stack([torch.linspace(-2.75, 2.75, 276), torch.zeros(276)], -1)
    with pytest.raises(ValueError, match=r"obstacle_map: 0.25 m at the narrowest place"):
        structure.squeezed(path)
