import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from redig.envs.formations import FORMATIONS, formation_integrity, formation_offsets, pairwise_distances

TEAMS = [(name, n) for name in FORMATIONS for n in range(3, 10)]


def rotated(position, angle):
    cos, sin = math.cos(angle), math.sin(angle)
    return position @ torch.tensor([[cos, sin], [-sin, cos]], dtype=position.dtype)


@pytest.mark.parametrize(("name", "n"), TEAMS)
def test_a_perfect_shape_is_whole_at_any_size(name, n):
    for width in (0.5, 2.0, 7.0):
        assert formation_integrity(name, formation_offsets(name, n, width)).item() == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize(("name", "n"), [team for team in TEAMS if team[0] != "circle"])
@pytest.mark.parametrize("squeeze", [0.2, 0.5, 1.7])
def test_wedge_and_line_squeezed_evenly_stay_whole(name, n, squeeze):
    position = formation_offsets(name, n) * torch.tensor([1.0, squeeze])
    assert formation_integrity(name, position).item() == pytest.approx(1, abs=1e-5)


def test_line_with_one_displaced_robot():
    position = torch.tensor([[0.0, -1.0], [0.0, -0.5], [0.3, 0.1], [0.0, 0.5], [0.0, 1.0]])
    gaps = [0.5, math.sqrt(0.36 + 0.09), math.sqrt(0.16 + 0.09), 0.5]  # the ideal gap is 2 / 4
    expected = 1 - sum(abs(gap - 0.5) / 0.5 for gap in gaps) / 4 - (0.3 / 2) / 5
    assert formation_integrity("line", position).item() == pytest.approx(expected, abs=1e-6)


def test_wedge_with_one_displaced_robot():
    position = torch.tensor([[0.0, 0.0], [-0.5, 0.5], [-0.5, -0.5], [-1.0, 1.5], [-1.0, -1.0]])
    left, right = math.hypot(1, 1.5) / 2, math.hypot(1, 1) / 2
    inner, base = 1.0, 2.5
    expected = 1 - 2 * abs(left - right) / (left + right) - abs(2 * inner - base) / base
    assert formation_integrity("wedge", position).item() == pytest.approx(expected, abs=1e-6)


def test_wedge_of_even_size_sees_its_robot_without_partner():
    position = formation_offsets("wedge", 4)
    position[3] *= 1.5
    assert formation_integrity("wedge", position).item() < 0.9


def test_circle_squeezed_to_a_rhombus():
    position = torch.tensor([[math.sqrt(3), 0.0], [0.0, 1.0], [-math.sqrt(3), 0.0], [0.0, -1.0]])  # 60 and 120 degrees
    assert formation_integrity("circle", position).item() == pytest.approx(1 - 30 / 90, abs=1e-5)


def test_circle_counts_a_reflex_angle_above_180_degrees():
    position = torch.tensor([[0.5, 0.0], [-1.0, 1.0], [-0.5, 0.0], [-1.0, -1.0]])
    tip = 2 * math.atan2(1, 1.5)
    dent = 2 * math.pi - 2 * math.atan2(1, 0.5)
    side = (2 * math.pi - tip - dent) / 2
    quarter = math.pi / 2
    expected = 1 - sum(abs(angle - quarter) / quarter for angle in (tip, dent, side, side)) / 4
    if expected < 0:
        pytest.fail("the example must lie in the range where tau is not clamped")
    assert formation_integrity("circle", position).item() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("n", range(3, 10))
def test_the_printed_formulas_are_what_the_corrections_say(n):
    circle = formation_integrity("circle", formation_offsets("circle", n), literal=True)
    line = formation_integrity("line", formation_offsets("line", n), literal=True)
    assert circle.item() == pytest.approx(0, abs=1e-5)
    assert line.item() == pytest.approx(1 - 1 / (n - 1), abs=1e-5)  # 0.75 for 5 robots


@given(
    st.sampled_from(TEAMS),
    st.integers(0, 10_000),
    st.floats(-math.pi, math.pi),
    st.tuples(st.floats(-5, 5), st.floats(-5, 5)),
    st.floats(0.3, 3),
)
@settings(max_examples=100, deadline=None)
def test_integrity_ignores_where_the_team_is_where_it_points_and_its_size(team, seed, angle, shift, size):
    name, n = team
    generator = torch.Generator().manual_seed(seed)
    noise = 0.1 * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    position = formation_offsets(name, n).double() + noise
    moved = size * rotated(position, angle) + torch.tensor(shift, dtype=torch.float64)
    for literal in (False, True):
        before, after = (formation_integrity(name, p, literal) for p in (position, moved))
        torch.testing.assert_close(after, before, atol=1e-6, rtol=0)


@given(st.sampled_from(TEAMS), st.integers(0, 10_000), st.floats(0, 3))
@settings(max_examples=100, deadline=None)
def test_integrity_of_any_team_lies_between_0_and_1(team, seed, spread):
    name, n = team
    position = spread * torch.randn(2, 3, n, 2, generator=torch.Generator().manual_seed(seed))
    tau = formation_integrity(name, position)
    assert tau.shape == (2, 3)
    assert ((tau >= 0) & (tau <= 1)).all()


def test_a_batch_gives_what_its_teams_give():
    position = formation_offsets("wedge", 5) + 0.2 * torch.randn(6, 5, 2, generator=torch.Generator().manual_seed(0))
    single = torch.stack([formation_integrity("wedge", team) for team in position])
    torch.testing.assert_close(formation_integrity("wedge", position), single)


@pytest.mark.parametrize(("name", "n"), TEAMS)
def test_offsets_have_their_centroid_at_the_origin(name, n):
    torch.testing.assert_close(formation_offsets(name, n).mean(0), torch.zeros(2), atol=1e-6, rtol=0)


@pytest.mark.parametrize("n", range(3, 10))
def test_offsets_of_each_shape(n):
    line = formation_offsets("line", n, width=3.0)
    assert torch.equal(line[:, 0], torch.zeros(n))
    torch.testing.assert_close(line[1:, 1] - line[:-1, 1], torch.full((n - 1,), 3 / (n - 1)))

    circle = formation_offsets("circle", n, width=3.0)
    torch.testing.assert_close(circle.norm(dim=-1), torch.full((n,), 1.5))
    turn = torch.atan2(circle[:, 1], circle[:, 0]) - 2 * math.pi * torch.arange(n) / n
    torch.testing.assert_close(turn.cos(), torch.ones(n))

    wedge = formation_offsets("wedge", n, width=3.0) - formation_offsets("wedge", n, width=3.0)[0]
    assert (wedge[1:, 0] < 0).all()  # the apex leads
    torch.testing.assert_close(wedge[:, 1].abs(), -wedge[:, 0])  # arms at 45 degrees
    assert (wedge[1::2, 1] > 0).all()
    assert (wedge[2::2, 1] < 0).all()
    torch.testing.assert_close(wedge[:, 1].max(), torch.tensor(1.5))


def test_pairwise_distances_agree_with_scipy():
    position = torch.randn(4, 6, 2, generator=torch.Generator().manual_seed(0))
    expected = torch.stack([torch.from_numpy(cdist(p, p)) for p in position]).float()
    torch.testing.assert_close(pairwise_distances(position), expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("square", 5), r"formation: got 'square'.*wedge, line, circle"),
        (("wedge", 2), r"n_robots: got 2.*at least 3"),
        (("circle", 2), r"n_robots: got 2.*at least 3"),
        (("line", 1), r"n_robots: got 1.*at least 2"),
        (("line", 3, 0.0), r"formation_width: got 0.0.*greater than 0"),
        (("line", 3, math.nan), r"formation_width: got nan.*greater than 0"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        formation_offsets(*arguments)


def test_integrity_of_an_unknown_or_too_small_team_is_refused():
    with pytest.raises(ValueError, match="formation: got 'square'"):
        formation_integrity("square", torch.zeros(5, 2))
    with pytest.raises(ValueError, match="n_robots: got 2"):
        formation_integrity("circle", torch.zeros(2, 2))
