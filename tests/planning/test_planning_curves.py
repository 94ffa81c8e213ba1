import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.planning.curves import resample, sample, smooth


@given(at=st.floats(-3, 12), seed=st.integers(0, 99))
@settings(max_examples=50, deadline=None)
def test_sample_is_linear_interpolation_and_goes_on_straight(at, seed):
    values = torch.randn(8, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.double)
    for column in (0, 1):
        y = values[:, column].numpy()
        if at < 0:
            expected = y[0] + at * (y[1] - y[0])
        elif at > 7:
            expected = y[-1] + (at - 7) * (y[-1] - y[-2])
        else:
            expected = np.interp(at, np.arange(8), y)
        assert sample(values, torch.tensor(at, dtype=torch.double))[column].item() == pytest.approx(expected, abs=1e-9)


def test_smooth_is_the_weighted_mean_by_a_double_loop():
    values, width = torch.randn(12, 3, 2, dtype=torch.double), 4
    weight = [1 + math.cos(math.pi * k / width) for k in range(-width + 1, width)]
    result = smooth(values, width)
    for i in range(width, 12 - width):
        total = sum(w * values[i + k] for w, k in zip(weight, range(-width + 1, width), strict=True))
        assert torch.allclose(result[i], total / sum(weight))


@pytest.mark.parametrize("half_window", [0, 1, 5, 50])
def test_smooth_leaves_ends_and_lines(half_window):
    curve = torch.randn(20, 2)
    assert torch.allclose(smooth(curve, half_window)[[0, -1]], curve[[0, -1]], atol=1e-6)
    line = torch.linspace(0, 3, 20).unsqueeze(-1) * torch.tensor([1.0, -2.0])
    assert torch.allclose(smooth(line, half_window), line, atol=1e-5)


def test_a_negative_window_is_named():
    with pytest.raises(ValueError, match="half_window: got -1"):
        smooth(torch.zeros(5), -1)


@given(seed=st.integers(0, 99), spacing=st.floats(0.02, 0.5))
@settings(max_examples=30, deadline=None)
def test_resampled_points_lie_on_the_line_at_equal_ways(seed, spacing):
    points = torch.randn(5, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.double)
    even = resample(points, spacing)
    assert torch.allclose(even[[0, -1]], points[[0, -1]])
    way = torch.cat([torch.zeros(1), points.diff(dim=0).norm(dim=-1).cumsum(0)]).numpy()
    at = np.linspace(0, way[-1], len(even))
    for column in (0, 1):
        assert np.allclose(even[:, column], np.interp(at, way, points[:, column].numpy()))
    assert way[-1] / (len(even) - 1) == pytest.approx(spacing, rel=0.5)
