import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs

from redig.checkpoint import collection_state, set_collection_state
from redig.envs import ActionDelay, ObservationNoise, make_env

OBSERVATION, ACTION, INFO = ("agents", "observation"), ("agents", "action"), ("agents", "info")


def random_policy():
    return TensorDictModule(lambda x: 2 * torch.rand(*x.shape[:-1], 2) - 1, [OBSERVATION], [ACTION])


def drive(env, actions):
    """Velocities [T, B, n, 2] after each of the actions [T, B, n, 2]."""
    data, velocities = env.reset(), []
    for action in actions:
        stepped, data = env.step_and_maybe_reset(data.set(ACTION, action))
        velocities.append(stepped["next", *INFO, "velocity"])
    return torch.stack(velocities)


@settings(max_examples=8, deadline=None)
@given(delay=st.integers(1, 3), seed=st.integers(0, 2**16))
def test_a_delayed_team_moves_as_one_that_was_told_later(delay, seed):
    torch.manual_seed(seed)
    actions = 2 * torch.rand(6, 2, 3, 2) - 1
    late = torch.cat([torch.zeros(delay, 2, 3, 2), actions])[:6]
    kwargs = {"n_robots": 3, "seed": seed}
    torch.testing.assert_close(
        drive(make_env(2, action_delay=(delay, delay), **kwargs), actions), drive(make_env(2, **kwargs), late)
    )


def test_the_recorded_action_is_the_one_given():
    env = make_env(2, action_delay=(1, 2))
    data = env.rollout(4, random_policy())
    torch.testing.assert_close(data["next", "past_actions"][:, :, 0], data[ACTION])


def test_delays_are_drawn_for_each_team_within_the_range_and_anew_at_a_reset():
    env = make_env(256, action_delay=(1, 3), n_robots=3)
    delays = torch.stack([env.reset()["action_delay"] for _ in range(2)])
    assert delays.unique().tolist() == [1, 2, 3]
    assert (delays[0] != delays[1]).any()


def test_a_reset_of_one_team_clears_its_commands_only():
    env = make_env(2, action_delay=(2, 2), n_robots=3)
    data = env.rollout(3, random_policy())[:, -1]["next"]
    before = data["past_actions"].clone()
    data["_reset"] = torch.tensor([[True], [False]])
    after = env.reset(data)["past_actions"]
    assert (after[0] == 0).all()
    torch.testing.assert_close(after[1], before[1])


def test_specs_hold():
    check_env_specs(make_env(2, action_delay=(0, 2), observation_noise=0.05, acceleration_range=(0.5, 1.0)))


def test_noise_has_the_stated_spread_and_leaves_the_task_alone():
    torch.manual_seed(0)
    env = make_env(1000, observation_noise=0.05, seed=1)
    data = env.reset()
    exact = make_env(1000, seed=1).reset()[OBSERVATION]
    error = data[OBSERVATION] - exact
    torch.testing.assert_close(error[..., 4:6], -error[..., :2], atol=1e-5, rtol=0)  # goal errs with the position
    assert (error[..., 7:] == 0).all()
    spread = error[..., [0, 1, 2, 3, 6]].reshape(-1, 5)
    torch.testing.assert_close(spread.std(0), torch.full((5,), 0.05), atol=0.003, rtol=0)
    torch.testing.assert_close(spread.T.corrcoef(), torch.eye(5), atol=0.06, rtol=0)
    torch.testing.assert_close(data[*INFO, "position"], exact[..., :2])


def test_acceleration_is_limited_for_each_team():
    torch.manual_seed(0)
    env = make_env(500, acceleration_range=(0.25, 0.75), max_acceleration=4.0, n_robots=3)
    data = env.reset()
    data = env.step(data.set(ACTION, torch.ones(500, 3, 2)))
    gained = data["next", *INFO, "velocity"].norm(dim=-1) / 0.1  # m/s²
    torch.testing.assert_close(gained, gained[:, :1].expand(-1, 3))  # one limit a team
    assert 1.0 <= gained.min() < 1.1
    assert 2.9 < gained.max() <= 3.0001


def test_a_collection_resumes_exactly():
    env = make_env(3, action_delay=(0, 2), acceleration_range=(0.5, 1.0), turn_gain=(2.0, 8.0), n_robots=3)
    collector = Collector(
        env, random_policy(), frames_per_batch=12, total_frames=-1, auto_register_policy_transforms=False
    )
    batches = iter(collector)
    next(batches)
    state, rng = collection_state(env, collector), torch.get_rng_state()
    expected = next(batches).clone()
    set_collection_state(env, collector, state)
    torch.set_rng_state(rng)
    again = next(batches)
    torch.testing.assert_close(again["next", *INFO, "position"], expected["next", *INFO, "position"])
    torch.testing.assert_close(again["next", "past_actions"], expected["next", "past_actions"])


@pytest.mark.parametrize("low, high", [(-1, 2), (2, 1), (0, 0)])
def test_bad_delays_are_refused(low, high):
    with pytest.raises(ValueError, match="action_delay"):
        ActionDelay(low, high)


@pytest.mark.parametrize("std", [0.0, -1.0, float("nan"), float("inf")])
def test_bad_noise_is_refused(std):
    with pytest.raises(ValueError, match="observation_noise"):
        ObservationNoise(std)


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (0.8, 0.5), (0.5, 1.5)])
def test_bad_acceleration_ranges_are_refused(bounds):
    with pytest.raises(ValueError, match="acceleration_range"):
        make_env(1, acceleration_range=bounds)
