import pytest
import torch
from torchrl.envs import check_env_specs
from vmas.scenarios.balance import Scenario as Balance

from redig.envs import ActionCheck, make_env


def starts(**kwargs):
    return make_env(3, **kwargs).reset()["agents", "observation"]


@pytest.mark.parametrize("reward_scale", [1.0, 0.1])
def test_specs_are_what_the_environment_returns(reward_scale):
    check_env_specs(make_env(2, reward_scale=reward_scale), seed=0)


def test_the_seed_decides_the_starts():
    assert torch.equal(starts(seed=3), starts(seed=3))
    assert not torch.equal(starts(seed=3), starts(seed=4))


def test_rewards_are_scaled_and_nothing_else():
    rollouts = []
    for scale in (1.0, 0.1):
        env = make_env(2, seed=1, reward_scale=scale)
        torch.manual_seed(0)
        rollouts.append(env.rollout(4)["next"])
    plain, scaled = rollouts
    torch.testing.assert_close(scaled["agents", "reward"], 0.1 * plain["agents", "reward"])
    for key in (("agents", "observation"), ("agents", "info", "formation_reward")):
        torch.testing.assert_close(scaled[key], plain[key])


def test_a_time_out_truncates_and_does_not_terminate():
    rollout = make_env(2, max_steps=5).rollout(20)
    assert rollout.shape == (2, 5)
    assert rollout["next", "truncated"][:, -1].all()
    assert not rollout["next", "truncated"][:, :-1].any()
    assert not rollout["next", "terminated"].any()
    assert torch.equal(rollout["next", "done"], rollout["next", "truncated"])


def test_another_scenario_takes_the_same_wrapping():
    env = make_env(2, max_steps=3, scenario=Balance(), n_agents=4)
    assert env.rollout(9)["agents", "action"].shape == (2, 3, 4, 2)
    assert isinstance(env.transform[0], ActionCheck)


@pytest.mark.parametrize("arguments", [{"num_envs": 0}, {"num_envs": 2, "max_steps": 0}])
def test_counts_below_one_are_refused(arguments):
    name, value = list(arguments.items())[-1]
    with pytest.raises(ValueError, match=f"^{name}: got {value}, must be at least 1"):
        make_env(**arguments)
