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


def torch_adam(action, value, steps, learning_rate, grad_norm):
    """What the authors of DIPO run, on actions in [-1, 1]."""
    action = action.clone().requires_grad_()
    optimizer = torch.optim.Adam([action], lr=learning_rate, eps=1e-5, maximize=True)
    for _ in range(steps):
        optimizer.zero_grad()
        value(action).sum().backward()
        if grad_norm is not None:
            torch.nn.utils.clip_grad_norm_([action], grad_norm)
        optimizer.step()
        action.data.clamp_(-1, 1)
    return action.detach()


@given(
    seed=st.integers(0, 10_000),
    steps=st.integers(0, 25),
    learning_rate=st.sampled_from([0.03, 0.3]),
    grad_norm=st.sampled_from([None, 0.2, 3.0]),
    slope=st.sampled_from([1e-6, 1.0, 1e3]),
)
@settings(max_examples=40, deadline=None)
def test_adam_is_torchs_own_with_bounds_after_each_step(seed, steps, learning_rate, grad_norm, slope):
    generator = torch.Generator().manual_seed(seed)
    action = 2 * torch.rand(4, 3, 2, generator=generator, dtype=torch.float64) - 1

    def steep(action):
        return slope * wavy(3 * action)

    refined = refine_actions(action, steep, LOW, HIGH, steps, learning_rate, grad_norm=grad_norm, optimizer="adam")
    expected = torch_adam(action, steep, steps, learning_rate, grad_norm)
    # torch's clipping divides by the norm plus 1e-6
    torch.testing.assert_close(refined, expected, atol=1e-5 if grad_norm else 1e-12, rtol=0)


@pytest.mark.parametrize("steps", [1, 4])
@pytest.mark.parametrize(
    "options",
    [{}, {"optimizer": "adam"}, {"max_norm": 0.2}, {"grad_norm": 0.3}, {"optimizer": "adam", "grad_norm": 0.3}],
)
def test_steps_are_in_half_ranges_of_the_action(steps, options):
    """The same task in metres and scaled to [-1, 1] has the same solution."""
    low, high = torch.tensor([-3.0, 10.0], dtype=torch.float64), torch.tensor([5.0, 10.5], dtype=torch.float64)
    middle, half = (low + high) / 2, (high - low) / 2
    scaled = 2 * torch.rand(6, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1
    expected = refine_actions(scaled, wavy, LOW, HIGH, steps, 0.1, **options)
    found = refine_actions(
        middle + half * scaled, lambda a: wavy((a - middle) / half), low, high, steps, 0.1, **options
    )
    torch.testing.assert_close(found, middle + half * expected)


@pytest.mark.parametrize("limit", [0.5, 50.0])
def test_the_gradients_limit_is_for_the_whole_batch(limit):
    slopes = torch.tensor([[3.0, 0.0], [0.0, 4.0]], dtype=torch.float64)  # of norm 5 together
    action = torch.zeros(2, 2, dtype=torch.float64)
    refined = refine_actions(action, lambda a: (a * slopes).sum(-1), LOW, HIGH, step_size=0.1, grad_norm=limit)
    torch.testing.assert_close(refined, 0.1 * slopes * min(1, limit / 5))


@pytest.mark.parametrize("steps", [1, 7])
@pytest.mark.parametrize("optimizer", ["sgd", "adam"])
def test_the_limit_holds_over_all_steps_and_keeps_the_direction_of_a_long_step(steps, optimizer):
    action = torch.zeros(50, 2, dtype=torch.float64)
    slope = torch.tensor([3.0, 4.0], dtype=torch.float64)
    refined = refine_actions(action, lambda a: a @ slope, LOW, HIGH, steps=steps, max_norm=0.1, optimizer=optimizer)
    direction = slope / 5 if optimizer == "sgd" else slope.sign() / 2**0.5  # Adam goes as far in each number
    torch.testing.assert_close(refined, (0.1 * direction).expand(50, 2), atol=1e-6, rtol=0)


def test_the_bounds_hold_and_no_gradient_is_kept():
    action = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
    refined = refine_actions(action, lambda a: 100 * a[..., 0] - 100 * a[..., 1], LOW, HIGH)
    torch.testing.assert_close(refined, torch.tensor([[1.0, -1.0]] * 3, dtype=torch.float64))
    assert not refined.requires_grad


def test_bounds_hold_exactly_in_the_users_units():
    low, high = torch.tensor([-0.1, 0.3]), torch.tensor([0.7, 0.9])
    refined = refine_actions(torch.full((5, 2), 0.5), lambda a: 1e4 * a.sum(-1), low, high)
    assert (refined == high).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": -1}, "steps: got -1, must be at least 0"),
        ({"step_size": -0.1}, "step_size: got -0.1, must be at least 0"),
        ({"step_size": float("nan")}, "step_size: got nan"),
        ({"max_norm": 0.0}, "max_norm: got 0.0, must be greater than 0 or None"),
        ({"grad_norm": -1.0}, "grad_norm: got -1.0, must be greater than 0 or None"),
        ({"optimizer": "lion"}, "optimizer: got 'lion', allowed are sgd, adam"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        refine_actions(torch.zeros(2, 2), wavy, LOW, HIGH, **options)
