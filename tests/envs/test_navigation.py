import math
from itertools import pairwise

import pytest
import torch
from torchrl.envs import check_env_specs

from redig.envs import curve, formation_offsets, make_env, pairwise_distances
from redig.envs.formation_reward import FORMATION_REWARDS
from redig.envs.maps import ObstacleMap
from redig.envs.rewards import best_lateral_scale

PARTS = ("navigation_reward", "formation_reward", "arrival_reward", "collision_reward")


def open_map():
    return ObstacleMap(torch.tensor([[90.0, 90.0, 1.0, 1.0, 0.0, 0.0]]), gap=1.0, bounds=(-99, -99, 99, 99))


def short_trip(num_envs=1, **kwargs):
    """A team half a metre from its goals, with no obstacle near and no jitter."""
    still = {"position_jitter": 0.0, "heading_jitter": 0.0, "start_distance": 0.25}
    return make_env(num_envs, **{"obstacle_map": open_map(), **still, **kwargs})


def put(env, robot, position):
    env.base_env.scenario.world.agents[robot].set_pos(torch.tensor([position]), batch_index=None)


def step(env, state, action):
    return env.step(state.clone().set(("agents", "action"), action))["next"]


def info_of(state):
    """The robots' info, scalars as ``[*B, n]``."""
    return state["agents", "info"].apply(lambda value: value.squeeze(-1) if value.shape[-1] == 1 else value)


def towards_goal(state, gain=2.0):
    return (gain * state["agents", "observation"][..., 4:6]).clamp(-1, 1)


def run(env, steps, policy=towards_goal):
    """What each of ``steps`` steps led to, stacked along time."""
    state, states = env.reset(), []
    for _ in range(steps):
        state = step(env, state, policy(state))
        states.append(state)
    return torch.stack(states, 1)


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"formation": "wedge", "n_robots": 4, "observe_direction": False},
        {"formation": "line", "n_robots": 2, "formation_reward": "scaled", "navigation_reward": "progress"},
        {"formation": "line", "n_robots": 7, "formation_reward": "none"},
        {"formation": "circle", "n_robots": 3, "formation_reward": "spring_damper_bonus", "observe_direction": False},
        {"formation": "circle", "n_robots": 6, "formation_reward": "scaled", "collision_terminates": True},
        {"formation": "wedge", "n_robots": 9, "proximity_penalty": 1.0, "navigation_reward": "progress"},
        {"corridor_angle": 0.8, "arrival_terminates": False},
    ],
)
def test_specs_are_what_the_environment_returns(arguments):
    env = make_env(2, **arguments)
    check_env_specs(env, seed=0)
    width = 9 if arguments.get("observe_direction", True) else 7
    assert env.reset()["agents", "observation"].shape == (2, arguments.get("n_robots", 5), width)


@pytest.mark.parametrize("formation_reward", FORMATION_REWARDS)
@pytest.mark.parametrize("navigation_reward", ["goal_speed", "progress"])
def test_the_reward_is_the_sum_of_its_parts(formation_reward, navigation_reward):
    env = make_env(
        8, formation_reward=formation_reward, navigation_reward=navigation_reward, proximity_penalty=0.5, omega=0.8
    )
    torch.manual_seed(0)
    rollout = run(env, 60, lambda state: torch.tensor([1.0, 0.0]) + towards_goal(state).clamp(-1, 0))
    info = info_of(rollout)
    total = sum(info[part] for part in PARTS)
    torch.testing.assert_close(rollout["agents", "reward"].squeeze(-1), total)
    assert info["navigation_reward"].abs().sum() > 0
    assert (info["formation_reward"].abs().sum() > 0) == (formation_reward != "none")
    assert info["collision_reward"].abs().sum() > 0


def test_reward_weights_and_variants_against_positions_and_velocities():
    def rollout(pace=1.0, **kwargs):
        return info_of(run(short_trip(2, arrival_bonus=3.0, **kwargs), 12, lambda state: pace * towards_goal(state)))

    paces = torch.tensor([1.0, 0.2, 0.5, 0.7, 0.9]).unsqueeze(-1)  # so that shape and speeds differ

    desired = pairwise_distances(formation_offsets("wedge", 5))
    info = rollout(paces, formation_weight=0.25, omega=0.7)
    position, velocity = info["position"], info["velocity"]
    spring, damper = (desired - pairwise_distances(position)).abs(), pairwise_distances(velocity)
    team = -0.25 * (0.7 * spring + 0.3 * damper).sum((-2, -1))
    torch.testing.assert_close(info["formation_reward"], team.unsqueeze(-1).expand(-1, -1, 5), atol=1e-5, rtol=0)
    moving = 1 - info["arrived"].roll(1, 1).index_fill(1, torch.tensor([0]), 0)  # not arrived before this step
    goal = 0.25 * torch.tensor([1.0, 0.0]) + formation_offsets("wedge", 5)
    away = goal - position
    expected = (velocity * away / away.norm(dim=-1, keepdim=True)).sum(-1) * velocity.norm(dim=-1)
    torch.testing.assert_close(info["navigation_reward"], expected * moving, atol=1e-4, rtol=0)

    info = rollout(paces, formation_reward="spring_damper_bonus", formation_weight=0.25, omega=0.7)
    pairs = 1 - (desired - pairwise_distances(info["position"])).abs().clamp_max(1)
    pairs = pairs - 0.3 / 0.7 * pairwise_distances(info["velocity"])
    expected = 0.25 * (pairs.sum(-1) - 1) / 4  # less the pair of a robot with itself
    torch.testing.assert_close(info["formation_reward"], expected, atol=1e-5, rtol=0)

    info = rollout(formation_reward="scaled", formation_weight=0.25)  # the team moves as one, in formation
    torch.testing.assert_close(info["formation_reward"], torch.full((2, 12, 5), 0.25), atol=1e-3, rtol=0)

    for tolerance in (0.1, 0.5):  # robots of different paces leave their places by up to 0.18 m
        info = rollout(paces, formation_reward="scaled", formation_weight=0.25, formation_tolerance=tolerance)
        ahead = torch.tensor([1.0, 0.0]).expand(*info["position"].shape[:-2], 2)
        scale, residual = best_lateral_scale(info["position"], formation_offsets("wedge", 5), ahead)
        expected = 1 - (residual / tolerance).clamp_max(1) - 0.5 * (1 - scale).clamp_min(0).unsqueeze(-1)
        torch.testing.assert_close(info["formation_reward"], 0.25 * expected, atol=1e-4, rtol=0)

    info = rollout(navigation_reward="progress")
    gained = (info["navigation_reward"] * 0.1).sum(1)
    assert ((gained > 0.4) & (gained <= 0.5)).all()  # half a metre, less what is left at arrival
    costly = rollout(navigation_reward="progress", time_cost=0.5)
    assert info["arrived"].any()
    moving = 1 - info["arrived"].roll(1, 1).index_fill(1, torch.tensor([0]), 0)
    torch.testing.assert_close(costly["navigation_reward"], info["navigation_reward"] - 0.5 * moving)


def test_the_arrival_bonus_is_paid_once_and_the_robot_then_holds_whatever_its_command():
    env = short_trip(3, arrival_bonus=7.0, hold_steps=999)
    generator = torch.Generator().manual_seed(0)

    def policy(state):
        arrived = state["agents", "info", "arrived"] > 0
        wild = torch.rand(3, 5, 2, generator=generator).round() * 2 - 1
        return torch.where(arrived, wild, towards_goal(state))

    rollout = run(env, 80, policy)
    info = info_of(rollout)
    assert torch.equal(info["arrival_reward"].sum(1), torch.full((3, 5), 7.0))
    assert ((info["arrival_reward"] == 0) | (info["arrival_reward"] == 7)).all()
    assert torch.equal(info["arrival_reward"].argmax(1), info["arrived"].argmax(1))
    assert torch.equal(info["arrived"], info["arrived"].cummax(1).values)
    after = info["arrived"].cumsum(1) > 30
    assert after.any()
    assert rollout["agents", "observation"][..., 4:6].norm(dim=-1)[after].max() < 1e-2
    assert info["velocity"].norm(dim=-1)[after].max() < 1e-2
    assert (info["navigation_reward"] * (info["arrived"].cumsum(1) > 1)).abs().max() == 0


@pytest.mark.parametrize("hold_steps", [1, 10])
def test_the_episode_ends_when_the_team_has_held_for_hold_steps(hold_steps):
    rollout = run(short_trip(2, hold_steps=hold_steps), 40)
    whole = info_of(rollout)["arrived"].amin(-1)
    first = whole.argmax(1)
    done = rollout["terminated"].squeeze(-1)
    assert whole.amax(1).all()
    assert torch.equal(done.int().argmax(1), first + hold_steps - 1)


@pytest.mark.parametrize("arrival_terminates", [True, False])
def test_terminated_of_a_robot_follows_its_arrival(arrival_terminates):
    info = info_of(run(short_trip(arrival_terminates=arrival_terminates), 25))
    assert info["arrived"].amax() == 1
    assert torch.equal(info["terminated"], info["arrived"] * arrival_terminates)


def touching_wall(**kwargs):
    """Robot 0 drives into a wall, robots 1 and 2 do not."""
    wall = ObstacleMap(torch.tensor([[-20.0, 0.0, 1.0, 9.0, 0.0, 0.0]]), gap=1.0, bounds=(-99, -99, 99, 99))
    env = make_env(
        1, formation="line", n_robots=3, formation_width=8.0, start_distance=40.0, obstacle_map=wall, **kwargs
    )
    state = env.reset()
    for robot, place in enumerate([(-21.11, 0.0), (-30.0, 0.0), (-40.0, 0.0)]):
        put(env, robot, place)
    return info_of(step(env, state, torch.tensor([[1.0, 0.0]]).expand(1, 3, 2)))


def touching_mate(**kwargs):
    """Robots 0 and 1 drive into each other, robot 2 is away."""
    env = short_trip(formation="line", n_robots=3, **kwargs)
    state = env.reset()
    for robot, place in enumerate([(30.0, 0.0), (30.201, 0.0), (40.0, 0.0)]):
        put(env, robot, place)
    return info_of(step(env, state, torch.tensor([[[1.0, 0.0], [-1.0, 0.0], [0.0, 0.0]]])))


@pytest.mark.parametrize("terminates", [True, False])
def test_collisions_with_a_wall_and_with_a_robot_are_told_apart(terminates):
    settings = {"collision_terminates": terminates, "collision_penalty": 4.0}
    wall, mate = touching_wall(**settings), touching_mate(**settings)
    for info, flagged, other, hit in (
        (wall, "wall_collision", "robot_collision", [1.0, 0.0, 0.0]),
        (mate, "robot_collision", "wall_collision", [1.0, 1.0, 0.0]),
    ):
        assert info[flagged][0].tolist() == hit
        assert info["collision"][0].tolist() == hit
        assert not info[other].any()
        assert info["collision_reward"][0].tolist() == [-4.0 * x for x in hit]
        assert info["terminated"][0].tolist() == [terminates * x for x in hit]


def test_the_proximity_ramp_is_charged_before_contact():
    env = short_trip(formation="line", n_robots=2, proximity_penalty=2.0, proximity_margin=0.1, max_acceleration=0.001)
    state = env.reset()
    put(env, 0, (30.0, 0.0))
    put(env, 1, (30.25, 0.0))  # 0.05 m of free space
    info = info_of(step(env, state, torch.zeros(1, 2, 2)))
    torch.testing.assert_close(info["collision_reward"], torch.full((1, 2), -1.0), atol=1e-3, rtol=0)
    assert not info["collision"].any()


@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_observations_are_the_documented_numbers(angle):
    env = make_env(4, corridor_angle=angle, seed=2)
    torch.manual_seed(0)
    state = env.rollout(25)[:, -1]["next"]
    scenario, observation, info = env.base_env.scenario, state["agents", "observation"], info_of(state)
    torch.testing.assert_close(observation[..., 0:2], torch.stack([a.state.pos for a in scenario.world.agents], 1))
    torch.testing.assert_close(observation[..., 2:4], torch.stack([a.state.vel for a in scenario.world.agents], 1))
    torch.testing.assert_close(observation[..., 4:6], scenario.goal - observation[..., 0:2])
    distance, direction = scenario.obstacle_map.nearest(observation[..., 0:2])
    torch.testing.assert_close(observation[..., 6], distance)
    torch.testing.assert_close(observation[..., 7:9], direction)
    torch.testing.assert_close(info["position"], observation[..., 0:2])
    torch.testing.assert_close(info["velocity"], observation[..., 2:4])
    torch.testing.assert_close(info["pairwise_distance"], torch.cdist(info["position"], info["position"]))


def test_without_direction_the_other_seven_numbers_stay():
    full, short = (
        make_env(3, seed=5, observe_direction=flag).reset()["agents", "observation"] for flag in (True, False)
    )
    assert torch.equal(full[..., :7], short)


@pytest.mark.parametrize("angle", [0.0, math.pi / 2])
def test_start_and_goal_are_the_formation_on_either_side_within_the_jitter(angle):
    env = make_env(200, corridor_angle=angle, start_distance=3.0, position_jitter=0.2, heading_jitter=0.1)
    observation = env.reset()["agents", "observation"]
    along = torch.tensor([math.cos(angle), math.sin(angle)])
    across = torch.tensor([-math.sin(angle), math.cos(angle)])
    desired = pairwise_distances(formation_offsets("wedge", 5))
    assert not observation[..., 2:4].any()
    start = observation[..., 0:2]
    for place, side in ((start, -3.0), (start + observation[..., 4:6], 3.0)):
        centre = place.mean(1)
        torch.testing.assert_close(pairwise_distances(place), desired.expand(200, 5, 5), atol=1e-4, rtol=0)
        for jitter in (centre @ along - side, centre @ across):
            assert 0.15 < jitter.abs().max() <= 0.2 + 1e-4
        apex = place[:, 0] - centre  # the apex points along the heading
        heading = torch.atan2(apex @ across, apex @ along)
        assert 0.08 < heading.abs().max() <= 0.1 + 1e-4


def test_a_corridor_along_y_is_crossed_along_y():
    env = make_env(2, corridor_angle=math.pi / 2, position_jitter=0.0, heading_jitter=0.0)
    state = env.reset()
    torch.testing.assert_close(env.base_env.scenario.direction, torch.tensor([[0.0, 1.0]]).expand(2, 2))
    to_goal = state["agents", "observation"][..., 4:6]
    torch.testing.assert_close(to_goal, torch.tensor([0.0, 5.5]).expand(2, 5, 2), atol=1e-5, rtol=0)
    left = state["agents", "observation"][:, 1, 0] - state["agents", "observation"][:, 0, 0]
    torch.testing.assert_close(left, torch.full((2,), -0.5))  # robot 1 is on the left, which is -x when driving along y


def test_direction_is_the_heading_of_the_goal_formation():
    env = make_env(20, heading_jitter=0.3)
    observation = env.reset()["agents", "observation"]
    goal = observation[..., 0:2] + observation[..., 4:6]
    apex = goal[:, 0] - goal.mean(1)
    torch.testing.assert_close(
        env.base_env.scenario.direction, apex / apex.norm(dim=-1, keepdim=True), atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("angle", [math.pi / 2, 0.7, -2.0])
def test_rewards_do_not_depend_on_where_the_map_points(angle):
    turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    generator = torch.Generator().manual_seed(0)
    commands = 0.7 * (2 * torch.rand(50, 4, 5, 2, generator=generator) - 1) + torch.tensor([0.25, 0.0])
    commands = commands / commands.norm(dim=-1, keepdim=True).clamp_min(1.0)

    def rollout(angle, turn):
        arguments = {"formation_reward": "scaled", "navigation_reward": "progress", "proximity_penalty": 0.5}
        env = make_env(4, corridor_angle=angle, seed=3, start_distance=2.4, position_jitter=0.1, **arguments)
        state, rewards = env.reset(), []
        for command in commands:
            state = step(env, state, (command @ turn).clamp(-1, 1))
            rewards.append(state["agents", "reward"])
        return torch.stack(rewards), state["agents", "info", "position"]

    (expected, position), (found, turned) = rollout(0.0, torch.eye(2)), rollout(angle, turn)
    torch.testing.assert_close(turned, position @ turn, atol=1e-3, rtol=0)
    torch.testing.assert_close(found, expected, atol=1e-2, rtol=0)


def test_resetting_one_environment_leaves_the_others_untouched():
    env = make_env(3, seed=1)
    torch.manual_seed(0)
    before = env.rollout(10)[:, -1]["next"].exclude("reward").clone()
    scenario = env.base_env.scenario
    goal, velocity = scenario.goal.clone(), before["agents", "info", "velocity"].clone()
    before["_reset"] = torch.tensor([[False], [True], [False]])
    after = env.reset(before.clone())
    others = torch.tensor([0, 2])
    for key in (
        ("agents", "observation"),
        ("agents", "info", "position"),
        ("agents", "info", "velocity"),
        "step_count",
    ):
        assert torch.equal(after[key][others], before[key][others]), key
        assert not torch.equal(after[key][1], before[key][1]), key
    assert (after["agents", "info"][others] == before["agents", "info"][others]).all()
    assert torch.equal(scenario.goal[others], goal[others])
    assert not torch.equal(scenario.goal[1], goal[1])
    assert velocity[1].any()
    assert not after["agents", "info", "velocity"][1].any()
    assert after["step_count"].flatten().tolist() == [10, 0, 10]


def test_a_reset_environment_starts_its_arrivals_anew():
    env = short_trip(2, hold_steps=999)
    before = run(env, 25)[:, -1]
    assert before["agents", "info", "arrived"].all()
    before["_reset"] = torch.tensor([[True], [False]])
    held = env.base_env.scenario.held[1].item()
    after = env.reset(before.clone())
    assert held > 0
    assert env.base_env.scenario.held.tolist() == [0, held]
    assert not after["agents", "info", "arrived"][0].any()
    assert after["agents", "info", "arrived"][1].all()
    assert not step(env, after, torch.zeros(2, 5, 2))["agents", "info", "arrived"][0].any()


def test_a_saved_state_continues_as_if_nothing_had_happened():
    env = short_trip(2, hold_steps=15, start_distance=0.5)
    state = env.reset()
    commands = 2 * torch.rand(20, 2, 5, 2, generator=torch.Generator().manual_seed(0)) - 1
    for command in commands[:10]:
        state = step(env, state, command)
    saved = {key: value.clone() for key, value in env.base_env.scenario.state_dict().items()}

    def future(state):
        seen = []
        for command in commands[10:]:
            state = step(env, state, command)
            seen.append(state["agents"].clone())
        return torch.stack(seen)

    expected = future(state.clone())
    env.reset()
    env.base_env.scenario.load_state_dict(saved)
    found = future(state.clone())
    assert (expected == found).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"formation": "square"}, r"formation: got 'square'.*wedge, line, circle"),
        ({"n_robots": 1}, r"n_robots: got 1.*at least 3"),
        ({"n_robots": 1, "formation": "line"}, r"n_robots: got 1.*at least 2"),
        ({"formation_width": -1.0}, r"formation_width: got -1\.0"),
        ({"corridor_width": 0.2}, r"corridor_width: got 0\.2 m, too narrow.*radius 0\.1 m.*greater than 0\.2 m"),
        ({"corridor_length": 0.0}, r"corridor_length: got 0\.0"),
        ({"start_distance": 1.0}, r"start_distance: with 1\.0 m the start of robot \d lies inside a wall.*larger"),
        ({"formation_reward": "bonus"}, r"formation_reward: got 'bonus'.*spring_damper.*scaled"),
        ({"navigation_reward": "speed"}, r"navigation_reward: got 'speed'.*goal_speed, progress"),
        *(
            ({name: value}, f"{name}: got {value}, must be greater than 0")
            for name in ("radius", "dt", "max_speed", "max_acceleration", "goal_radius", "proximity_margin")
            for value in (0.0, math.nan)
        ),
        ({"formation_tolerance": 0.0}, r"formation_tolerance: got 0\.0, must be greater than 0"),
        ({"start_distance": -2.0}, r"start_distance: got -2\.0, must be greater than 0"),
        ({"max_speed": 1.5}, r"max_speed: got 1\.5 m/s, .* more than its radius \(0\.1 m\)"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_env(2, **arguments)


def test_a_goal_inside_a_wall_is_refused():
    goal_side = ObstacleMap(torch.tensor([[2.75, 0.0, 2.0, 2.0, 0.0, 0.0]]), gap=1.0, bounds=(-5, -5, 5, 5))
    with pytest.raises(ValueError, match=r"start_distance: .* the goal of robot \d lies inside a wall"):
        make_env(2, obstacle_map=goal_side)


def test_unknown_arguments_are_refused():
    with pytest.raises(TypeError, match=r"unknown argument.*FormationNavigation: corridor, speed"):
        make_env(2, speed=1.0, corridor=2.0)


def test_on_a_map_with_a_route_the_team_starts_and_ends_on_it():
    bend = curve(radius=3.0, turn=1.2)
    env = make_env(100, obstacle_map=bend, position_jitter=0.2, heading_jitter=0.1, start_distance=1.0)
    start = env.reset()["agents", "observation"][..., :2]
    goal, headings = env.base_env.scenario.goal, []
    for place, point in ((start, bend.route[0]), (goal, bend.route[-1])):
        centre = place.mean(1)
        assert 0.15 < (centre - point).norm(dim=-1).max() <= 0.2 * math.sqrt(2) + 1e-4
        apex = place[:, 0] - centre
        headings.append(torch.atan2(apex[:, 1], apex[:, 0]))
    for heading, expected in zip(headings, (-0.6, 0.6), strict=True):
        assert 0.08 < (heading - expected).abs().max() <= 0.1 + 1e-4


@pytest.mark.parametrize("turn", [1.2, -1.2])
def test_a_formation_that_turns_with_the_route_is_whole_all_along_it(turn):
    bend = curve(radius=3.0, turn=turn, piece=0.1)
    still = {"position_jitter": 0.0, "heading_jitter": 0.0, "max_acceleration": 0.001}
    env = make_env(1, obstacle_map=bend, formation_reward="scaled", formation="line", n_robots=3, **still)
    state = env.reset()
    across = 0.3 * formation_offsets("line", 3)[:, 1:]  # squeezed to the least scale that the reward allows
    for a, b in pairwise(bend.route):
        along = (b - a) / (b - a).norm()
        left = torch.stack([-along[1], along[0]])
        for robot, offset in enumerate(across):
            put(env, robot, ((a + b) / 2 + offset * left).tolist())
        info = info_of(step(env, state, torch.zeros(1, 3, 2)))
        torch.testing.assert_close(info["formation_reward"], torch.full((1, 3), 1 - 0.5 * 0.7), atol=1e-2, rtol=0)


def test_a_goal_in_a_wall_at_the_end_of_a_route_is_refused():
    blocked = ObstacleMap(
        torch.tensor([[3.0, 0.0, 1.0, 1.0, 0.0, 0.0]]), 1.0, (-5, -5, 5, 5), torch.tensor([[-3.0, 0.0], [3.0, 0.0]])
    )
    with pytest.raises(ValueError, match=r"route: with it the goal of robot \d lies inside a wall"):
        make_env(2, obstacle_map=blocked)
