import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.deploy.drive import LIMO, WARTHOG, Base, DifferentialDrive

FREE = replace(LIMO, max_angular=100.0, max_linear_acceleration=math.inf, max_angular_acceleration=math.inf)
BASES = {"limo": LIMO, "warthog": WARTHOG, "free": FREE}
bases = st.sampled_from(list(BASES.values()))
finite = st.floats(allow_nan=False, allow_infinity=False)
moderate = st.floats(-3.0, 3.0)
headings = st.floats(-10.0, 10.0)


def turned(heading, angular, dt):
    return heading + angular * dt


def error_of(velocity, heading):
    return math.remainder(math.atan2(velocity[1], velocity[0]) - heading, 2 * math.pi)


@given(
    bases,
    st.booleans(),
    st.lists(
        st.tuples(st.one_of(finite, moderate), st.one_of(finite, moderate), st.one_of(finite, headings)), max_size=30
    ),
    st.sampled_from([1e-3, 0.05, 0.5]),
)
def test_no_limit_is_ever_exceeded(base, reverse, inputs, dt):
    drive, before = DifferentialDrive(base, reverse=reverse), (0.0, 0.0)
    for x, y, heading in inputs:
        linear, angular = drive((x, y), heading, dt)
        assert abs(linear) <= base.max_linear and abs(angular) <= base.max_angular
        left, right = base.wheel_speeds(linear, angular)
        assert max(abs(left), abs(right)) * base.wheel_radius <= base.max_linear * (1 + 1e-9)
        assert abs(linear - before[0]) <= base.max_linear_acceleration * dt * (1 + 1e-9)
        assert abs(angular - before[1]) <= base.max_angular_acceleration * dt * (1 + 1e-9)
        assert reverse or linear >= 0
        before = linear, angular


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_refused_and_changes_nothing(bad):
    drive, other = DifferentialDrive(LIMO), DifferentialDrive(LIMO)
    for each in (drive, other):
        each((0.5, 0.2), 0.0, 0.1)
    for velocity, heading in (((bad, 0.0), 0.0), ((0.0, bad), 0.0), ((0.5, 0.0), bad)):
        with pytest.raises(ValueError, match="velocity, heading: got .*, must be finite"):
            drive(velocity, heading, 0.1)
    for dt in (bad, 0.0, -0.1):
        with pytest.raises(ValueError, match="dt: got .*, must be greater than 0 s"):
            drive((0.5, 0.0), 0.0, dt)
    assert drive((0.5, 0.2), 0.0, 0.1) == other((0.5, 0.2), 0.0, 0.1)


@given(bases, st.floats(0.021, 2.0), st.floats(-1.7, 1.7), st.floats(-1e-4, 1e-4), st.floats(-1e-4, 1e-4))
def test_small_changes_of_the_vector_change_little(base, speed, angle, dx, dy):
    base = replace(base, max_linear_acceleration=math.inf, max_angular_acceleration=math.inf)
    outputs = []
    for change in ((0.0, 0.0), (dx, dy)):
        drive = DifferentialDrive(base)
        drive((1.0, 0.0), 0.0, 0.1)  # moving, forwards
        outputs.append(drive((speed * math.cos(angle) + change[0], speed * math.sin(angle) + change[1]), 0.0, 0.1))
    bound = 4.0 * (1 + 1.8) / 0.1 * math.hypot(dx, dy) + 1e-9  # of the direction, and of slowness times angle
    assert abs(outputs[1][1] - outputs[0][1]) <= bound
    assert abs(outputs[1][0] - outputs[0][0]) <= (1 + base.track / 2) * bound


@settings(deadline=None)
@given(bases, st.booleans(), headings, st.floats(-math.pi, math.pi), st.floats(0.1, 2.0), st.sampled_from([0.02, 0.1]))
def test_the_base_turns_to_the_vector_without_overshoot_and_stays(base, reverse, heading, angle, speed, dt):
    drive, velocity = DifferentialDrive(base, reverse=reverse), (speed * math.cos(angle), speed * math.sin(angle))
    start = abs(error_of(velocity, heading))
    way, total = min(start, math.pi - start) if reverse else start, 0.0
    seconds = 2.0 + way / min(base.max_angular, 1.0) + 4.0
    for step in range(int(seconds / dt)):
        linear, angular = drive(velocity, heading, dt)
        heading, total = turned(heading, angular, dt), total + abs(angular) * dt
        if step * dt > seconds - 1:
            error = abs(error_of(velocity, heading))
            assert min(error, math.pi - error) < 0.02 if reverse else error < 0.02
            assert abs(linear) == pytest.approx(min(speed, base.max_linear), rel=1e-2)
    assert total <= way + 0.1


@pytest.mark.parametrize("base", BASES.values(), ids=BASES)
@pytest.mark.parametrize("angle", [0.0, 90.0, 180.0])
@pytest.mark.parametrize("reverse", [False, True])
def test_noise_makes_no_limit_cycle(base, angle, reverse):
    """The vector jumps by 15° to either side of a direction, also of those where a decision is made."""
    generator, drive = np.random.default_rng(0), DifferentialDrive(base, reverse=reverse)
    heading, headings, signs = -math.radians(angle), [], []
    for _ in range(400):
        direction = math.radians(generator.uniform(-15, 15))
        linear, angular = drive((0.5 * math.cos(direction), 0.5 * math.sin(direction)), heading, 0.05)
        heading = turned(heading, angular, 0.05)
        headings.append(heading)
        signs.append(math.copysign(1.0, linear) if abs(linear) > 0.05 else 0.0)
    settled = np.abs([math.remainder(h, math.pi if reverse else 2 * math.pi) for h in headings[150:]])
    assert settled.max() < math.radians(15)
    assert len(set(signs) - {0.0}) == 1  # it has not gone back and forth


def test_noise_near_zero_does_not_move_it():
    generator, drive = np.random.default_rng(0), DifferentialDrive(LIMO)
    for _ in range(200):
        assert drive(tuple(0.014 * generator.uniform(-1, 1, 2)), 0.0, 0.05) == (0.0, 0.0)


def test_it_stops_below_one_speed_and_starts_above_another():
    drive = DifferentialDrive(replace(LIMO, max_linear_acceleration=math.inf))
    moves = [drive((speed, 0.0), 0.0, 0.05)[0] > 0 for speed in (0.01, 0.04, 0.06, 0.04, 0.021, 0.019, 0.04, 0.06)]
    assert moves == [False, False, True, True, True, False, False, True]


@given(st.floats(0.0, 0.1), st.floats(-1.2, 1.2))
def test_slow_vectors_turn_it_slowly(speed, angle):
    drive = DifferentialDrive(FREE)
    drive((1.0, 0.0), 0.0, 0.1)
    _, angular = drive((speed * math.cos(angle), speed * math.sin(angle)), 0.0, 0.1)
    assert abs(angular) <= 4.0 * abs(angle) * speed / 0.1 + 1e-9


def test_stop_is_at_once_and_forgets():
    drive = DifferentialDrive(LIMO)
    for _ in range(20):
        drive((-1.0, 0.3), 0.0, 0.1)
    assert drive.stop() == (0.0, 0.0)
    assert drive((0.3, 0.4), 0.0, 0.1) == DifferentialDrive(LIMO)((0.3, 0.4), 0.0, 0.1)
    drive((-1.0, 0.3), 0.0, 0.1)
    linear, _ = drive((0.0, 0.0), 0.0, 0.1)  # a zero vector slows down within the limits
    assert abs(linear) <= LIMO.max_linear_acceleration * 0.1


@pytest.mark.parametrize("reverse", [True, False])
def test_a_vector_behind(reverse):
    drive, velocity = DifferentialDrive(FREE, reverse=reverse), (-0.5, 0.0)
    linear, angular = drive(velocity, 0.1, 0.05)
    if reverse:
        assert linear == pytest.approx(-0.5 * math.cos(0.1)) and angular == pytest.approx(-0.4)
    else:
        assert linear == 0 and angular > 0


@given(bases, st.floats(-5, 5), st.floats(-4, 4))
def test_wheel_speeds_and_back(base, linear, angular):
    assert base.body_speeds(*base.wheel_speeds(linear, angular)) == pytest.approx((linear, angular), abs=1e-9)
    left, right = base.wheel_speeds(linear, angular)
    faster = max(abs(left), abs(right)) * base.wheel_radius
    assert base.wheel_limit(linear, angular) == pytest.approx(faster, abs=1e-9)
    assert right >= left if angular > 0 else left >= right


def test_a_wheel_in_a_turn_runs_on_its_own_circle():
    base = Base(0.3, 0.3, 0.4, 0.05, 1.0, 2.0)  # turning about a point 1 m to the left: circles of 0.8 m and 1.2 m
    left, right = base.wheel_speeds(0.5, 0.5)
    assert (left * 0.05 / 0.8, right * 0.05 / 1.2) == pytest.approx((0.5, 0.5))


@given(st.floats(0.2, 1.0), st.floats(0.2, 1.0), st.floats(-math.pi, math.pi))
def test_at_a_pace_a_drive_is_that_of_a_base_with_less_acceleration(pace, speed, angle):
    """... and that starts and stops at lower speeds."""
    slower = replace(
        LIMO,
        max_linear_acceleration=pace**2 * LIMO.max_linear_acceleration,
        max_angular_acceleration=pace**2 * LIMO.max_angular_acceleration,
    )
    paced = DifferentialDrive(LIMO, pace=pace)
    other = DifferentialDrive(slower, stop_speed=pace * 0.02, start_speed=pace * 0.05)
    for vector in [(speed * math.cos(angle), speed * math.sin(angle))] * 20 + [(0.03 * pace, 0.0)] * 5:
        assert paced(vector, 0.1, 0.05) == pytest.approx(other(vector, 0.1, 0.05))


def test_bases_and_settings_that_are_none():
    for name in ("track", "wheel_radius", "max_linear", "max_angular_acceleration"):
        for value in (0.0, -1.0, math.nan):
            with pytest.raises(ValueError, match=f"{name}: got {value}, must be greater than 0"):
                replace(LIMO, **{name: value})
    with pytest.raises(ValueError, match="gain: got 0.0"):
        DifferentialDrive(LIMO, gain=0.0)
    with pytest.raises(ValueError, match="stop_speed, start_speed: got 0.1, 0.05"):
        DifferentialDrive(LIMO, stop_speed=0.1)
    with pytest.raises(ValueError, match="pace: got 1.5"):
        DifferentialDrive(LIMO, pace=1.5)
