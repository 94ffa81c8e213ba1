import pytest
import torch

from redig.baselines import LeaderFollower, UncoordinatedPlanner, VirtualStructure
from redig.baselines.leader_follower import heading_of, wrapped
from redig.envs import formation_offsets, make_env
from redig.evaluation import evaluate, rollout_trajectories


@pytest.mark.parametrize(("formation", "n"), [("wedge", 5), ("circle", 5), ("line", 5), ("line", 4)])
def test_the_virtual_structure_brings_every_team_home_in_shape(formation, n):
    env = make_env(8, formation=formation, n_robots=n)
    metrics = evaluate(VirtualStructure(env.scenario), env, seed=7)
    assert metrics["team_success_rate"] == 1.0
    assert metrics["cfi_0.5"] > 0.97
    assert metrics["travel_time"] < 8.0
    assert metrics["jerk_mean"] < 1.5


def test_a_slower_structure_takes_longer():
    env = make_env(4)
    quick, slow = (evaluate(VirtualStructure(env.scenario, speed), env, seed=7) for speed in (None, 0.6))
    assert slow["travel_time"] > 1.3 * quick["travel_time"]
    assert slow["team_success_rate"] == 1.0


def test_uncoordinated_robots_go_where_their_own_plan_leads():
    env = make_env(4, corridor_width=3.0)
    metrics = evaluate(UncoordinatedPlanner(env.scenario), env, seed=7)
    assert metrics["team_success_rate"] == 1.0
    half = evaluate(UncoordinatedPlanner(env.scenario, speed=0.5), env, seed=7)
    assert half["travel_time"] > 1.6 * metrics["travel_time"]


def test_five_uncoordinated_robots_abreast_collide():
    env = make_env(8, formation="line")
    assert evaluate(UncoordinatedPlanner(env.scenario), env, seed=7)["success_rate"] < 0.5


def test_followers_hold_the_rigid_shape_where_there_is_room():
    env = make_env(4, corridor_width=4.0, corridor_length=1.0)
    track = rollout_trajectories(LeaderFollower(env.scenario), env, seed=7)["position"]
    desired = torch.cdist(env.scenario.offsets, env.scenario.offsets)
    assert (torch.cdist(track, track) - desired).abs().max() < 0.15


def test_followers_never_run_into_walls_that_stop_them():
    env = make_env(8)
    trajectories = rollout_trajectories(LeaderFollower(env.scenario), env, seed=7)
    assert trajectories["arrived"][:, -1, 0].all()  # the leader
    assert env.scenario.obstacle_map.signed_distance(trajectories["position"]).min() > env.scenario.radius - 1e-3


@pytest.mark.parametrize(("formation", "leader"), [("wedge", 0), ("line", 2), ("circle", 0)])
def test_the_leader_is_the_foremost_robot_in_the_middle(formation, leader):
    assert LeaderFollower(make_env(1, formation=formation).scenario).leader == leader


def test_the_leader_can_be_chosen():
    env = make_env(2, corridor_width=4.0)
    assert evaluate(LeaderFollower(env.scenario, leader=3), env, seed=7)["travel_time_teams"] == 1.0


@pytest.mark.parametrize("angle", [-3.0, -0.5, 0.0, 1.2, 3.1])
def test_heading_is_that_of_the_turned_formation(angle):
    offsets = formation_offsets("wedge", 5)
    turn = torch.tensor(angle)
    rotation = torch.stack([torch.stack([turn.cos(), turn.sin()]), torch.stack([-turn.sin(), turn.cos()])])
    assert heading_of(offsets @ rotation + 3.0, offsets).item() == pytest.approx(angle, abs=1e-5)
    assert wrapped(turn + 4 * torch.pi).item() == pytest.approx(angle, abs=1e-5)


@pytest.mark.parametrize(
    ("policy", "options", "message"),
    [
        (LeaderFollower, {"leader": 5}, "leader: got 5"),
        (LeaderFollower, {"speed": 1.5}, "speed: got 1.5"),
        (LeaderFollower, {"gain": 0.0}, "gain: got 0.0"),
        (UncoordinatedPlanner, {"speed": 0.0}, "speed: got 0.0"),
        (VirtualStructure, {"max_speed": 2.0}, "max_speed: got 2.0"),
        (VirtualStructure, {"clearance": -1.0}, "clearance: got -1.0"),
    ],
)
def test_bad_arguments_are_named(policy, options, message):
    with pytest.raises(ValueError, match=message):
        policy(make_env(1).scenario, **options)
