"""A robot's state in ROS's messages, of either version: fields are read by their names."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from redig.deploy.messages import RobotState, Vector
from redig.deploy.proximity import to_world
from redig.deploy.transport import Sensed

STATE_TOPICS = ("pose", "twist", "goal", "obstacle")
DEPTH = 8  # messages of one topic that are kept between two looks
Obstacle = Callable[[Vector], tuple[float, Vector]]  # position (m) to the nearest obstacle's distance (m) and direction


class StateParts:
    """A robot's state out of what ROS says of it: pose, twist, goal and obstacle come as messages of their own.

    A state is complete when pose, twist and obstacle have all come anew, so that it is as old as the oldest of them and
    stops when any of them stops. The goal is kept. A twist or a vector whose frame is not that of the pose, and not
    empty, is taken to be along the robot's axes, and turned by its heading.

    Args:
        robot: its name.
        goal: until a message brings another (m); ``None``: there is no state before that message.
        obstacle: from the position, for a robot that has a map; ``None``: it comes as a message.

    Examples:
        >>> from redig.deploy.ros2_types import PoseStamped, TwistStamped, Vector3, Vector3Stamped
        >>> own = StateParts("robot_0", goal=(5.0, 0.0))
        >>> own.hear_pose(PoseStamped(), stamp=12.5)
        >>> own.hear_twist(TwistStamped())
        >>> own.take() is None
        True
        >>> own.hear_obstacle(Vector3Stamped(vector=Vector3(0.0, 0.5)))
        >>> state, heading = own.take()
        >>> state.stamp, state.goal, state.obstacle_distance, state.obstacle_direction
        (12.5, (5.0, 0.0), 0.5, (0.0, 1.0))
    """

    def __init__(self, robot: str, goal: Vector | None = None, obstacle: Obstacle | None = None) -> None:
        self.robot, self.goal, self._nearest = robot, goal, obstacle
        self.frame = ""  # of the last pose
        self._pose: tuple[Any, float] | None = None
        self._twist: Any = None
        self._obstacle: Any = None

    def hear_pose(self, message: Any, stamp: float) -> None:
        """A ``PoseStamped``, and its stamp (s)."""
        self._pose = message, stamp

    def hear_twist(self, message: Any) -> None:
        """A ``TwistStamped``."""
        self._twist = message

    def hear_goal(self, message: Any) -> None:
        """A ``PoseStamped``, of which the position counts; one that is not finite is passed over."""
        x, y = message.pose.position.x, message.pose.position.y
        if math.isfinite(x) and math.isfinite(y):
            self.goal = x, y

    def hear_obstacle(self, message: Any) -> None:
        """A ``Vector3Stamped`` of what :func:`obstacle_vector` says."""
        self._obstacle = message

    def take(self) -> Sensed | None:
        """The state, if it is complete; its parts are not used again."""
        missing = self._obstacle is None and self._nearest is None
        if self._pose is None or self._twist is None or self.goal is None or missing:
            return None
        (message, stamp), twist, vector = self._pose, self._twist, self._obstacle
        self._pose = self._twist = self._obstacle = None
        self.frame, pose = message.header.frame_id, message.pose
        position, heading = (pose.position.x, pose.position.y), yaw(pose.orientation)
        velocity = _in_frame(twist.twist.linear, twist.header.frame_id, self.frame, heading)
        if self._nearest is not None:
            distance, direction = self._nearest(position)
        else:
            flat = _in_frame(vector.vector, vector.header.frame_id, self.frame, heading)
            distance, direction = read_obstacle(*flat, vector.vector.z)
        return Sensed(RobotState(self.robot, stamp, position, velocity, self.goal, distance, direction), heading)


class _Reader(Protocol):
    """Completed states of one robot, from a version of ROS; ``parts`` puts them together."""

    parts: StateParts

    def take(self) -> list[Sensed]:
        """States that have been completed since the last call."""


class StateTransport:
    """What transports over either version of ROS share: the own state and those of neighbours, read from topics.

    Examples:
        >>> from redig.deploy.ros1 import ROS1Transport
        >>> issubclass(ROS1Transport, StateTransport)
        True
    """

    _own: _Reader
    _mates: Sequence[_Reader]

    def sense(self) -> Sensed | None:
        """This robot's own state, once all of its parts have come anew."""
        states = self._own.take()
        return states[-1] if states else None

    def receive(self) -> list[RobotState]:
        """States of neighbours, each once all of its parts have come anew."""
        return [sensed.state for mate in self._mates for sensed in mate.take()]


def topic_names(
    namespace: str, neighbours: Sequence[str], topics: Mapping[str, str]
) -> tuple[str, dict[str, str], dict[str, dict[str, str]]]:
    """The robot's name, the names of its topics, and those of the states of each neighbour other than itself.

    Raises:
        ValueError: if ROS would not take one.

    Examples:
        >>> robot, own, mates = topic_names("/robot_0", ["robot_0", "robot_1"], {"pose": "/amcl/pose"})
        >>> robot, own["pose"], own["cmd_vel"], mates["robot_1"]["goal"], len(mates)
        ('robot_0', 'amcl/pose', 'robot_0/cmd_vel', 'robot_1/team/goal', 1)
    """
    robot = check_namespace("namespace", namespace)
    mates = [check_namespace("neighbours", mate) for mate in neighbours]
    own = {name: full_name(robot, name, topics) for name in (*STATE_TOPICS, "cmd_vel")}
    return robot, own, {mate: {name: f"{mate}/team/{name}" for name in STATE_TOPICS} for mate in mates if mate != robot}


def obstacle_vector(distance: float, direction: Vector) -> tuple[float, float, float]:
    """x, y, z of the ``Vector3`` that tells of a robot's nearest obstacle.

    x and y lead from the robot's centre to the obstacle's nearest point (m). z is by how much the observed direction is
    shorter than a unit vector, 0 to 1 (see :func:`~redig.envs.direction.smoothed_direction`), so whoever knows nothing
    of that leaves it 0. A direction that is zero, or not known, is sent along x, with a z of 1.

    Examples:
        >>> obstacle_vector(0.5, (0.0, 1.0)), obstacle_vector(0.5, (0.0, 0.25)), obstacle_vector(8.0, (0.0, 0.0))
        ((0.0, 0.5, 0.0), (0.0, 0.5, 0.75), (8.0, 0.0, 1.0))
    """
    length = math.hypot(*direction)
    x, y = (direction[0] / length, direction[1] / length) if length > 0 else (1.0, 0.0)
    return distance * x, distance * y, max(0.0, 1 - length)


def read_obstacle(x: float, y: float, z: float = 0.0) -> tuple[float, Vector]:
    """The inverse of :func:`obstacle_vector`; the direction of a vector without length is zeros.

    Examples:
        >>> read_obstacle(3.0, 4.0), read_obstacle(0.0, 0.5, 0.75)
        ((5.0, (0.6, 0.8)), (0.5, (0.0, 0.25)))
    """
    distance, length = math.hypot(x, y), 1 - min(max(z, 0.0), 1.0)
    return (distance, (length * x / distance, length * y / distance)) if distance > 0 else (0.0, (0.0, 0.0))


def yaw(quaternion: Any) -> float:
    """Heading (rad) of a ``Quaternion``.

    Examples:
        >>> from redig.deploy.ros2_types import Quaternion
        >>> round(yaw(Quaternion(z=0.6, w=0.8)), 3)  # 2 asin(0.6)
        1.287
    """
    x, y, z, w = (getattr(quaternion, name) for name in "xyzw")
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def to_quaternion(heading: float) -> tuple[float, float, float, float]:
    """x, y, z, w of the quaternion of a heading (rad).

    Examples:
        >>> to_quaternion(0.0)
        (0.0, 0.0, 0.0, 1.0)
    """
    return 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)


def check_namespace(name: str, value: str) -> str:
    """A namespace without slashes around it.

    Raises:
        ValueError: if ROS would not take it.

    Examples:
        >>> check_namespace("namespace", "/fleet/robot_0")
        'fleet/robot_0'
        >>> check_namespace("namespace", "robot-0")
        Traceback (most recent call last):
        ...
        ValueError: namespace: got 'robot-0', must be letters, digits and underscores, such as robot_0 or fleet/robot_0
    """
    bare = value.strip("/")
    if not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", bare, re.ASCII):
        raise ValueError(
            f"{name}: got {value!r}, must be letters, digits and underscores, such as robot_0 or fleet/robot_0"
        )
    return bare


def full_name(namespace: str, topic: str, names: Mapping[str, str]) -> str:
    """A topic without the first slash: as ``names`` have it, in the namespace unless that begins with a slash.

    Raises:
        ValueError: if ROS would not take it.

    Examples:
        >>> full_name("robot_0", "pose", {}), full_name("robot_0", "pose", {"pose": "/amcl/pose"})
        ('robot_0/pose', 'amcl/pose')
    """
    name = names.get(topic, topic)
    return check_namespace(f"{topic} topic", name if name.startswith("/") else f"{namespace}/{name}")


def _in_frame(vector: Any, frame: str, world: str, heading: float) -> Vector:
    if frame in ("", world):
        return vector.x, vector.y
    return to_world((vector.x, vector.y), heading)
