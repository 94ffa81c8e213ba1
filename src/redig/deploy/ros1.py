"""A robot in a ROS 1 graph, through ``rospy`` where it is installed: Debian has it as ``python3-rospy``."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

from redig.deploy.messages import Vector
from redig.deploy.ros_state import (
    DEPTH,
    STATE_TOPICS,
    Obstacle,
    StateParts,
    StateTransport,
    obstacle_vector,
    to_quaternion,
    topic_names,
)
from redig.deploy.transport import BodyVelocity, Sensed

DEBIAN = "/usr/lib/python3/dist-packages"  # behind the environment's own packages, never ahead of them


class ROS1Transport(StateTransport):
    """One robot in the graph of ``ROS_MASTER_URI``: topics and types as of :class:`redig.deploy.dds.DDSTransport`.

    Args:
        namespace: of this robot, such as ``robot_0``; also its name among the team.
        neighbours: namespaces of the others.
        topics: other names of topics; one that begins with a slash is not in the namespace.
        goal, obstacle: see :class:`~redig.deploy.ros_state.StateParts`.

    Raises:
        ValueError: for a name that is not allowed.
        ImportError: if there is no ROS 1 here.

    Examples:
        >>> ROS1Transport("robot-0", [])
        Traceback (most recent call last):
        ...
        ValueError: namespace: got 'robot-0', must be letters, digits and underscores, such as robot_0 or fleet/robot_0
    """

    def __init__(
        self,
        namespace: str,
        neighbours: Sequence[str],
        *,
        topics: dict[str, str] | None = None,
        goal: Vector | None = None,
        obstacle: Obstacle | None = None,
    ) -> None:
        robot, names, mates = topic_names(namespace, neighbours, topics or {})
        self._ros = ros = _import()
        ros.rospy.init_node(f"redig_{robot.replace('/', '_')}", disable_signals=True)
        self._own = _StateReader(ros, StateParts(robot, goal, obstacle), names)
        self._mates = [_StateReader(ros, StateParts(mate), theirs) for mate, theirs in mates.items()]
        self._states = {
            name: ros.rospy.Publisher(f"/{robot}/team/{name}", ros.kinds[name], queue_size=1) for name in STATE_TOPICS
        }
        self._commands = ros.rospy.Publisher(f"/{names['cmd_vel']}", ros.messages.Twist, queue_size=1)

    def send(self, sensed: Sensed) -> None:
        """Publish a state for neighbours, in the frame of the pose."""
        (state, heading), of = sensed, self._ros.messages
        stamp = self._ros.rospy.Time.from_sec(state.stamp)
        header = self._ros.header(stamp=stamp, frame_id=self._own.parts.frame)
        wall = of.Vector3(*obstacle_vector(state.obstacle_distance, state.obstacle_direction))
        place = of.Pose(of.Point(*state.position, 0.0), of.Quaternion(*to_quaternion(heading)))
        self._states["twist"].publish(header, of.Twist(linear=of.Vector3(*state.velocity, 0.0)))
        self._states["goal"].publish(header, of.Pose(position=of.Point(*state.goal, 0.0)))
        self._states["obstacle"].publish(header, wall)
        self._states["pose"].publish(header, place)

    def command(self, velocity: BodyVelocity) -> None:
        """Publish a ``Twist``."""
        message = self._ros.messages.Twist()
        message.linear.x, message.linear.y, message.angular.z = velocity
        self._commands.publish(message)

    def close(self) -> None:
        """Leave the graph."""
        time.sleep(0.1)  # what was published last, a command to stand, is sent by a thread of rospy
        self._ros.rospy.signal_shutdown("closed")


class _StateReader:
    """The state of a robot, out of four topics; rospy calls back in threads of its own, where only a queue is touched.

    Args:
        ros: what :func:`_import` gives.
        parts: what puts them together.
        topics: names of ``pose``, ``twist``, ``goal`` and ``obstacle``.
    """

    def __init__(self, ros: SimpleNamespace, parts: StateParts, topics: dict[str, str]) -> None:
        self.parts = parts
        self._hear: dict[str, Callable[[Any], None]] = {
            "twist": parts.hear_twist,
            "goal": parts.hear_goal,
            "obstacle": parts.hear_obstacle,
            "pose": lambda message: parts.hear_pose(message, message.header.stamp.to_sec()),
        }
        self._queue: deque[tuple[str, Any]] = deque(maxlen=4 * DEPTH)
        for name in STATE_TOPICS:
            ros.rospy.Subscriber(f"/{topics[name]}", ros.kinds[name], partial(self._put, name))

    def take(self) -> list[Sensed]:
        """States that have been completed since the last call."""
        states = []
        while self._queue:
            name, message = self._queue.popleft()
            self._hear[name](message)
            state = self.parts.take()
            if state is not None:
                states.append(state)
        return states

    def _put(self, name: str, message: Any) -> None:
        self._queue.append((name, message))


def _import() -> SimpleNamespace:
    """What is needed of ROS 1, where the system has it."""
    if DEBIAN not in sys.path:
        sys.path.append(DEBIAN)
    try:
        import rospy
        from geometry_msgs import msg as messages
        from std_msgs.msg import Header
    except ImportError as error:
        raise ImportError(
            "redig.deploy.ros1 needs rospy and geometry_msgs of ROS 1: apt install python3-rospy python3-geometry-msgs"
        ) from error
    pose = messages.PoseStamped
    kinds = {"pose": pose, "twist": messages.TwistStamped, "goal": pose, "obstacle": messages.Vector3Stamped}
    return SimpleNamespace(rospy=rospy, messages=messages, header=Header, kinds=kinds)
