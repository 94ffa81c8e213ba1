import math

import numpy as np
import pytest

from redig.deploy.transport import BodyVelocity
from redig.envs import corridor
from redig.physics import PhysicsWorld
from redig.physics.live import LiveTeam

NAMES = ["robot_0", "robot_1"]


class Fake:
    """A network that keeps what it is told, and hands on what it is given once."""

    def __init__(self):
        self.told, self.given = {}, {}

    def publish(self, sensed):
        self.told[sensed.state.robot] = sensed

    def commands(self):
        given, self.given = self.given, {}
        return given


@pytest.fixture
def live():
    walls, network = corridor(), Fake()
    team = LiveTeam(PhysicsWorld(walls, 2), walls, NAMES, network)
    team.reset([[-3.0, 0.0], [-3.0, 0.8]], [0.0, 0.5], [[3.0, 0.0], [3.0, 0.8]], now=10.0)
    return team, network


def run(team, network, command, ticks, name="robot_0"):
    for k in range(ticks):
        if command is not None:
            network.given = {name: BodyVelocity(*command)}
        team.step(0.02, now=10.0 + 0.02 * (k + 1))


def test_robots_hear_what_the_world_is(live):
    team, network = live
    run(team, network, (0.5, 0.0, 0.4), 25)
    assert sorted(network.told) == NAMES
    for i, name in enumerate(NAMES):
        state, heading = network.told[name]
        state.check()
        assert state.stamp == pytest.approx(10.5) and state.goal == (3.0, 0.8 * i)
        np.testing.assert_allclose(state.position, team.world.position[i])
        np.testing.assert_allclose(state.velocity, team.world.velocity[i])
        assert heading == pytest.approx(team.world.heading[i])
    state, _ = network.told["robot_1"]  # the wall's corner is at (-1, 0.55)
    corner = np.array([-1.0, 0.8]) - state.position
    assert state.obstacle_distance == pytest.approx(np.linalg.norm(corner), rel=1e-3)


def test_robots_hear_a_smoothed_direction_if_their_policy_was_trained_with_one():
    walls, network = corridor(), Fake()
    team = LiveTeam(PhysicsWorld(walls, 1), walls, NAMES[:1], network, direction_smoothing=0.1)
    team.reset([[0.0, 0.05]], [0.0], [[3.0, 0.0]], now=10.0)  # of the two walls, the left one is nearer
    state, _ = network.told["robot_0"]
    state.check()
    assert state.obstacle_distance == pytest.approx(0.5, abs=1e-3)
    assert state.obstacle_direction == pytest.approx((0.0, 0.5), abs=1e-3)


def test_each_robot_carries_out_its_own_command(live):
    team, network = live
    run(team, network, (0.5, 0.0, 0.0), 50, name="robot_1")
    assert np.linalg.norm(team.world.velocity, axis=-1) == pytest.approx([0.0, 0.5], abs=0.02)


def test_a_robot_that_is_not_told_goes_on_for_a_while_and_then_stops(live):
    team, network = live
    run(team, network, (0.5, 0.0, 0.0), 50)
    run(team, network, None, 20)
    assert team.world.velocity[0, 0] == pytest.approx(0.5, abs=0.02)
    run(team, network, None, 40)
    assert team.world.velocity[0, 0] == pytest.approx(0.0, abs=0.02)


def test_limits_are_kept_and_sideways_is_not_for_wheels(live):
    team, network = live
    run(team, network, (0.0, 5.0, 0.0), 30)
    np.testing.assert_allclose(team.world.position[0], [-3.0, 0.0], atol=1e-3)
    run(team, network, (0.0, 0.0, 1e9), 50)
    assert team.world.yaw_rate[0] == pytest.approx(6.0, rel=0.05)


@pytest.mark.parametrize("forward", [math.nan, math.inf])
def test_a_command_that_is_not_finite_stops_the_robot(live, forward):
    team, network = live
    run(team, network, (0.5, 0.0, 0.0), 50)
    run(team, network, (forward, 0.0, 0.0), 30)
    assert team.world.velocity[0, 0] == pytest.approx(0.0, abs=0.02)


def test_what_is_recorded_is_what_was_told_and_what_is_carried_out(live):
    team, network = live
    run(team, network, (9.0, 0.3, -9.0), 25)
    assert team.sensed(10.5) == [network.told[name] for name in NAMES]
    assert team.commands == [BodyVelocity(1.2, 0.0, -6.0), BodyVelocity(0.0, 0.0, 0.0)]


def test_a_new_start_forgets_commands(live):
    team, network = live
    run(team, network, (0.5, 0.0, 0.0), 10)
    network.given = {"robot_0": BodyVelocity(1.0, 0.0, 0.0)}
    team.reset([[-3.0, 0.0], [-3.0, 0.8]], [0.0, 0.5], [[3.0, 0.0], [3.0, 0.8]], now=20.0)
    run(team, network, None, 20)
    np.testing.assert_allclose(team.world.position[0], [-3.0, 0.0], atol=1e-3)


def test_names_must_be_as_many_as_robots():
    walls = corridor()
    with pytest.raises(ValueError, match="robots: got 1 names for 2 robots"):
        LiveTeam(PhysicsWorld(walls, 2), walls, ["robot_0"], Fake())
