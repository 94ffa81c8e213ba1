import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from redig.objectives import MultiStep

REWARD, OBSERVATION, TERMINATED = ("agents", "reward"), ("agents", "observation"), ("agents", "terminated")


def trajectories(batch=2, length=6, n=3, seed=0, end=0.2, crash=0.2, flag=torch.float32):
    """Random pieces of trajectories; the observations count the steps, so that each can be told apart."""
    generator = torch.Generator().manual_seed(seed)

    def chance(probability, *shape):
        return torch.rand(*shape, generator=generator) < probability

    count = torch.arange(batch * length * n, dtype=torch.float32).view(batch, length, n, 1)
    reward = torch.randn(batch, length, n, 1, generator=generator)
    info = {"terminated": chance(crash, batch, length, n, 1).to(flag)}
    done = chance(end, batch, length, 1)
    following = {"agents": {"observation": count + 1000, "reward": reward, "info": info}, "done": done}
    agents = {"observation": count, "action": -count, "unused": count}
    return TensorDict(
        {"agents": agents, "next": following, "collector": {"traj_ids": count[..., 0, 0]}}, [batch, length]
    )


def plain_loop(data, n_steps, gamma):
    """Return, flag, next observation and window of each robot, by loops over everything."""
    batch, length = data.shape
    n = data["next", REWARD].shape[2]
    reward, observation = torch.zeros(batch, length, n, 1), torch.zeros(batch, length, n, 1)
    terminated, steps = (
        torch.zeros(batch, length, n, 1, dtype=torch.bool),
        torch.zeros(batch, length, n, 1, dtype=torch.long),
    )
    for b in range(batch):
        for t in range(length):
            end = t
            while end - t + 1 < n_steps and end + 1 < length and not data["next", "done"][b, end]:
                end += 1
            for i in range(n):
                alive = True
                for k in range(t, end + 1):
                    if alive:
                        reward[b, t, i] += gamma ** (k - t) * data["next", REWARD][b, k, i]
                        alive = data["next", "agents", "info", "terminated"][b, k, i].item() <= 0
                terminated[b, t, i] = not alive
                observation[b, t, i] = data["next", OBSERVATION][b, end, i]
                steps[b, t, i] = end - t + 1
    return reward, terminated, observation, steps


@settings(deadline=None)
@given(
    n_steps=st.integers(1, 9),
    gamma=st.floats(0, 1),
    length=st.integers(1, 7),
    n=st.integers(1, 4),
    seed=st.integers(0, 2**31),
    end=st.sampled_from([0.0, 0.2, 1.0]),
    crash=st.sampled_from([0.0, 0.2, 1.0]),
    flag=st.sampled_from([torch.float32, torch.bool, torch.int64]),
)
def test_equals_a_plain_loop(n_steps, gamma, length, n, seed, end, crash, flag):
    data = trajectories(2, length, n, seed, end, crash, flag)
    before = data.clone()
    out = MultiStep(n_steps, gamma)(data)
    reward, terminated, observation, steps = plain_loop(data, n_steps, gamma)
    torch.testing.assert_close(out["next", REWARD], reward)
    assert torch.equal(out["next", TERMINATED], terminated)
    assert torch.equal(out["next", "agents", "done"], terminated)
    assert torch.equal(out["next", OBSERVATION], observation)
    assert torch.equal(out["steps_to_next_obs"], steps)
    assert (data == before).all()


@settings(deadline=None)
@given(seed=st.integers(0, 2**31), gamma=st.floats(0, 1))
def test_window_of_one_step_is_the_transition_itself(seed, gamma):
    data = trajectories(seed=seed)
    out = MultiStep(1, gamma)(data)
    assert torch.equal(out["next", REWARD], data["next", REWARD])
    assert torch.equal(out["next", OBSERVATION], data["next", OBSERVATION])
    assert torch.equal(out["next", TERMINATED], data["next", "agents", "info", "terminated"] > 0)
    assert (out["steps_to_next_obs"] == 1).all()


def test_windows_get_shorter_toward_the_end_of_the_piece():
    out = MultiStep(3, 0.5)(trajectories(batch=1, length=5, end=0, crash=0))
    assert out["steps_to_next_obs"][0, :, 0, 0].tolist() == [3, 3, 3, 2, 1]


def test_window_ends_with_the_episode():
    data = trajectories(batch=1, length=5, end=0, crash=0)
    data["next", "done"][0, 2] = True
    out = MultiStep(3, 0.5)(data)
    assert out["steps_to_next_obs"][0, :, 0, 0].tolist() == [3, 2, 1, 2, 1]
    assert not out["next", TERMINATED].any()  # a time-out of the team: values are bootstrapped


def test_robot_that_terminates_takes_no_more_rewards_but_its_team_drives_on():
    data = trajectories(batch=1, length=3, n=2, end=0, crash=0)
    data["next", REWARD].fill_(1)
    data["next", "agents", "info", "terminated"][0, 1, 0] = 1
    out = MultiStep(3, 0.5)(data)
    assert out["next", REWARD][0, 0, :, 0].tolist() == [1.5, 1.75]
    assert out["next", TERMINATED][0, 0, :, 0].tolist() == [True, False]
    assert torch.equal(out["next", OBSERVATION][0, 0], data["next", OBSERVATION][0, 2])
    assert out["steps_to_next_obs"][0, 0, :, 0].tolist() == [3, 3]


def test_keeps_what_is_asked_for():
    data = trajectories()
    out = MultiStep(2, 0.9)(data)
    expected = {OBSERVATION, ("agents", "action"), "steps_to_next_obs"}
    expected |= {("next", "agents", key) for key in ("observation", "reward", "terminated", "done")}
    assert set(out.keys(True, True)) == expected
    assert torch.equal(out["agents", "action"], data["agents", "action"])
    more = MultiStep(2, 0.9, keep=[("agents", "unused"), "missing"], next_keys=[OBSERVATION, "done"])(data)
    assert set(more.select("agents", "next").keys(True, True)) - expected == {("agents", "unused"), ("next", "done")}


def test_other_keys_and_batch_shapes():
    data = trajectories()
    plain = TensorDict(
        {
            "state": data[OBSERVATION],
            "next": {
                "state": data["next", OBSERVATION],
                "r": data["next", REWARD],
                "crashed": data["next", "agents", "info", "terminated"],
                "over": data["next", "done"],
            },
        },
        data.shape,
    )
    renamed = MultiStep(
        3, 0.9, ["state"], ["state"], reward="r", robot_terminated="crashed", terminated="end", done="over"
    )
    expected = MultiStep(3, 0.9)(data)
    for shape in [(2, 6), (1, 2, 6)]:
        out = renamed(plain.reshape(shape)).reshape(2, 6)
        assert torch.equal(out["next", "r"], expected["next", REWARD])
        assert torch.equal(out["next", "end"], expected["next", TERMINATED])
        assert torch.equal(out["next", "done"], expected["next", TERMINATED])
        assert torch.equal(out["next", "state"], expected["next", OBSERVATION])
    assert torch.equal(renamed(plain[1])["next", "r"], expected["next", REWARD][1])


@pytest.mark.parametrize("n_steps", [0, -1])
def test_bad_window(n_steps):
    with pytest.raises(ValueError, match=f"n_steps: got {n_steps}, must be at least 1"):
        MultiStep(n_steps, 0.9)


@pytest.mark.parametrize("gamma", [-0.1, 1.1, float("nan")])
def test_bad_gamma(gamma):
    with pytest.raises(ValueError, match=rf"gamma: got {gamma}, must be in \[0, 1\]"):
        MultiStep(1, gamma)
