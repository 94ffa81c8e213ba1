import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from redig.deploy.ros2_types import Header, Pose, PoseStamped, Quaternion, TwistStamped, Vector3, Vector3Stamped
from redig.deploy.ros_state import StateParts, obstacle_vector, read_obstacle, to_quaternion


@given(st.floats(1e-3, 1e3), st.floats(0, 1), st.floats(-math.pi, math.pi))
def test_what_is_told_of_an_obstacle_is_what_is_read(distance, length, angle):
    direction = (length * math.cos(angle), length * math.sin(angle))
    found, back = read_obstacle(*obstacle_vector(distance, direction))
    assert found == pytest.approx(distance) and back == pytest.approx(direction, abs=1e-9)


def test_a_vector_of_any_other_node_is_a_unit_vector():
    assert read_obstacle(0.0, -0.5) == (0.5, (0.0, -1.0))
    assert read_obstacle(0.0, -0.5, z=-0.3) == (0.5, (0.0, -1.0))
    assert read_obstacle(0.0, 0.0) == (0.0, (0.0, 0.0))


def test_a_shorter_direction_is_turned_with_the_robot():
    parts, heading = StateParts("robot_0", goal=(5.0, 0.0)), 0.5
    header = Header(frame_id="map")
    parts.hear_pose(PoseStamped(header, Pose(orientation=Quaternion(*to_quaternion(heading)))), stamp=1.0)
    parts.hear_twist(TwistStamped(header))
    parts.hear_obstacle(Vector3Stamped(Header(frame_id="base_link"), Vector3(0.5, 0.0, 0.75)))  # ahead
    state, _ = parts.take()
    assert state.obstacle_distance == pytest.approx(0.5)
    assert state.obstacle_direction == pytest.approx((0.25 * math.cos(heading), 0.25 * math.sin(heading)))
    state.check()
