from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from redig.envs import make_env
from redig.evaluation import evaluate, rollout_trajectories
from redig.physics import PhysicsNavigation, RobotBody, base_of
from redig.policy import load_policy, read_header

OBSERVATION, ACTION, INFO = ("agents", "observation"), ("agents", "action"), ("agents", "info")
WEDGE = Path(__file__).parents[2] / "recipes/policies/wedge.safetensors"


def physics(num_envs=1, **kwargs):
    return make_env(num_envs, scenario=PhysicsNavigation(), **kwargs)


def constant(x, y):
    return TensorDictModule(lambda s: torch.tensor([x, y]).expand(*s.shape[:-1], 2), [OBSERVATION], [ACTION])


def test_starts_and_observations_are_those_of_the_scenario():
    kwargs = {"formation": "line", "n_robots": 3, "corridor_angle": 0.5}
    seen = []
    for env in (physics(3, **kwargs), make_env(3, **kwargs)):
        env.set_seed(7)
        seen.append(env.reset()[OBSERVATION])
    torch.testing.assert_close(seen[0], seen[1])


def test_what_is_observed_is_what_mujoco_says():
    env = physics(2, n_robots=3)
    seen = env.rollout(5, constant(0.8, 0.2))["next", OBSERVATION][:, -1]
    for i, team in enumerate(env.scenario.teams):
        np.testing.assert_allclose(seen[i, :, :2], team.position, atol=1e-5)
        np.testing.assert_allclose(seen[i, :, 2:4], team.velocity, atol=1e-5)
        goal = env.scenario.goal[i]
        np.testing.assert_allclose(seen[i, :, 4:6], goal - seen[i, :, :2], atol=1e-5)
        distance = env.scenario.obstacle_map.signed_distance(seen[i, :, :2])
        np.testing.assert_allclose(seen[i, :, 6], distance, atol=1e-5)


def test_robots_face_their_goals_and_turn_to_what_they_are_told():
    env = physics(n_robots=3)
    env.reset()
    team, goal = env.scenario.teams[0], env.scenario.goal[0].numpy()
    ahead = goal - team.position
    np.testing.assert_allclose(team.heading, np.arctan2(ahead[:, 1], ahead[:, 0]), atol=1e-6)
    env.rollout(20, constant(0.0, 0.5), auto_reset=True)
    np.testing.assert_allclose(team.heading, np.pi / 2, atol=0.1)
    np.testing.assert_allclose(team.velocity, [[0.0, 0.5]] * 3, atol=0.05)


def test_the_shipped_policy_brings_a_team_of_wheeled_robots_home():
    _, scenario = read_header(WEDGE)
    metrics = evaluate(load_policy(WEDGE), physics(2, **scenario), seed=1_000_011)
    assert metrics["team_success_rate"] == 1.0
    assert metrics["travel_time"] < 9.0
    assert metrics["cfi_0.5"] > 0.8


def test_walls_and_mates_are_told_apart():
    env = physics(n_robots=3, formation="line", formation_width=3.0)
    info = env.rollout(40, constant(0.9, 0.0), break_when_any_done=False)["next", *INFO]
    assert info["wall_collision"][0, -1, :, 0].tolist() == [1.0, 0.0, 1.0]  # only the middle one fits
    assert info["robot_collision"].sum() == 0
    torch.testing.assert_close(info["collision"], info["wall_collision"])


def test_a_robot_that_has_arrived_holds():
    env = physics(n_robots=3, corridor_width=5.0, heading_jitter=0.0)
    to_goal = TensorDictModule(lambda s: s[..., 4:6].clamp(-0.7, 0.7), [OBSERVATION], [ACTION])
    trajectories = rollout_trajectories(to_goal, env, seed=3)
    assert trajectories["arrived"][0, -1].all() and not trajectories["collision"].any()
    distance = (trajectories["position"][0, -1] - env.scenario.goal[0]).norm(dim=-1)
    assert distance.max() < 0.1


def test_a_reset_of_one_team_leaves_the_other():
    env = physics(2, n_robots=3)
    data = env.rollout(5, constant(0.5, 0.0), break_when_any_done=False)[:, -1]["next"]
    moving = env.scenario.teams[1].velocity
    data["_reset"] = torch.tensor([[True], [False]])
    data = env.reset(data)
    assert (env.scenario.teams[0].velocity == 0).all() and (data[OBSERVATION][0, :, 2:4] == 0).all()
    np.testing.assert_array_equal(env.scenario.teams[1].velocity, moving)
    assert np.linalg.norm(moving, axis=-1).min() > 0.4


def test_equal_seeds_give_equal_crossings():
    runs = [rollout_trajectories(constant(0.6, 0.1), physics(n_robots=3), seed=5, max_steps=10) for _ in range(2)]
    assert torch.equal(runs[0]["position"], runs[1]["position"])


def test_limits_of_the_drive_are_kept():
    env = physics(n_robots=3, max_acceleration=1.0, base=base_of(RobotBody(), 1.0, 1.0))
    velocity = env.rollout(8, constant(1.0, 0.0))["next", *INFO, "velocity"][0].norm(dim=-1)
    assert (velocity.diff(dim=0) / 0.1).max() < 1.3
    assert velocity[-1].min() == pytest.approx(0.8, abs=0.1)


def test_a_checkpoint_is_refused():
    with pytest.raises(NotImplementedError, match="cannot be put into a checkpoint"):
        physics().scenario.state_dict()


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"drive_interval": 0.03}, "drive_interval: got 0.03 s"),
        ({"body": RobotBody(radius=0.2)}, "body: got a radius of 0.2 m"),
        ({"n_robots": 1}, "n_robots: got 1"),
    ],
)
def test_bad_input_is_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        physics(**kwargs)
