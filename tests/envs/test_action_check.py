import math

import pytest
import torch
from torchrl.envs import TransformedEnv, VmasEnv

from redig.envs import ActionCheck, make_env

REMEDY = r"clamp the policy's output to env\.action_spec"


def stepped(env, *values):
    state = env.reset()
    action = torch.zeros(2, 5, 2)
    action.view(-1)[: len(values)] = torch.tensor(values)
    return env.step(state.set(("agents", "action"), action))


@pytest.mark.parametrize(
    ("values", "count", "worst"),
    [
        ((math.nan,), 1, "nan"),
        ((0.5, math.inf, 1.5), 2, "inf"),
        ((1.25, -3.0, 0.9), 2, r"-3\.0"),
        ((1.0001,), 1, r"1\.0001"),
        ((4.0, math.nan), 2, "nan"),
    ],
)
def test_a_bad_action_is_refused_with_its_worst_value(values, count, worst):
    message = rf"\('agents', 'action'\): {count} of 20 numbers .*\[-1\.0, 1\.0\] \(worst: {worst}.*\); {REMEDY}"
    with pytest.raises(ValueError, match=message):
        stepped(make_env(2), *values)


def test_actions_up_to_the_bounds_pass_unchanged():
    values = (1.0, -1.0, 0.3)
    assert stepped(make_env(2), *values)["agents", "action"].flatten()[:3].tolist() == pytest.approx(values)


def test_the_bounds_are_those_of_the_spec():
    with pytest.raises(ValueError, match=r"1 of 20 .*\[-0\.5, 0\.5\] \(worst: 0\.75\)"):
        stepped(make_env(2, max_speed=0.5), 0.75)


def test_any_environment_and_key():
    env = TransformedEnv(VmasEnv("balance", num_envs=2, n_agents=3), ActionCheck(("agents", "action")))
    state = env.reset()
    with pytest.raises(ValueError, match=r"6 of 12 numbers"):
        env.step(state.set(("agents", "action"), torch.tensor([0.0, 2.0]).expand(2, 3, 2)))
