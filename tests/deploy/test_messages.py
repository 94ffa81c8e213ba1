import math
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from redig.deploy import RobotState

STATE = RobotState("robot_0", 1.0, (0.0, 1.0), (0.3, 0.0), (5.0, 1.0), 0.8, (0.0, -1.0))


def test_states_do_not_change():
    with pytest.raises(FrozenInstanceError):
        STATE.position = (1.0, 1.0)


@pytest.mark.parametrize(
    "good",
    [
        {},
        {"obstacle_distance": -0.1},  # inside an obstacle
        {"obstacle_direction": (0.0, 0.0)},  # not known
        {"obstacle_direction": (0.6, -0.8)},
        {"position": np.zeros(2), "velocity": [0, 1], "stamp": np.float32(3.0)},
        {"stamp": 1.8e9},
    ],
)
def test_states_that_can_be_used(good):
    replace(STATE, **good).check()


@pytest.mark.parametrize(
    "bad, message",
    [
        ({"robot": ""}, "robot: got '', must be a name"),
        ({"robot": 3}, "robot: got 3, must be a name"),
        ({"position": (1.0, math.inf)}, r"position of robot_0: got \(1.0, inf\), must be two finite numbers"),
        ({"position": (1.0, 1e7)}, "position of robot_0: .* of at most 1e\\+06"),
        ({"velocity": (1.0,)}, "velocity of robot_0"),
        ({"velocity": 1.0}, "velocity of robot_0"),
        ({"velocity": "ab"}, "velocity of robot_0"),
        ({"goal": (None, 0.0)}, "goal of robot_0"),
        ({"goal": (10**400, 0.0)}, "goal of robot_0"),
        ({"stamp": math.nan}, "stamp of robot_0: got nan, must be a finite number"),
        ({"stamp": "now"}, "stamp of robot_0: got 'now'"),
        ({"stamp": 10**400}, "stamp of robot_0"),
        ({"obstacle_distance": -math.inf}, "obstacle_distance of robot_0: got -inf"),
        ({"obstacle_distance": 1e30}, "obstacle_distance of robot_0: got 1e\\+30, .* of at most 1e\\+06"),
        (
            {"obstacle_direction": (0.9, 0.9)},
            "obstacle_direction of robot_0: .* of length 1.273, must have .* at most 1",
        ),
    ],
)
def test_states_that_cannot_be_used_say_why(bad, message):
    with pytest.raises(ValueError, match=message):
        replace(STATE, **bad).check()


anything = st.one_of(st.floats(), st.integers(), st.text(), st.none(), st.booleans(), st.binary(), st.complex_numbers())
anything |= st.tuples(anything, anything) | st.lists(anything, max_size=3)


@given(st.builds(RobotState, *[anything] * 7))
def test_anything_is_used_or_refused_with_a_value_error(state):
    try:
        state.check()
    except ValueError:
        return
    numbers = [*state.position, *state.velocity, *state.goal, state.obstacle_distance, *state.obstacle_direction]
    assert np.isfinite(np.array(numbers, np.float32)).all()
