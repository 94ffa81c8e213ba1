import math

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.envs import corridor
from redig.physics import Ground, PhysicsWorld, RobotBody

BODY = RobotBody()
G = 9.81


def alone(heading=0.0, x=-8.0, y=0.0, **kwargs):
    world = PhysicsWorld(corridor(), 1, **kwargs)
    world.reset([[x, y]], [heading])
    return world


def energy(world):
    mujoco.mj_energyPos(world.model, world.data)
    mujoco.mj_energyVel(world.model, world.data)
    return world.data.energy.sum()


def run(world, command, seconds, interval=0.1):
    for _ in range(round(seconds / interval)):
        world.step(command, interval)


@settings(max_examples=8, deadline=None)
@given(speed=st.floats(-1.0, 1.0).filter(lambda v: abs(v) > 0.05), heading=st.floats(-3, 3))
def test_driving_straight_covers_speed_times_time(speed, heading):
    world = alone(heading)
    run(world, [[speed, 0.0]], 1.0)
    start = world.position[0]
    run(world, [[speed, 0.0]], 2.0)
    along = (world.position[0] - start) @ [math.cos(heading), math.sin(heading)]
    assert along == pytest.approx(2 * speed, rel=0.01)
    assert np.linalg.norm(world.position[0] - start) == pytest.approx(abs(along), rel=5e-3)
    assert world.velocity[0] @ [math.cos(heading), math.sin(heading)] == pytest.approx(speed, rel=0.02)


@settings(max_examples=8, deadline=None)
@given(left=st.floats(-15, 15), right=st.floats(-15, 15))
def test_turning_rate_is_the_difference_of_wheel_speeds_over_the_track(left, right):
    world = alone()
    for _ in range(20):
        world.step_wheels([[left, right]])
    expected = BODY.wheel_radius * (right - left) / BODY.track
    assert world.yaw_rate[0] == pytest.approx(expected, rel=0.03, abs=0.02)


def test_a_command_of_speed_and_turn_drives_a_circle():
    world = alone()
    run(world, [[0.4, 1.0]], 1.0)
    path, headings = [], []
    for _ in range(40):
        world.step([[0.4, 1.0]])
        path.append(world.position[0])
        headings.append(world.heading[0])
    path = np.array(path)
    centre_and_term, *_ = np.linalg.lstsq(np.c_[2 * path, np.ones(40)], (path**2).sum(1), rcond=None)
    radius = math.sqrt(centre_and_term[2] + (centre_and_term[:2] ** 2).sum())
    assert radius == pytest.approx(0.4, rel=0.03)
    assert np.unwrap(headings)[-1] - headings[0] == pytest.approx(3.9, rel=0.03)


def test_a_wall_stops_a_robot_and_is_flagged_for_it_alone():
    world = PhysicsWorld(corridor(), 2)
    world.reset([[-1.5, 1.0], [-3.0, 0.0]], [0.0, 0.0])  # the wall begins at x = -1
    flags = []
    for _ in range(20):
        world.step([[0.5, 0.0], [0.5, 0.0]])
        flags.append(world.wall_contact.copy())
    assert not flags[0].any() and flags[-1].tolist() == [True, False]
    assert not world.robot_contact.any()
    assert world.position[0, 0] == pytest.approx(-1.1, abs=0.005)
    assert abs(world.velocity[0, 0]) < 0.02 and world.velocity[1, 0] > 0.45


def test_a_touch_within_a_step_is_flagged_though_it_is_over_at_its_end():
    world = alone(x=-1.098, y=1.0)
    world.step([[-0.5, 0.0]], 0.5)
    assert world.wall_contact.all() and world.position[0, 0] < -1.2
    world.step([[-0.5, 0.0]], 0.1)
    assert not world.wall_contact.any()


def test_robots_do_not_pass_through_each_other():
    world = PhysicsWorld(corridor(), 3)
    world.reset([[-4.0, 0.0], [-3.0, 0.0], [-3.5, 2.0]], [0.0, math.pi, 0.0])
    run(world, [[0.5, 0.0]] * 3, 2.0)
    assert world.robot_contact.tolist() == [True, True, False] and not world.wall_contact.any()
    assert np.linalg.norm(world.position[0] - world.position[1]) == pytest.approx(0.2, abs=0.005)


def test_torque_limits_acceleration():
    body = RobotBody(torque=0.05)
    world = alone(body=body)
    world.step_wheels([[100.0, 100.0]], 0.1)
    start = world.velocity[0, 0]
    world.step_wheels([[100.0, 100.0]], 0.2)
    wheel = 2 / 5 * 0.05 * body.mass  # an ellipsoid of a twentieth of the mass: its inertia about the axle over r²
    rolling_mass = body.mass + 2 * (wheel + 1e-5 / body.wheel_radius**2)
    expected = 2 * body.torque / body.wheel_radius / rolling_mass
    assert (world.velocity[0, 0] - start) / 0.2 == pytest.approx(expected, rel=0.1)


def test_slippery_ground_limits_acceleration_to_grip():
    world = alone(ground=Ground(friction=0.2))
    world.step_wheels([[100.0, 100.0]], 0.5)
    start = world.velocity[0, 0]
    world.step_wheels([[100.0, 100.0]], 0.5)
    assert (world.velocity[0, 0] - start) / 0.5 == pytest.approx(0.2 * G * 0.7, rel=0.1)  # casters bear 30 %


@pytest.mark.parametrize("share, climbs", [(0.8, False), (1.3, True)])
def test_a_ridge_takes_the_torque_that_its_slope_asks_for(share, climbs):
    ground = Ground(ridge_height=0.15)
    slope = math.atan(0.15)
    needed = BODY.mass * G * math.sin(slope) * BODY.wheel_radius / 2
    world = alone(x=-0.6, ground=ground, body=RobotBody(torque=share * needed))
    world.data.qpos[2] = 0.06  # on the slope
    world.data.qpos[3:7] = [math.cos(slope / 2), 0, -math.sin(slope / 2), 0]
    run(world, [[0.0, 0.0]], 0.2)
    start = world.position[0, 0]
    run(world, [[0.5, 0.0]], 1.5)
    assert (world.position[0, 0] > start + 0.05) == climbs


def test_a_ridge_lifts_robots_and_slows_them():
    flat, ridge = alone(x=-1.3), alone(x=-1.3, ground=Ground(ridge_height=0.15))
    heights = []
    for _ in range(25):
        for world in (flat, ridge):
            world.step([[0.5, 0.0]])
        heights.append(ridge.height[0])
    assert ridge.position[0, 0] < flat.position[0, 0] - 0.01
    run(ridge, [[0.5, 0.0]], 0.3)
    assert max(*heights, ridge.height[0]) == pytest.approx(0.15, abs=0.02)


def test_energy_comes_from_the_motors():
    world = alone()
    run(world, [[0.0, 0.0]], 0.5)  # settled
    before, work = energy(world), 0.0
    for _ in range(100):
        speed = world.wheel_speed.ravel()
        world.step([[0.8, 0.0]], world.timestep)
        work += world.data.actuator_force @ (speed + world.wheel_speed.ravel()) / 2 * world.timestep
    gained = energy(world) - before
    assert gained > 0.5 * BODY.mass * 0.75**2
    assert gained <= work <= 1.25 * gained


def test_a_robot_that_is_told_to_stand_stands():
    world = alone(x=-3.0, y=0.3)
    run(world, [[0.0, 0.0]], 0.5)
    start, before = world.position, energy(world)
    run(world, [[0.0, 0.0]], 5.0)
    np.testing.assert_allclose(world.position, start, atol=1e-6)
    assert energy(world) == pytest.approx(before, abs=1e-6)


def test_equal_commands_give_equal_motion_also_after_a_reset():
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1, 1, (20, 3, 2))
    start = [[-3.0, 0.0], [-3.2, 0.4], [-3.2, -0.4]]
    world, other = (PhysicsWorld(corridor(), 3) for _ in range(2))
    ends = []
    for each in (world, world, other):
        each.reset(start, [0.0, 0.3, -0.3])
        for command in commands:
            each.step(command)
        ends.append((each.position, each.velocity, each.heading))
    for end in ends[1:]:
        for one, another in zip(ends[0], end, strict=True):
            np.testing.assert_array_equal(one, another)
    assert world.time == pytest.approx(2.0)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda w: w.step([[1.0, 0.0, 0.0]]), r"command: got shape \[1, 3\], expected \[1, 2\]"),
        (lambda w: w.step([[float("nan"), 0.0]]), "command: .* must be finite"),
        (lambda w: w.step_wheels([[1.0, 0.0]], 0.001), "duration: got 0.001 s"),
        (lambda w: w.reset([[0.0, 0.0]], 0.0), r"heading: got shape \[\]"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(alone())
