"""Robots with wheels in VMAS, against the drive of the robots integrated in small steps."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.envs.utils import check_env_specs
from vmas.simulator.core import Agent, World

from redig.deploy import Base, DifferentialDrive
from redig.envs import TurningCommand, make_env
from redig.envs.turning import wrapped

INFO = ("agents", "info")


def robot(gain, **kwargs):
    world = World(1, torch.device("cpu"), dt=0.1, drag=0.0)
    limits = torch.tensor([[gain]]), torch.tensor([[2.0]])
    agent = Agent("agent_0", dynamics=TurningCommand(0.1, 1.0, *limits, **kwargs))
    world.add_agent(agent)

    def drive(command, steps):
        for _ in range(steps):
            agent.action.u = torch.tensor([command])
            agent.dynamics.process_action()
            world.step()
        return agent.state.pos[0], agent.state.vel[0], agent.dynamics.heading.item()

    return drive


def integrated(gain, command, seconds, dt=0.001):
    """The same by the drive that robots have, whose limits but those of speed and acceleration are out of the way.

    So narrow a base may turn faster by 4000 rad/s in a second; with a track of 5 cm it was late by 0.1 rad.
    """
    base = Base(0.2, 0.2, 0.001, 0.03, 1.0, 6.0, max_linear_acceleration=2.0, max_angular_acceleration=1e4)
    drive = DifferentialDrive(base, gain=gain, stop_speed=0.0)
    x = y = heading = linear = 0.0
    for _ in range(round(seconds / dt)):
        linear, angular = drive(command, heading, dt)
        heading += angular * dt
        x, y = x + linear * math.cos(heading) * dt, y + linear * math.sin(heading) * dt
    return torch.tensor([x, y]), linear, heading


@given(st.floats(2, 8), st.floats(-math.pi, math.pi), st.floats(0.2, 0.8), st.integers(1, 20))
@settings(max_examples=50, deadline=None)
def test_it_moves_as_the_drive_of_the_robots_does(gain, angle, speed, steps):
    if abs(abs(angle) - math.pi / 2) < 0.1:  # which way round is a matter of the last digit
        angle = 0.3
    command = (speed * math.cos(angle), speed * math.sin(angle))
    position, velocity, heading = robot(gain)(command, steps)
    expected, linear, exact = integrated(gain, command, 0.1 * steps)
    assert abs(wrapped(torch.tensor(heading - exact)).item()) < 0.06  # a step that begins at the limit of turning
    assert abs(velocity.norm().item() - abs(linear)) < 0.02
    assert (position - expected).norm() < 0.05 + 0.02 * steps * 0.1


def test_velocity_is_along_the_heading_and_within_the_limits():
    torch.manual_seed(0)
    env = make_env(50, turn_gain=(2.0, 8.0), n_robots=3, start_distance=6.0)
    data = env.rollout(20)
    heading = env.scenario.motion.state_dict()["heading"][..., 0]
    velocity = data["next", *INFO, "velocity"]
    last = velocity[:, -1]
    sideways = last[..., 1] * heading.cos() - last[..., 0] * heading.sin()
    assert sideways.abs().max() < 1e-5
    assert velocity.norm(dim=-1).max() <= 1.0 + 1e-5
    speed = velocity.norm(dim=-1)  # through zero where a robot changes between forwards and backwards
    assert (speed.diff(dim=1).abs() / 0.1).max() <= 2.0 + 1e-3


def test_a_turn_has_its_rate_and_its_limit():
    _, _, slow = robot(2.0)((0.0, 0.4), 1)
    assert abs(slow) == pytest.approx(math.pi / 2 * (1 - math.exp(-0.2)), rel=1e-4)
    _, _, limited = robot(8.0, max_turn=1.0)((0.0, 0.4), 1)
    assert abs(limited) == pytest.approx(0.1, rel=1e-4)


def test_noise_on_no_command_turns_nothing():
    _, velocity, heading = robot(8.0)((0.0, 0.0), 5)
    assert heading == 0 and velocity.abs().max() == 0


def test_robots_start_facing_their_goals_each_team_with_its_own_gain():
    torch.manual_seed(0)
    env = make_env(300, turn_gain=(2.0, 8.0), n_robots=3)
    data = env.reset()
    state = env.scenario.motion.state_dict()
    to_goal = data["agents", "observation"][..., 4:6]
    torch.testing.assert_close(state["heading"][..., 0], torch.atan2(to_goal[..., 1], to_goal[..., 0]))
    assert 2.0 <= state["gain"].min() < 2.2 and 7.8 < state["gain"].max() <= 8.0


def test_specs_hold():
    check_env_specs(make_env(2, turn_gain=(2.0, 8.0), acceleration_range=(0.5, 1.0)))


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (3.0, 2.0), (1.0, float("inf"))])
def test_bad_gains_are_refused(bounds):
    with pytest.raises(ValueError, match="turn_gain"):
        make_env(1, turn_gain=bounds)
