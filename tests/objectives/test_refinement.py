import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.objectives import refine_actions

LOW, HIGH = torch.full((2,), -1.0, dtype=torch.float64), torch.full((2,), 1.0, dtype=torch.float64)


def wavy(action):
    return (2 * action).sin().sum(-1) + 0.3 * action.prod(-1)


@given(st.integers(0, 10_000), st.floats(0.01, 0.3))
@settings(max_examples=30, deadline=None)
def test_one_step_is_a_finite_difference_gradient_step(seed, step_size):
    action = 0.5 * torch.rand(4, 3, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    refined = refine_actions(action, wavy, LOW, HIGH, steps=1, step_size=step_size)
    h = 1e-6
    gradient = torch.stack(
        [(wavy(action + h * e) - wavy(action - h * e)) / (2 * h) for e in torch.eye(2, dtype=torch.float64)], -1
    )
    torch.testing.assert_close(refined, (action + step_size * gradient).clamp(-1, 1), atol=1e-7, rtol=0)


def test_steps_start_where_the_last_one_ended():
    action = torch.rand(5, 2, dtype=torch.float64)
    twice = refine_actions(refine_actions(action, wavy, LOW, HIGH), wavy, LOW, HIGH)
    torch.testing.assert_close(refine_actions(action, wavy, LOW, HIGH, steps=2), twice)


@pytest.mark.parametrize("steps", [1, 7])
def test_the_limit_holds_over_all_steps_and_keeps_the_direction_of_a_long_step(steps):
    action = torch.zeros(50, 2, dtype=torch.float64)
    slope = torch.tensor([3.0, 4.0], dtype=torch.float64)
    refined = refine_actions(action, lambda a: a @ slope, LOW, HIGH, steps=steps, max_norm=0.1)
    torch.testing.assert_close(refined, (0.1 * slope / 5).expand(50, 2))


def test_the_bounds_hold_and_no_gradient_is_kept():
    action = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
    refined = refine_actions(action, lambda a: 100 * a[..., 0] - 100 * a[..., 1], LOW, HIGH)
    torch.testing.assert_close(refined, torch.tensor([[1.0, -1.0]] * 3, dtype=torch.float64))
    assert not refined.requires_grad
