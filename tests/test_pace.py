import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.deploy import ModulePolicy, RobotPolicy, RobotState
from redig.envs import make_env
from redig.evaluation import rollout_trajectories
from redig.pace import Paced
from redig.policy import PolicyConfig, build_policy, save_policy

# a linear schedule: the first step of a cosine one magnifies rounding, which differs between a team and one robot
CONFIG = PolicyConfig(observation_dim=9, sampling_steps=5, noise_ratio=0.0, hidden=(32, 32), schedule="linear")


@pytest.fixture(scope="module")
def policy():
    torch.manual_seed(0)
    return build_policy(CONFIG)


@pytest.mark.parametrize("pace", [0.5, 0.8])
def test_a_team_takes_the_same_path_in_more_time(policy, pace):
    """As many steps, each of them longer: at pace c, robots with c times the speed and c² times the acceleration."""
    same = {"n_robots": 3, "corridor_width": 1.5, "hold_steps": 1000}
    fast = make_env(4, dt=0.08, max_speed=1.0, max_acceleration=2.0, **same)
    slow = make_env(4, dt=0.08 / pace, max_speed=pace, max_acceleration=2.0 * pace**2, **same)
    expected = rollout_trajectories(policy, fast, seed=1, max_steps=40)
    found = rollout_trajectories(Paced(policy, pace), slow, seed=1, max_steps=40)
    assert (expected["position"][:, -1] - expected["position"][:, 0]).norm(dim=-1).mean() > 0.3  # they move
    torch.testing.assert_close(found["position"], expected["position"], atol=1e-3, rtol=0)
    torch.testing.assert_close(found["velocity"] / pace, expected["velocity"], atol=1e-3, rtol=0)


@set_exploration_type(ExplorationType.DETERMINISTIC)
def test_at_its_own_pace_nothing_changes_and_the_observation_stays(policy):
    team = TensorDict({"agents": {"observation": torch.randn(2, 5, 9)}}, [2])
    own, half = Paced(policy, 1.0)(team.clone()), Paced(policy, 0.5)(team.clone())
    torch.testing.assert_close(own["agents", "action"], policy(team.clone())["agents", "action"], atol=0, rtol=0)
    torch.testing.assert_close(half["agents", "observation"], team["agents", "observation"], atol=0, rtol=0)


@set_exploration_type(ExplorationType.DETERMINISTIC)
@settings(max_examples=10, deadline=None)
@given(pace=st.floats(0.2, 1.0), seed=st.integers(0, 2**16))
def test_one_robot_does_what_its_team_would(policy, tmp_path_factory, pace, seed):
    path = tmp_path_factory.mktemp("pace") / "policy.safetensors"
    save_policy(path, policy, CONFIG)
    torch.manual_seed(seed)
    observation = torch.randn(1, 4, 9)
    observation[..., 7:] = torch.nn.functional.normalize(observation[..., 7:], dim=-1)
    commands = Paced(policy, pace)(TensorDict({"agents": {"observation": observation}}, [1]))["agents", "action"][0]
    states = [RobotState.of_observation(f"robot_{i}", 0.0, row) for i, row in enumerate(observation[0].tolist())]
    robot = RobotPolicy(ModulePolicy(path), pace)
    for i, own in enumerate(states):
        np.testing.assert_allclose(robot(own, states[:i] + states[i + 1 :]), commands[i].detach(), atol=1e-5)


@pytest.mark.parametrize("pace", [0.0, -1.0, 1.5, float("nan")])
def test_a_bad_pace_is_named(policy, pace):
    with pytest.raises(ValueError, match="pace: got"):
        Paced(policy, pace)
    with pytest.raises(ValueError, match="pace: got"):
        RobotPolicy("none.onnx", pace)
