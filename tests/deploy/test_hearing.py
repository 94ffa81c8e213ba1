import logging
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from redig.deploy.hearing import Hearing
from redig.deploy.messages import RobotState


def at(stamp, robot="robot_1", **changes):
    return replace(RobotState(robot, stamp, (0.0, 0.0), (0.5, 0.0), (5.0, 0.0), 1.0, (0.0, 1.0)), **changes)


@pytest.fixture
def hearing():
    return Hearing(["robot_1", "robot_2"], timeout=0.5, fastest=2.0)


def stamps(hearing, now):
    return [state.stamp for state in hearing.believed(now)]


def test_the_newest_of_each_by_name(hearing):
    for state in (at(1.0, "robot_2"), at(1.0), at(1.1, "robot_2")):
        assert hearing.hear(state, now=state.stamp)
    assert [(state.robot, state.stamp) for state in hearing.believed(1.1)] == [("robot_1", 1.0), ("robot_2", 1.1)]


def test_duplicated_and_reordered_messages_change_nothing(hearing):
    accepted = [hearing.hear(at(stamp), now) for stamp, now in ((1.0, 1.0), (1.2, 1.2), (1.2, 1.25), (1.1, 1.3))]
    assert accepted == [True, True, False, False]
    assert stamps(hearing, 1.3) == [1.2]


def test_a_message_counts_from_its_arrival(hearing):
    hearing.hear(at(1.0), now=10.0)
    assert stamps(hearing, 10.5) == [1.0] and stamps(hearing, 10.51) == []


def test_messages_passed_over_do_not_keep_a_robot_alive(hearing):
    hearing.hear(at(1.0), now=1.0)
    assert not any(hearing.hear(at(1.0), now=1.0 + 0.1 * step) for step in range(1, 5))
    assert stamps(hearing, 1.51) == []


@given(offset=st.floats(-1e6, 1e6), lags=st.lists(st.integers(0, 40), min_size=1, max_size=30))
def test_clock_offset_makes_no_difference(offset, lags):
    """The same decisions, whatever the sender's clock shows; lags are in steps that miss the limit, for rounding."""
    here, there = (Hearing(["robot_1"], timeout=0.5, fastest=2.0) for _ in range(2))
    for now, sent in sorted((0.1 * step + 0.03 * lag, 0.1 * step) for step, lag in enumerate(lags)):
        assert here.hear(at(sent), now) == there.hear(at(sent + offset), now)


def test_stale_message_is_passed_over_whatever_the_clocks_say(hearing):
    hearing.hear(at(0.0), now=100.0)
    assert hearing.hear(at(0.3), now=100.5)  # 0.2 s longer
    assert hearing.hear(at(0.35), now=100.8)  # 0.45 s longer than the first
    assert not hearing.hear(at(0.36), now=100.9)  # 0.54 s longer than the first, 0.09 s longer than the last


def test_message_from_the_future_does_not_lock_out_those_that_follow(hearing):
    hearing.hear(at(1.0), now=1.0)
    assert not hearing.hear(at(1e9), now=1.05)
    assert hearing.hear(at(1.1), now=1.1)


def test_clocks_that_run_apart(hearing):
    """A clock that loses, or gains, 5 ms each second for an hour."""
    assert all(hearing.hear(at(0.995 * 0.4 * step), now=0.4 * step) for step in range(9000))
    assert all(hearing.hear(at(1.005 * 0.4 * step, "robot_2"), now=0.4 * step) for step in range(9000))


def test_one_that_dies_and_returns_with_its_clock_reset(hearing, caplog):
    caplog.set_level(logging.INFO)
    for step in range(20):
        hearing.hear(at(1000 + 0.1 * step), now=0.1 * step)
        hearing.believed(0.1 * step)
    for step in (*range(20, 24), *range(25, 60)):
        assert stamps(hearing, 0.1 * step) == ([1000 + 1.9] if step < 24 else [])
    assert hearing.hear(at(0.0, position=(3.0, 0.0)), now=6.0)
    assert stamps(hearing, 6.0) == [0.0]
    assert [record.message for record in caplog.records] == [
        "lost robot_1: nothing heard for 0.5 s",
        "hearing robot_1 again",
    ]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"position": (math.nan, 0.0)}, "position of robot_1: got (nan, 0.0)"),
        ({"velocity": (math.inf, 0.0)}, "velocity of robot_1"),
        ({"position": (1e300, 0.0)}, "position of robot_1"),
        ({"goal": (0.0, -1e7)}, "goal of robot_1"),
        ({"obstacle_direction": (3.0, 4.0)}, "must have a length of at most 1"),
        ({"velocity": (2.0, 0.5)}, "faster than 2 m/s"),
        ({"position": (1.0, 0.0)}, "leapt 1 m"),
        ({"robot": "robot_9"}, "not one of the team"),
        ({"robot": ""}, "must be a name"),
        ({"stamp": math.nan}, "stamp of robot_1"),
    ],
)
def test_what_cannot_be_is_passed_over_and_logged_once(hearing, caplog, changes, words):
    hearing.hear(at(1.0), now=1.0)
    for step in range(1, 100):
        now = 1 + 0.01 * step
        assert hearing.hear(at(now), now)
        assert not hearing.hear(replace(at(now + 0.005), **changes), now + 0.005)
    assert len(stamps(hearing, 2.0)) == 1
    assert len(caplog.records) == 1 and words in caplog.text


def test_localisation_may_correct_itself(hearing):
    hearing.hear(at(1.0), now=1.0)
    assert hearing.hear(at(1.1, position=(0.6, 0.0)), now=1.1)


@pytest.mark.parametrize("name", ["timeout", "fastest"])
def test_bad_arguments(name):
    with pytest.raises(ValueError, match=f"{name}: got 0"):
        Hearing([], **({"timeout": 1.0, "fastest": 1.0} | {name: 0}))
