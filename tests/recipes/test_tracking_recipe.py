import math

import numpy as np
import pytest
import torch
import tracking
from scan_range import out_of

from redig.deploy import LIMO


def test_an_arc_is_what_many_short_steps_make():
    x, y, heading = 0.3, -0.2, 0.4
    for _ in range(100_000):
        x, y, heading = x + 0.7e-5 * math.cos(heading), y + 0.7e-5 * math.sin(heading), heading - 1.3e-5
    assert tracking.advance(0.3, -0.2, 0.4, 0.7, -1.3, 1.0) == pytest.approx((x, y, heading), abs=1e-5)
    assert tracking.advance(0.0, 0.0, math.pi / 2, 0.5, 0.0, 2.0) == pytest.approx((0.0, 1.0, math.pi / 2))


def test_curves_lead_where_they_should():
    for name, velocity in tracking.CURVES.items():
        path = tracking.curve(velocity)[0]
        assert path.shape == (161, 2) and (path[0] == 0).all(), name
    circle = tracking.curve(tracking.CURVES["circle, radius 1 m"])[0]
    np.testing.assert_allclose(np.linalg.norm(circle - (0, 1), axis=-1), 1.0, atol=1e-3)
    np.testing.assert_allclose(tracking.curve(tracking.CURVES["square"])[0, -1], 0, atol=1e-9)


def test_what_a_base_loses_while_it_gains_speed():
    """From standing to 0.5 m/s at 2.5 m/s²: half of v²/a, less what a call of the drive has already begun with."""
    path = tracking.curve(tracking.CURVES["straight"])[0]
    lost = path - tracking.follow(path, LIMO, True, 0.0)
    calls = 0.5 / 2.5 / 0.02  # until it has its speed
    expected = 0.02 * sum(0.5 - 0.05 * (i + 1) for i in range(round(calls)))
    np.testing.assert_allclose(lost[5:], np.tile([expected, 0.0], (len(lost) - 5, 1)), atol=1e-9)


def test_aside_does_not_count_what_is_late():
    path = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [2.0, 1.0]])
    assert tracking.aside(np.array([[0.0, 0.0], [0.3, 0.1], [0.9, -0.2], [1.9, 0.5]]), path) == pytest.approx(0.2)
    assert tracking.aside(path[[0, 0, 1, 1]], path) == 0


def test_feedback_takes_it_back():
    path = tracking.curve(tracking.CURVES["to the side"])[0]
    ends = [np.linalg.norm(path[-1] - tracking.follow(path, LIMO, True, gain)[-1]) for gain in (0.0, 1.0)]
    assert ends[0] > 0.3 and ends[1] < 1e-3


def test_a_sensor_that_sees_only_so_far():
    observation = torch.arange(18.0).reshape(1, 2, 9)
    observation[0, :, 6] = torch.tensor([0.5, 3.0])
    seen = out_of(observation, 2.0, keeps_direction=False)
    assert torch.equal(seen[0, 0], observation[0, 0]) and torch.equal(seen[0, 1, :6], observation[0, 1, :6])
    assert seen[0, 1, 6:].tolist() == [2.0, 0.0, 0.0]
    assert torch.equal(out_of(observation, 2.0, True)[..., 7:], observation[..., 7:])
