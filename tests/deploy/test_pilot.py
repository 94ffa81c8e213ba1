import logging
import math
from dataclasses import replace
from threading import Event

import pytest
from hypothesis import given
from hypothesis import strategies as st

from redig.deploy.messages import RobotState
from redig.deploy.pilot import Deadline, Pilot

STATE = RobotState("robot_0", 0.0, (0.0, 0.0), (0.5, 0.0), (5.0, 0.0), 1.0, (0.0, 1.0))


def pilot_of(policy, **options):
    pilot = Pilot("robot_0", ["robot_0", "robot_1"], policy, **options)
    pilot.sense(STATE, now=0.0)
    return pilot


def ahead(own, neighbours):
    return 0.5, 0.0


def test_policy_gets_own_state_and_neighbours():
    seen = []
    pilot = pilot_of(lambda own, neighbours: seen.append((own, list(neighbours))) or (0.5, 0.0))
    mate = replace(STATE, robot="robot_1")
    assert pilot.hear(mate, now=0.1)
    assert pilot.decide(now=0.1) == (0.5, 0.0)
    assert seen == [(STATE, [mate])]
    assert not pilot.hear(STATE, now=0.2)  # somebody else in its own name


def test_neighbours_that_are_lost_are_left_out():
    seen = []
    pilot = pilot_of(lambda own, neighbours: seen.append(len(neighbours)) or (0.5, 0.0), own_timeout=2.0)
    pilot.hear(replace(STATE, robot="robot_1"), now=0.0)
    for now in (0.4, 0.6):
        pilot.decide(now)
    assert seen == [1, 0]


def test_stands_while_its_own_state_is_stale_and_says_so_once(caplog):
    caplog.set_level(logging.INFO)
    pilot = pilot_of(ahead)
    assert pilot.decide(now=0.3) == (0.5, 0.0)
    assert {pilot.decide(now=0.31 + 0.01 * i) for i in range(100)} == {(0.0, 0.0)}
    assert pilot.sense(replace(STATE, stamp=1.5), now=1.5)
    assert pilot.decide(now=1.5) == (0.5, 0.0)
    standing = [record.message for record in caplog.records if "own state" in record.message]
    assert standing == ["standing: robot_0 has no own state", "robot_0 knows its own state"]


def test_an_own_state_that_cannot_be_used_is_none():
    pilot = Pilot("robot_0", [], ahead)
    assert not pilot.sense(replace(STATE, position=(math.nan, 0.0)), now=0.0)
    assert pilot.decide(now=0.0) == (0.0, 0.0)


@pytest.mark.parametrize("answer", [(math.nan, 0.0), (0.0, math.inf), (1.0,), "no", None])
def test_a_policy_that_fails_makes_it_stand_and_is_logged_once(answer, caplog):
    pilot = pilot_of(lambda own, neighbours: answer)
    assert {pilot.decide(now=0.01 * i) for i in range(20)} == {(0.0, 0.0)}
    assert len(caplog.records) == 1 and caplog.records[0].message.startswith("standing: ")


def test_a_policy_that_raises_makes_it_stand():
    def fail(own, neighbours):
        raise RuntimeError("broken")

    assert pilot_of(fail).decide(now=0.0) == (0.0, 0.0)


@given(x=st.floats(), y=st.floats())
def test_never_faster_than_its_limit(x, y):
    command = pilot_of(lambda own, neighbours: (x, y), max_speed=0.7).decide(now=0.0)
    assert math.hypot(*command) <= 0.7 * (1 + 1e-12)
    if math.isfinite(x) and math.isfinite(y) and math.isfinite(math.hypot(x, y)) and math.hypot(x, y) > 1e-6:
        assert math.isclose(math.atan2(*command), math.atan2(x, y), abs_tol=1e-9)  # its direction is kept


def test_one_that_has_arrived_holds_until_there_is_another_goal():
    pilot = pilot_of(ahead, own_timeout=10.0)
    states = [replace(STATE, stamp=s, position=p) for s, p in ((2, (4.5, 0.0)), (3, (4.95, 0.0)), (4, (4.8, 0.1)))]
    commands = []
    for state in [*states, replace(states[-1], stamp=5.0, goal=(9.0, 0.0))]:
        pilot = pilot if pilot.sense(state, now=state.stamp) else None
        commands.append(pilot.decide(now=state.stamp))
    assert commands[0] == commands[3] == (0.5, 0.0)
    assert commands[1] == pytest.approx((0.125, 0.0)) and commands[2] == pytest.approx((0.5, -0.25))


def test_a_step_that_takes_too_long():
    stuck, calls = Event(), []

    def policy(own, neighbours):
        calls.append(own)
        stuck.wait(10)
        return 0.5, 0.0

    pilot = pilot_of(Deadline(policy, seconds=0.05), own_timeout=1000.0)
    assert [pilot.decide(now=0.1 * i) for i in range(3)] == [(0.0, 0.0)] * 3
    assert len(calls) == 1  # those that follow do not wait in a queue
    stuck.set()
    for _ in range(1000):  # what was late is thrown away; then it drives again
        command = pilot.decide(now=0.5)
        if command != (0.0, 0.0):
            break
        Event().wait(0.005)
    assert command == (0.5, 0.0) and len(calls) >= 2


def test_deadline_hands_on_what_the_policy_raises():
    def fail(own, neighbours):
        raise RuntimeError("broken")

    policy = Deadline(fail, seconds=1.0)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="broken"):
            policy(STATE, [])


@pytest.mark.parametrize("name", ["max_speed", "own_timeout", "timeout", "goal_radius", "hold_time"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_bad_limits(name, value):
    with pytest.raises(ValueError, match=f"^{name}: got {value}"):
        Pilot("robot_0", [], ahead, **{name: value})


def test_bad_deadline():
    with pytest.raises(ValueError, match="deadline: got 0 s"):
        Deadline(ahead, seconds=0)
