import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.envs import make_env
from redig.envs.dynamics import leave_walls, limit_norm, part_robots
from redig.envs.maps import ObstacleMap

RADIUS, DT = 0.1, 0.1


def far_away():
    return ObstacleMap(torch.tensor([[90.0, 90.0, 1.0, 1.0, 0.0, 0.0]]), gap=1.0, bounds=(-99, -99, 99, 99))


def team_at(*places, obstacle_map=None, **kwargs):
    """An environment with its robots put at ``places`` and at rest, and their state."""
    settings = {"formation": "line", "n_robots": len(places), "formation_width": 8.0, "start_distance": 20.0}
    if obstacle_map is not None:
        settings["obstacle_map"] = obstacle_map
    env = make_env(1, **{**settings, **kwargs})
    state = env.reset()
    for agent, place in zip(env.base_env.scenario.world.agents, places, strict=True):
        agent.set_pos(torch.tensor([place]), batch_index=None)
    return env, state


def drive(env, state, commands, steps):
    """Positions ``[steps, n, 2]`` under constant commands."""
    way = []
    for _ in range(steps):
        state["agents", "action"] = torch.tensor([commands])
        state = env.step(state)["next"]
        way.append(state["agents", "info", "position"][0])
    return torch.stack(way)


@pytest.mark.parametrize(("max_speed", "max_acceleration"), [(1.0, 2.0), (0.5, 1.0), (1.0, 20.0)])
def test_speed_and_acceleration_stay_within_their_limits(max_speed, max_acceleration):
    env = make_env(
        16,
        formation="line",
        n_robots=3,
        formation_width=40.0,
        start_distance=30.0,
        obstacle_map=far_away(),
        max_speed=max_speed,
        max_acceleration=max_acceleration,
    )
    env.set_seed(0)
    torch.manual_seed(0)
    rollout = env.rollout(40)
    start = rollout["agents", "observation"][:, :1, :, :2]
    position = torch.cat([start, rollout["next", "agents", "info", "position"]], 1)
    velocity = position.diff(dim=1) / DT
    velocity = torch.cat([torch.zeros_like(velocity[:, :1]), velocity], 1)
    acceleration = velocity.diff(dim=1) / DT
    assert rollout["next", "agents", "info", "collision"].sum() == 0
    assert velocity.norm(dim=-1).max() <= max_speed + 1e-3
    assert acceleration.norm(dim=-1).max() <= max_acceleration + 1e-2  # positions of 20 m carry 1e-6 m of rounding
    assert acceleration.norm(dim=-1).max() >= 0.9 * min(max_acceleration, max_speed / DT)


def test_a_command_within_reach_is_met_in_one_step():
    env, state = team_at((-20.0, -4.0), (-20.0, 4.0), obstacle_map=far_away(), max_acceleration=2.0)
    way = drive(env, state, [[0.15, 0.1], [1.0, 0.0]], 2)
    torch.testing.assert_close(way[0, 0], torch.tensor([-20 + 0.015, -4 + 0.01]))
    torch.testing.assert_close(way[0, 1], torch.tensor([-20 + 0.02, 4.0]))  # 2 m/s^2 for one step
    torch.testing.assert_close(way[1, 1], torch.tensor([-20 + 0.06, 4.0]))


@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(0.1, 3))
@settings(deadline=None)
def test_limit_norm_shortens_without_turning(x, y, limit):
    found = limit_norm(torch.tensor([x, y], dtype=torch.float64), limit)
    scale = min(1.0, limit / max(math.hypot(x, y), 1e-12))
    torch.testing.assert_close(found, scale * torch.tensor([x, y], dtype=torch.float64))


@pytest.mark.parametrize("command", [(1.0, 0.0), (1.0, 1.0), (0.8, -0.6), (0.5, 0.9)])
def test_a_robot_driven_into_a_wall_stops_at_its_surface_and_slides(command):
    wall = ObstacleMap(torch.tensor([[-13.0, 0.0, 1.0, 9.0, 0.0, 0.0]]), gap=1.0, bounds=(-30, -30, 30, 30))
    env, state = team_at((-14.5, -5.0), (-14.5, 3.0), obstacle_map=wall)
    way = drive(env, state, [command, command], 20)
    distance = wall.signed_distance(way)
    assert distance.min() >= RADIUS - 1e-5
    torch.testing.assert_close(distance[-1], torch.full((2,), RADIUS), atol=1e-5, rtol=0)
    slide = (way[-1] - way[-2])[:, 1] / DT
    torch.testing.assert_close(slide, torch.full((2,), command[1] / max(1.0, math.hypot(*command))), atol=1e-4, rtol=0)


def test_a_crowd_in_the_corridor_is_kept_out_of_the_walls():
    env = make_env(32, formation="wedge", n_robots=5)
    torch.manual_seed(0)
    state = env.reset()
    nearest, met = [], 0
    for step in range(150):
        if step % 30 == 0:
            command = 2 * torch.rand(32, 5, 2) - 1
            command[..., 0] = command[..., 0].abs()
        state["agents", "action"] = command
        state = env.step(state)["next"]
        nearest.append(env.base_env.scenario.obstacle_map.signed_distance(state["agents", "info", "position"]))
        met += (state["agents", "info", "robot_collision"] > 0).sum().item()
    nearest = torch.cat(nearest)
    assert nearest.min() >= RADIUS - 1e-5
    assert ((nearest < RADIUS + 1e-4).sum() > 100) and met > 100  # walls and teammates were indeed met


@given(st.floats(0.001, 0.3), st.floats(-math.pi, math.pi), st.integers(0, 1000))
@settings(max_examples=60, deadline=None)
def test_two_overlapping_robots_end_touching_about_the_same_centre(gap, angle, seed):
    centre = torch.randn(2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    half = gap / 2 * torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    position = torch.stack([centre - half, centre + half])
    found, velocity = part_robots(position, torch.zeros(2, 2).double(), RADIUS)
    assert (found[1] - found[0]).norm().item() == pytest.approx(max(gap, 2 * RADIUS), abs=1e-9)
    torch.testing.assert_close(found.mean(0), centre)
    assert velocity.abs().max() == 0


@given(st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_contact_of_two_robots_keeps_their_momentum_and_ends_their_approach(seed):
    generator = torch.Generator().manual_seed(seed)
    position = 0.06 * torch.randn(2, 2, generator=generator, dtype=torch.float64)
    velocity = torch.randn(2, 2, generator=generator, dtype=torch.float64)
    _, after = part_robots(position, velocity, RADIUS)
    apart = position[1] - position[0]
    closing, closing_after = ((v[1] - v[0]) @ apart / apart.norm() for v in (velocity, after))
    torch.testing.assert_close(after.sum(0), velocity.sum(0))
    assert closing_after.item() == pytest.approx(
        max(closing.item(), 0) if apart.norm() < 2 * RADIUS else closing.item()
    )


def test_robots_apart_from_walls_and_each_other_are_left_alone():
    position, velocity = torch.tensor([[0.0, 0.0], [0.21, 0.0], [0.0, 5.0]]), torch.randn(3, 2)
    distance, direction = torch.full((3,), RADIUS + 1e-3), torch.tensor([[0.0, 1.0]] * 3)
    torch.testing.assert_close(part_robots(position, velocity, RADIUS), (position, velocity), atol=0, rtol=0)
    found = leave_walls(position, velocity, RADIUS, distance, direction)
    torch.testing.assert_close(found, (position, velocity), atol=0, rtol=0)


def test_contact_with_a_wall_takes_only_the_motion_into_it():
    position, distance = torch.zeros(3, 2) + torch.arange(3.0)[:, None], torch.full((3,), 0.04)
    direction = torch.tensor([[0.6, 0.8]] * 3)
    along = torch.tensor([0.8, -0.6])
    velocity = torch.stack([0.5 * direction[0] + 0.3 * along, -0.5 * direction[0] + 0.3 * along, 0.3 * along])
    found, after = leave_walls(position, velocity, RADIUS, distance, direction)
    torch.testing.assert_close(found, position - 0.06 * direction)
    torch.testing.assert_close(after, torch.stack([0.3 * along, velocity[1], velocity[2]]))


@pytest.mark.parametrize("speed", [0.3, 0.6])
def test_robots_driven_together_slowly_never_end_overlapping(speed):
    env, state = team_at((-20.0, -0.5), (-20.0, 0.5), obstacle_map=far_away())
    way = drive(env, state, [[0.0, speed], [0.0, -speed]], 30)
    gap = (way[:, 1] - way[:, 0])[:, 1]
    assert gap.min() >= 2 * RADIUS - 1e-4
    assert gap[-1] <= 2 * RADIUS + 1e-4


@pytest.mark.parametrize("start", [0.5, 0.501, 0.53])
def test_robots_driven_head_on_at_full_speed_never_end_overlapping(start):
    env, state = team_at((-20.0, -start), (-20.0, 0.5), obstacle_map=far_away())
    way = drive(env, state, [[0.0, 1.0], [0.0, -1.0]], 30)
    assert (way[:, 1] - way[:, 0])[:, 1].min() >= 2 * RADIUS - 1e-4
