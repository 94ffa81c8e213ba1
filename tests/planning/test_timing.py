import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.planning.curves import smooth
from redig.planning.timing import time_scaling


def straight(length: float, n: int = 1) -> torch.Tensor:
    x = torch.linspace(0, length, 301)
    return torch.stack([x, torch.zeros(301)], -1).unsqueeze(1).repeat(1, n, 1)


@pytest.mark.parametrize(("length", "limit"), [(4.0, 1.0), (3.0, 0.5), (0.5, 2.0)])
def test_a_straight_way_takes_as_long_as_the_trapezoid(length, limit):
    """Time at the limits of speed and acceleration in closed form; the smoothing adds its window."""
    acceleration, dt, ramp = 2.0, 0.05, 0.1
    reached = min(limit, math.sqrt(length * acceleration))
    expected = length / reached + reached / acceleration + 2 * ramp
    position = time_scaling(straight(length), limit, acceleration, dt, ramp)
    assert (len(position) - 1) * dt == pytest.approx(expected, abs=0.08)
    assert torch.equal(position[[0, -1]], straight(length)[[0, -1]])


def random_ways(seed: int) -> torch.Tensor:
    ways = torch.randn(9, 3, 2, generator=torch.Generator().manual_seed(seed)).cumsum(0)
    fine = torch.nn.functional.interpolate(ways.flatten(1).T[None], 400, mode="linear", align_corners=True)[0].T
    return smooth(fine.unflatten(-1, (3, 2)), 40)


@given(seed=st.integers(0, 999))
@settings(max_examples=25, deadline=None)
def test_robots_keep_their_limits_and_their_ways(seed):
    ways, dt = random_ways(seed), 0.1
    position = time_scaling(ways, 1.0, 1.5, dt, ramp=0.2)
    velocity = position.diff(dim=0) / dt
    acceleration = velocity.diff(dim=0) / dt
    assert velocity.norm(dim=-1).max() < 1.05
    assert velocity[[0, -1]].norm(dim=-1).max() < 0.2
    assert acceleration.norm(dim=-1).max() < 1.2 * 1.5 * 2**0.5  # along and across, each up to its limit
    for robot in range(3):
        assert torch.cdist(position[:, robot], ways[:, robot]).amin(-1).max() < 0.05


def test_all_robots_wait_for_the_one_with_the_longest_way():
    ways = torch.cat([straight(4.0), straight(2.0)], 1)
    together = time_scaling(ways, 1.0, 2.0, 0.1)
    assert torch.allclose(together[:, 1, 0] * 2, together[:, 0, 0], atol=1e-5)
    assert len(together) == len(time_scaling(straight(4.0), 1.0, 2.0, 0.1))


def test_a_longer_window_makes_less_peak_jerk():
    def peak(ramp: float) -> float:
        position = time_scaling(straight(4.0), 1.0, 2.0, 0.05, ramp)[:, 0, 0]
        return position.diff(n=3).abs().max().item() / 0.05**3

    assert peak(0.4) < 0.7 * peak(0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.zeros(5, 2), 1.0, 1.0, 0.1), "ways: got shape"),
        ((straight(1.0), 0.0, 1.0, 0.1), "max_speed: got 0.0"),
        ((straight(1.0), 1.0, -1.0, 0.1), "max_acceleration: got -1.0"),
        ((straight(1.0), 1.0, 1.0, 0.0), "dt: got 0.0"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        time_scaling(*arguments)
