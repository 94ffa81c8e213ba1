import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.envs import rewards
from redig.envs.formations import FORMATIONS, formation_integrity, formation_offsets, pairwise_distances

seeds = st.integers(0, 10_000)


def random_team(seed, *shape, spread=1.0):
    generator = torch.Generator().manual_seed(seed)
    return tuple(spread * torch.randn(*shape, 2, generator=generator, dtype=torch.float64) for _ in range(2))


def distance(a, b):
    return math.dist(a.tolist(), b.tolist())


@given(seeds, st.integers(2, 6), st.floats(0, 1))
@settings(max_examples=40, deadline=None)
def test_spring_damper_is_the_double_sum_of_equation_29(seed, n, omega):
    position, velocity = random_team(seed, n)
    desired = pairwise_distances(formation_offsets("line", n)).double()
    expected = 0.0
    for i in range(n):
        for j in range(n):
            spring = abs(desired[i, j].item() - distance(position[i], position[j]))
            expected += -omega * spring - (1 - omega) * distance(velocity[i], velocity[j])
    found = rewards.spring_damper(position, velocity, desired, omega).item()
    assert found == pytest.approx(expected, abs=1e-9)


@given(seeds, st.integers(2, 6), st.floats(0.1, 1), st.floats(0.2, 2))
@settings(max_examples=40, deadline=None)
def test_spring_damper_bonus_is_a_mean_over_the_teammates(seed, n, omega, clip):
    position, velocity = random_team(seed, n)
    desired = pairwise_distances(formation_offsets("line", n)).double()
    found = rewards.spring_damper_bonus(position, velocity, desired, omega, clip)
    for i in range(n):
        pairs = []
        for j in set(range(n)) - {i}:
            error = min(abs(desired[i, j].item() - distance(position[i], position[j])), clip)
            pairs.append(1 - error / clip - (1 - omega) / omega * distance(velocity[i], velocity[j]))
        assert found[i].item() == pytest.approx(sum(pairs) / len(pairs), abs=1e-9)


def test_a_perfect_formation_at_rest_earns_everything():
    offsets = formation_offsets("wedge", 5)
    still, desired = torch.zeros(5, 2), pairwise_distances(offsets)
    assert rewards.spring_damper(offsets, still, desired).item() == pytest.approx(0, abs=1e-5)
    torch.testing.assert_close(rewards.spring_damper_bonus(offsets, still, desired), torch.ones(5))


@given(seeds, st.sampled_from(FORMATIONS), st.integers(3, 7), st.floats(0.1, 1.5))
@settings(max_examples=40, deadline=None)
def test_best_lateral_scale_beats_every_scale_of_a_grid(seed, name, n, squeeze):
    offsets = formation_offsets(name, n).double()
    noise, _ = random_team(seed, n, spread=0.1)
    position = offsets * torch.tensor([1.0, squeeze]) + noise
    scale, residual = rewards.best_lateral_scale(position, offsets, torch.tensor([1.0, 0.0]).double())
    grid = torch.linspace(0.3, 1.1, 8001, dtype=torch.float64)
    relative = position - position.mean(0)
    places = torch.stack([offsets[:, 0].expand(8001, n), grid[:, None] * offsets[:, 1]], -1)
    error = (relative - places).norm(dim=-1)
    best = error.square().sum(-1).argmin()  # a clamped scale is the best one within the limits
    assert scale.item() == pytest.approx(grid[best].item(), abs=1e-4)
    for i in range(n):  # with the team stretched back to full width
        ahead, aside = relative[i, 0] - offsets[i, 0], relative[i, 1] / grid[best] - offsets[i, 1]
        assert residual[i].item() == pytest.approx(math.hypot(ahead, aside), abs=2e-3)


@given(seeds, st.floats(-math.pi, math.pi))
@settings(max_examples=40, deadline=None)
def test_team_and_direction_turned_together_give_the_same_scale(seed, angle):
    offsets = formation_offsets("wedge", 5).double()
    noise, _ = random_team(seed, 4, 5, spread=0.2)
    position = offsets * torch.tensor([1.0, 0.6]) + noise
    turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]).double()
    ahead = torch.tensor([1.0, 0.0]).double().expand(4, 2)
    expected = rewards.best_lateral_scale(position, offsets, ahead)
    found = rewards.best_lateral_scale(position @ turn + 3.0, offsets, ahead @ turn)
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(
        rewards.scaled_formation_bonus(position @ turn, offsets, ahead @ turn),
        rewards.scaled_formation_bonus(position, offsets, ahead),
        atol=1e-6,
        rtol=0,
    )


@pytest.mark.parametrize(("squeeze", "expected"), [(1.0, 1.0), (0.6, 0.8), (0.3, 0.65), (1.1, 1.0)])
def test_a_squeezed_formation_only_pays_the_price_of_squeezing(squeeze, expected):
    offsets = formation_offsets("wedge", 5)
    position = offsets * torch.tensor([1.0, squeeze]) + 2.0
    found = rewards.scaled_formation_bonus(position, offsets, torch.tensor([1.0, 0.0]))
    torch.testing.assert_close(found, torch.full((5,), expected), atol=1e-4, rtol=0)


@pytest.mark.parametrize("squeeze", [1.0, 0.5])
def test_each_robot_loses_the_scaled_bonus_with_its_own_residual(squeeze):
    offsets = torch.tensor([[0.0, -1.0], [0.0, 0.0], [0.0, 1.0]])
    position = torch.tensor([[0.3, -squeeze], [-0.2, 0.0], [-0.1, squeeze]])  # residuals of 0.3, 0.2 and 0.1 m
    found = rewards.scaled_formation_bonus(position, offsets, torch.tensor([1.0, 0.0]), tolerance=0.25)
    expected = torch.tensor([0.0, 0.2, 0.6]) - 0.5 * (1 - squeeze)  # no bonus from 0.25 m on
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


def test_an_error_across_counts_against_the_squeezed_width():
    offsets = torch.tensor([[0.0, -1.0], [0.0, 0.0], [0.0, 1.0]])
    position = torch.tensor([[0.0, -0.45], [0.0, -0.10], [0.0, 0.55]])  # the middle robot 0.1 m off, at half the width
    scale, residual = rewards.best_lateral_scale(position, offsets, torch.tensor([1.0, 0.0]))
    torch.testing.assert_close(scale, torch.tensor(0.5))
    torch.testing.assert_close(residual, torch.tensor([0.1, 0.2, 0.1]))


@given(seeds, st.floats(-1.5, 1.5), st.floats(0.3, 1.1), st.floats(-math.pi, math.pi))
@settings(max_examples=60, deadline=None)
def test_a_leaning_line_pays_for_squeeze_and_slant_only(seed, slant, squeeze, angle):
    offsets = formation_offsets("line", 5).double()
    echelon = torch.stack([slant * offsets[:, 1], squeeze * offsets[:, 1]], -1)
    turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]).double()
    ahead = torch.tensor([1.0, 0.0]).double() @ turn
    found = rewards.slanted_formation_bonus(echelon @ turn + 3.0, offsets, ahead)
    expected = 1 - 0.5 * max(1 - squeeze, 0) - 0.1 * abs(slant)
    torch.testing.assert_close(found, torch.full((5,), expected).double(), atol=1e-6, rtol=0)
    assert formation_integrity("line", echelon @ turn).item() == pytest.approx(1, abs=1e-6)


@given(st.sampled_from(["line", "wedge", "circle"]), seeds, st.floats(0.2, 1.2), st.floats(-math.pi, math.pi))
@settings(max_examples=60, deadline=None)
def test_integrity_pays_tau_less_the_squeeze_wherever_the_team_heads(name, seed, squeeze, angle):
    offsets = formation_offsets(name, 5).double()
    noise, _ = random_team(seed, 5, spread=0.05)
    team = offsets * torch.tensor([1.0, squeeze]).double() + noise
    turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]).double()
    found = rewards.integrity_bonus(name, team @ turn - 1.0, offsets, torch.tensor([1.0, 0.0]).double() @ turn)
    left = (team - team.mean(0))[:, 1]
    scale = (left @ offsets[:, 1] / offsets[:, 1].square().sum()).clamp(0.3, 1.1).item()
    expected = formation_integrity(name, team).item() - 0.1 * max(1 - scale, 0)
    assert found.item() == pytest.approx(expected, abs=1e-6)


@given(seeds, st.sampled_from(["line", "wedge", "circle"]))
@settings(max_examples=40, deadline=None)
def test_no_slant_of_a_grid_leaves_a_smaller_residual(seed, name):
    offsets, ahead = formation_offsets(name, 5).double(), torch.tensor([1.0, 0.0]).double()
    noise, _ = random_team(seed, 5, spread=0.05)
    position = offsets + noise + torch.stack([0.4 * offsets[:, 1], torch.zeros(5).double()], -1)
    relative = position - position.mean(0)
    errors = [
        (relative[:, 0] - offsets[:, 0] - k * offsets[:, 1]).square().sum() for k in torch.linspace(-1.5, 1.5, 3001)
    ]
    best = -1.5 + 0.001 * int(torch.stack(errors).argmin())
    upright = position - torch.stack([best * offsets[:, 1], torch.zeros(5).double()], -1)
    expected = rewards.scaled_formation_bonus(upright, offsets, ahead) - 0.1 * abs(best)
    torch.testing.assert_close(rewards.slanted_formation_bonus(position, offsets, ahead), expected, atol=5e-3, rtol=0)


@given(seeds, st.floats(0, 2), st.floats(-math.pi, math.pi), st.floats(0.1, 5))
@settings(max_examples=60, deadline=None)
def test_goal_speed_is_the_square_of_the_speed_times_the_cosine(seed, speed, angle, away):
    position, _ = random_team(seed, 1)
    heading = torch.tensor([[math.cos(0.4), math.sin(0.4)]], dtype=torch.float64)
    velocity = speed * torch.tensor([[math.cos(0.4 + angle), math.sin(0.4 + angle)]], dtype=torch.float64)
    found = rewards.goal_speed(position, velocity, position + away * heading).item()
    assert found == pytest.approx(speed**2 * math.cos(angle), abs=1e-9)


def test_goal_speed_at_the_goal_is_zero():
    assert rewards.goal_speed(torch.ones(1, 2), torch.ones(1, 2), torch.ones(1, 2)).item() == 0


@given(seeds, st.floats(0.01, 1))
@settings(max_examples=40, deadline=None)
def test_progress_adds_up_to_the_distance_gained(seed, dt):
    way, _ = random_team(seed, 7, 3)
    goal = torch.full((3, 2), 2.0, dtype=torch.float64)
    total = sum(rewards.progress(before, after, goal, dt) for before, after in pairwise(way))
    for i in range(3):
        gained = distance(way[0, i], goal[i]) - distance(way[-1, i], goal[i])
        assert (total[i] * dt).item() == pytest.approx(gained, abs=1e-9)


@given(seeds, st.integers(2, 6), st.floats(0.05, 0.5))
@settings(max_examples=40, deadline=None)
def test_clearance_is_the_smallest_gap_of_a_double_loop(seed, n, radius):
    position, other = random_team(seed, n)
    wall = other[:, 0]
    found = rewards.clearance(position, wall, radius)
    for i in range(n):
        gaps = [distance(position[i], position[j]) - 2 * radius for j in range(n) if j != i]
        assert found[i].item() == pytest.approx(min([*gaps, wall[i].item() - radius]), abs=1e-9)


def test_proximity_is_a_ramp():
    found = rewards.proximity(torch.tensor([-1.0, 0.0, 0.05, 0.1, 3.0]), margin=0.1)
    torch.testing.assert_close(found, torch.tensor([1.0, 1.0, 0.5, 0.0, 0.0]))
