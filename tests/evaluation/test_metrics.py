import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from redig.envs.formations import FORMATIONS, formation_offsets
from redig.evaluation import (
    contextual_formation_integrity,
    gap_term,
    jerk,
    success,
    team_success,
    travel_time,
)

DT = 0.1


def flags(*robots: str) -> torch.Tensor:
    """Robots as strings of 0 and 1 over time, to [T, n] bool."""
    return torch.tensor([[c == "1" for c in robot] for robot in robots]).T


@pytest.mark.parametrize(
    ("arrived", "collision", "expected"),
    [
        ("0011", "0000", True),
        ("0000", "0000", False),  # never arrives
        ("0011", "0100", False),  # collides before it arrives
        ("0011", "0001", False),  # collides after it has arrived
        ("0000", "0100", False),
        ("0001", "0000", True),  # at the horizon
    ],
)
def test_success_needs_an_arrival_and_no_collision(arrived, collision, expected):
    assert success(flags(arrived), flags(collision)).tolist() == [expected]


def test_team_succeeds_only_as_a_whole():
    arrived = torch.stack([flags("01", "01"), flags("01", "00"), flags("01", "01")])
    collision = torch.stack([flags("00", "00"), flags("00", "00"), flags("00", "10")])
    assert success(arrived, collision).tolist() == [[True, True], [True, False], [True, False]]
    assert team_success(arrived, collision).tolist() == [True, False, False]


def test_travel_time_is_that_of_the_last_arrival():
    arrived = torch.stack([flags("00111", "00001"), flags("01111", "00000"), flags("11111", "11111")])
    time = travel_time(arrived, dt=0.5)
    assert time[0].item() == 2.0
    assert math.isnan(time[1].item())
    assert time[2].item() == 0.0


@given(st.lists(st.lists(st.integers(0, 12), min_size=3, max_size=3), min_size=1, max_size=5))
def test_travel_time_equals_a_search(first_arrival):
    horizon = 10  # an arrival beyond it never happens
    arrived = torch.zeros(len(first_arrival), horizon, 3, dtype=torch.bool)
    for e, team in enumerate(first_arrival):
        for i, k in enumerate(team):
            arrived[e, k:, i] = True
    for team, time in zip(first_arrival, travel_time(arrived, DT).tolist(), strict=True):
        if max(team) >= horizon:
            assert math.isnan(time)
        else:
            assert time == pytest.approx(DT * max(team))


def ring(r: float) -> torch.Tensor:
    return formation_offsets("circle", 6, width=2 * r)


@given(st.floats(0.1, 3), st.floats(0.1, 3), st.floats(0.02, 1))
def test_gap_term_equals_its_definition(r, xi, delta):
    error = abs(r - xi)
    corrected = 1.0 if error <= delta else max(0.0, 1 - (error - delta) / delta)
    printed = 1 - min(abs(r - (xi + delta)), abs(r - (xi - delta))) / delta
    # r has the rounding of float32, which delta magnifies
    tolerance = 1e-6 * (1 + r) / delta + 1e-6
    assert gap_term(ring(r), xi, delta).item() == pytest.approx(corrected, abs=tolerance)
    assert gap_term(ring(r), xi, delta, literal=True).item() == pytest.approx(max(0.0, printed), abs=tolerance)


@pytest.mark.parametrize("delta", [0.5, 0.1, 0.03])
def test_gap_term_corrected_and_literal_disagree_at_xi(delta):
    corrected = [gap_term(ring(r), 1.0, delta).item() for r in (1.0, 1 + delta, 1 - delta, 1 + 2 * delta)]
    literal = [gap_term(ring(r), 1.0, delta, literal=True).item() for r in (1.0, 1 + delta, 1 - delta, 1 + 2 * delta)]
    assert corrected == pytest.approx([1, 1, 1, 0], abs=1e-4)
    assert literal == pytest.approx([0, 1, 1, 0], abs=1e-4)


def test_gap_term_measures_the_largest_distance_from_the_centroid():
    team = torch.tensor([[0.0, 0.0], [0.0, 0.0], [3.0, 0.0]]) + torch.tensor([7.0, -5.0])  # centroid at 1: r = 2
    assert gap_term(team, xi=2.0, delta=0.01).item() == pytest.approx(1.0)
    assert gap_term(team, xi=2.015, delta=0.01).item() == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("name", FORMATIONS)
@pytest.mark.parametrize("w", [0.0, 0.3, 0.5, 1.0])
def test_cfi_of_a_perfect_formation_in_closed_form(name, w):
    team = formation_offsets(name, 5, width=1.8)
    r = max(math.hypot(*p) for p in team.tolist())
    delta = 0.1
    for xi, gap in ((r, 1.0), (r + 0.15, 0.5), (r - 0.15, 0.5), (r + 0.4, 0.0)):
        value = contextual_formation_integrity(name, team, xi, delta, w=w).item()
        assert value == pytest.approx(w * gap + (1 - w), abs=1e-4)


def test_cfi_passes_literal_to_both_terms():
    line = formation_offsets("line", 5)  # r = 1 and, as printed, tau = 1 - 1/4
    at_xi = contextual_formation_integrity("line", line, 1.0, 0.5, literal=True)
    off_xi = contextual_formation_integrity("line", line, 1.5, 0.5, literal=True)
    assert at_xi.item() == pytest.approx(0.5 * 0 + 0.5 * 0.75)
    assert off_xi.item() == pytest.approx(0.5 * 1 + 0.5 * 0.75)
    circle = formation_offsets("circle", 5)  # as printed, tau = 0
    assert contextual_formation_integrity("circle", circle, 1.5, 0.5, literal=True).item() == pytest.approx(
        0.5, abs=1e-6
    )


def test_cfi_keeps_batch_dimensions():
    team = torch.randn(4, 7, 5, 2, generator=torch.Generator().manual_seed(0))
    value = contextual_formation_integrity("wedge", team, 0.9, 0.5)
    assert value.shape == (4, 7)
    assert value[2, 3].item() == contextual_formation_integrity("wedge", team[2, 3], 0.9, 0.5).item()


@given(st.floats(-3, 3), st.floats(-3, 3))
def test_jerk_of_cubic_motion_is_constant(x, y):
    t = DT * torch.arange(12, dtype=torch.float64)
    lower = 2 * t**2 - t + 1  # has no third derivative
    position = (torch.tensor([x, y], dtype=torch.float64) * t[:, None] ** 3 / 6 + lower[:, None]).unsqueeze(1)
    assert jerk(position, DT).shape == (9, 1)
    assert jerk(position, DT).flatten().tolist() == pytest.approx([math.hypot(x, y)] * 9, abs=1e-9)


def test_jerk_of_uniform_motion_is_zero():
    t = torch.arange(20, dtype=torch.float64).view(1, 20, 1, 1)
    velocity = torch.tensor([[1.0, 0.5], [-0.3, 0.0]]).double()
    assert jerk(t * DT * velocity, DT).max() < 1e-9


def test_jerk_equals_a_loop():
    position = torch.randn(2, 6, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    value = jerk(position, DT)
    assert value.shape == (2, 3, 3)
    for e in range(2):
        for k in range(3):
            for i in range(3):
                p = position[e, k : k + 4, i]
                third = (p[3] - 3 * p[2] + 3 * p[1] - p[0]) / DT**3
                assert value[e, k, i].item() == pytest.approx(math.hypot(*third.tolist()))


@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_jerk_of_short_motion(samples):
    assert jerk(torch.zeros(2, samples, 5, 2), DT).shape == (2, max(samples - 3, 0), 5)


@pytest.mark.parametrize("delta", [0.0, -0.1, float("nan")])
def test_bad_delta(delta):
    with pytest.raises(ValueError, match="delta: got"):
        gap_term(ring(1.0), 1.0, delta)


@pytest.mark.parametrize("w", [-0.1, 1.1, float("nan")])
def test_bad_weight(w):
    with pytest.raises(ValueError, match="w: got"):
        contextual_formation_integrity("line", formation_offsets("line", 3), 1.0, 0.1, w=w)


def test_bad_formation():
    with pytest.raises(ValueError, match="'star'"):
        contextual_formation_integrity("star", torch.zeros(5, 2), 1.0, 0.1)
