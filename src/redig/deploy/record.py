"""A run as an MCAP file with ROS 2's message definitions, which Foxglove and the tools of rosbag2 open; and back."""

from __future__ import annotations

import math
import struct
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from redig.deploy.ros_state import obstacle_vector, to_quaternion
from redig.deploy.transport import BodyVelocity, Sensed
from redig.files import replacing

try:
    from mcap.exceptions import McapError
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    from mcap_ros2.writer import Writer
except ImportError as error:
    raise ImportError("redig.deploy.record needs MCAP: pip install 'redig[record]'") from error

LINE = "=" * 80
DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
}
PARTS = {
    "PoseStamped": ("geometry_msgs/Pose pose", ("Header", "Time", "Pose", "Point", "Quaternion")),
    "TwistStamped": ("geometry_msgs/Twist twist", ("Header", "Time", "Twist", "Vector3")),
    "Vector3Stamped": ("geometry_msgs/Vector3 vector", ("Header", "Time", "Vector3")),
}
TOPICS = {
    "pose": "PoseStamped",
    "twist": "TwistStamped",
    "goal": "PoseStamped",
    "obstacle": "Vector3Stamped",
    "cmd_vel_stamped": "TwistStamped",
}


class Recorder(AbstractContextManager):
    """Writes what robots sense and are commanded; the file appears when the block ends without an error.

    Topics of each robot are ``pose``, ``twist``, ``goal`` and ``obstacle`` as on the network, and ``cmd_vel_stamped``
    (``TwistStamped``, along the robot's axes), as a ``Twist`` has no time.

    Args:
        path: of the file, by custom ``*.mcap``.

    Examples:
        >>> import tempfile
        >>> from redig.deploy import RobotState
        >>> state = RobotState("robot_0", 1.5, (0.0, 1.0), (0.3, 0.0), (5.5, 1.0), 0.8, (0.0, -1.0))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with Recorder(f"{folder}/run.mcap") as recorder:
        ...         recorder.write(Sensed(state, heading=0.0), BodyVelocity(0.5, 0.0, 0.0))
        ...     run = read_run(f"{folder}/run.mcap")
        >>> run.robots, run.stamp.tolist(), run.position.tolist(), run.command.tolist()
        (['robot_0'], [1.5], [[[0.0, 1.0]]], [[[0.5, 0.0, 0.0]]])
    """

    def __init__(self, path: str | Path) -> None:
        self._path, self._stack = path, ExitStack()

    def __enter__(self) -> Recorder:
        self._writer = Writer(str(self._stack.enter_context(replacing(self._path))))
        self._schemas = {
            kind: self._writer.register_msgdef(f"geometry_msgs/msg/{kind}", definition(kind)) for kind in PARTS
        }
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._writer.finish()
        self._stack.__exit__(kind, error, traceback)

    def write(self, sensed: Sensed, command: BodyVelocity, frame: str = "map") -> None:
        """What a robot sensed, and what it was then commanded."""
        state, heading = sensed
        nanoseconds = round(state.stamp * 1e9)
        stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
        wall = obstacle_vector(state.obstacle_distance, state.obstacle_direction)
        turned = dict(zip("xyzw", to_quaternion(heading), strict=True))
        parts: dict[str, dict[str, Any]] = {
            "pose": {"pose": {"position": _vector(*state.position), "orientation": turned}},
            "twist": {"twist": {"linear": _vector(*state.velocity), "angular": _vector()}},
            "goal": {"pose": {"position": _vector(*state.goal), "orientation": {**_vector(), "w": 1.0}}},
            "obstacle": {"vector": _vector(*wall)},
            "cmd_vel_stamped": {
                "twist": {"linear": _vector(command.forward, command.left), "angular": _vector(z=command.turn)}
            },
        }
        for name, fields in parts.items():
            header = {"stamp": stamp, "frame_id": f"{state.robot}/base_link" if name == "cmd_vel_stamped" else frame}
            self._writer.write_message(
                f"/{state.robot}/{name}",
                self._schemas[TOPICS[name]],
                {"header": header, **fields},
                log_time=nanoseconds,
                publish_time=nanoseconds,
            )


@dataclass(frozen=True)
class Run:
    """What was recorded, of n robots at T times.

    Attributes:
        robots: their names.
        stamp: ``[T]`` (s).
        position, velocity, goal: ``[T, n, 2]`` (m, m/s).
        heading: ``[T, n]`` (rad).
        obstacle: ``[T, n, 2]``, the vector to the nearest obstacle (m).
        command: ``[T, n, 3]``: forward, left (m/s), turn (rad/s).

    Examples:
        >>> import dataclasses
        >>> [field.name for field in dataclasses.fields(Run)][:3]
        ['robots', 'stamp', 'position']
    """

    robots: list[str]
    stamp: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    goal: NDArray[np.float64]
    heading: NDArray[np.float64]
    obstacle: NDArray[np.float64]
    command: NDArray[np.float64]


def read_run(path: str | Path) -> Run:
    """Read what a :class:`Recorder` has written; times at which not all robots were recorded are left out.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not an MCAP file, is damaged, or holds no such run.

    Examples:
        >>> read_run("no/such/run.mcap")
        Traceback (most recent call last):
        ...
        FileNotFoundError: run: no such file: no/such/run.mcap
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"run: no such file: {path}")
    messages: dict[tuple[str, str], dict[int, Any]] = {}
    try:
        with open(path, "rb") as file:
            for _, channel, record, message in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages():
                robot, _, topic = channel.topic.strip("/").rpartition("/")
                messages.setdefault((robot, topic), {})[record.log_time] = message
    except (McapError, ValueError, struct.error) as error:
        raise ValueError(f"run: {path} is not an MCAP file, or is damaged ({error})") from error
    robots = sorted({robot for robot, _ in messages}, key=lambda name: (len(name), name))
    if not robots or any((robot, topic) not in messages for robot in robots for topic in TOPICS):
        raise ValueError(f"run: {path} holds {sorted(messages)}, expected {', '.join(TOPICS)} of each robot")
    times = sorted(set.intersection(*(set(at) for at in messages.values())))

    def gather(topic: str, *fields: str) -> NDArray[np.float64]:
        values = [[_fields(messages[robot, topic][time], fields) for robot in robots] for time in times]
        return np.array(values, np.float64).reshape(len(times), len(robots), len(fields))

    turned = gather("pose", "pose.orientation.z", "pose.orientation.w")
    return Run(
        robots=robots,
        stamp=np.array(times) / 1e9,
        position=gather("pose", "pose.position.x", "pose.position.y"),
        velocity=gather("twist", "twist.linear.x", "twist.linear.y"),
        goal=gather("goal", "pose.position.x", "pose.position.y"),
        heading=2 * np.arctan2(turned[..., 0], turned[..., 1]),
        obstacle=gather("obstacle", "vector.x", "vector.y"),
        command=gather("cmd_vel_stamped", "twist.linear.x", "twist.linear.y", "twist.angular.z"),
    )


def definition(kind: str) -> str:
    """The definition of a stamped message of ``geometry_msgs``, followed by those that it is made of, as ROS has it.

    Examples:
        >>> print(definition("Vector3Stamped").splitlines()[0])
        std_msgs/Header header
    """
    own, parts = PARTS[kind]
    names = {name.partition("/")[2]: name for name in DEFINITIONS}
    sections = [f"std_msgs/Header header\n{own}"]
    sections += [f"MSG: {names[part]}\n{DEFINITIONS[names[part]]}" for part in parts]
    return f"\n{LINE}\n".join(sections)


def _vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> dict[str, float]:
    for value in (x, y, z):
        if not math.isfinite(value):
            raise ValueError(f"got {value}, only finite numbers are recorded")
    return {"x": x, "y": y, "z": z}


def _fields(message: Any, fields: tuple[str, ...]) -> list[float]:
    values = []
    for field in fields:
        value = message
        for part in field.split("."):
            value = getattr(value, part)
        values.append(value)
    return values
