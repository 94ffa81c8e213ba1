"""Robots on DDS, with ROS 2's message types and topic names: they and a ROS 2 graph hear each other, without ROS here.

DDS protects nothing here: whoever reaches the network and knows the domain id is believed. See ``docs/robots.md``.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any
from xml.sax.saxutils import quoteattr

from redig.deploy.events import Events
from redig.deploy.messages import Vector
from redig.deploy.ros2_types import (
    Header,
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    Time,
    Twist,
    TwistStamped,
    Vector3,
    Vector3Stamped,
)
from redig.deploy.ros_state import (
    DEPTH,
    STATE_TOPICS,
    Obstacle,
    StateParts,
    StateTransport,
    check_namespace,
    obstacle_vector,
    to_quaternion,
    topic_names,
)
from redig.deploy.transport import BodyVelocity, Sensed

try:
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
except ImportError as error:
    raise ImportError("redig.deploy.dds needs Cyclone DDS: pip install 'redig[ros2]'") from error

LARGEST_DOMAIN = 232  # ports of larger ones are above 65535
RELIABLE = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(1))  # what ROS 2's readers ask of a writer
KINDS = dict(zip(STATE_TOPICS, (PoseStamped, TwistStamped, PoseStamped, Vector3Stamped), strict=True))
log = logging.getLogger(__name__)


class DDSTransport(StateTransport):
    """One robot: its own state from topics of its namespace, ``cmd_vel`` to it, and states from and to its neighbours.

    ===============  ==================  ====================================================================
    in a namespace   ``geometry_msgs``
    ===============  ==================  ====================================================================
    ``pose``         ``PoseStamped``     read; its frame is the world of the team
    ``twist``        ``TwistStamped``    read; frames: see :class:`~redig.deploy.ros_state.StateParts`
    ``goal``         ``PoseStamped``     read
    ``obstacle``     ``Vector3Stamped``  read, unless ``obstacle`` is given
    ``cmd_vel``      ``Twist``           written, along the robot's axes
    ``team/pose`` …  as without team     its own state, written for neighbours, who read these four of each other
    ===============  ==================  ====================================================================

    Readers are best effort and hear any writer; writers are reliable, and heard by any reader of ROS 2.

    Args:
        namespace: of this robot, such as ``robot_0``; also its name among the team.
        neighbours: namespaces of the others.
        domain_id: of DDS, from 0 to 232; ``ROS_DOMAIN_ID`` of ROS 2.
        interface: of the network; the default reaches this machine only.
        peers: addresses to look for participants at, on networks without multicast.
        topics: other names of topics, by those above; one that begins with a slash is not in the namespace.
        goal, obstacle: see :class:`~redig.deploy.ros_state.StateParts`.

    Raises:
        ValueError: for a domain id or a name that is not allowed.
        DDSException: if there is no such interface, or this process has the domain on another one.

    Examples:
        >>> transport = DDSTransport("robot_0", ["robot_1"], domain_id=7)
        >>> transport.sense() is None  # nobody has told it where it is
        True
        >>> transport.close()
    """

    def __init__(
        self,
        namespace: str,
        neighbours: Sequence[str],
        *,
        domain_id: int,
        interface: str = "lo",
        peers: Sequence[str] = (),
        topics: dict[str, str] | None = None,
        goal: Vector | None = None,
        obstacle: Obstacle | None = None,
    ) -> None:
        robot, names, mates = topic_names(namespace, neighbours, topics or {})
        self._network = Network(domain_id, interface, peers)
        self._own = _StateReader(self._network, StateParts(robot, goal, obstacle), names)
        self._mates = [_StateReader(self._network, StateParts(mate), theirs) for mate, theirs in mates.items()]
        self._states = _StateWriter(self._network, f"{robot}/team")
        self._commands = self._network.writer(names["cmd_vel"], Twist)

    def send(self, sensed: Sensed) -> None:
        """Publish a state for neighbours, in the frame of the pose."""
        self._states.write(sensed, self._own.parts.frame)

    def command(self, velocity: BodyVelocity) -> None:
        """Publish a ``Twist``."""
        linear = Vector3(velocity.forward, velocity.left)
        self._commands.write(Twist(linear, Vector3(z=velocity.turn)))

    def close(self) -> None:
        """Leave the domain."""
        del self._own, self._mates, self._states, self._commands
        self._network.close()


class DDSWorld:
    """The other side, for a simulator: what each robot senses goes out, and what it is commanded comes in.

    Args:
        robots: their namespaces.
        domain_id, interface, peers: see :class:`DDSTransport`.

    Raises:
        ValueError: likewise.

    Examples:
        >>> from redig.deploy.messages import RobotState
        >>> world = DDSWorld(["robot_0"], domain_id=7)
        >>> state = RobotState("robot_0", 1.5, (0.0, 1.0), (0.3, 0.0), (5.5, 1.0), 0.8, (0.0, -1.0))
        >>> world.publish(Sensed(state, heading=0.0))
        >>> world.commands()  # no robot has come yet
        {}
        >>> world.close()
    """

    def __init__(self, robots: Sequence[str], *, domain_id: int, interface: str = "lo", peers: Sequence[str] = ()):
        names = [check_namespace("robots", robot) for robot in robots]
        self._network = Network(domain_id, interface, peers)
        self._states = {name: _StateWriter(self._network, name) for name in names}
        self._commands = {name: self._network.reader(f"{name}/cmd_vel", Twist) for name in names}

    def publish(self, sensed: Sensed) -> None:
        """Say to a robot what it senses; all vectors go out along the axes of the world, the frame ``map``.

        Stamps must be of a clock that runs as fast as the robots' clocks do, whatever the pace of the simulation.
        """
        self._states[sensed.state.robot].write(sensed, "map")

    def commands(self) -> dict[str, BodyVelocity]:
        """The newest command of each robot that has sent one since the last call."""
        newest = {}
        for name, reader in self._commands.items():
            for message in reader.take():
                newest[name] = BodyVelocity(message.linear.x, message.linear.y, message.angular.z)
        return newest

    def close(self) -> None:
        """Leave the domain."""
        del self._states, self._commands
        self._network.close()


class _StateReader:
    """The state of a robot, out of four topics.

    Args:
        network: that they are on.
        parts: what puts them together.
        topics: names of ``pose``, ``twist``, ``goal`` and ``obstacle``.
    """

    def __init__(self, network: Network, parts: StateParts, topics: Mapping[str, str]) -> None:
        self.parts = parts
        hear: dict[str, Callable[[Any], None]] = {
            "twist": parts.hear_twist,
            "goal": parts.hear_goal,
            "obstacle": parts.hear_obstacle,
            "pose": lambda message: parts.hear_pose(message, message.header.stamp.seconds()),
        }
        self._sources = [(network.reader(topics[name], KINDS[name]), hear[name]) for name in hear]

    def take(self) -> list[Sensed]:
        """States that have been completed since the last call."""
        queues = [(deque(reader.take()), hear) for reader, hear in self._sources]
        states = []
        while any(queue for queue, _ in queues):  # in step, so that parts sent together are put together
            for queue, hear in queues:
                if queue:
                    hear(queue.popleft())
            state = self.parts.take()
            if state is not None:
                states.append(state)
        return states


class _StateWriter:
    """The other end of :class:`_StateReader`, for topics of the same names in ``namespace``."""

    def __init__(self, network: Network, namespace: str) -> None:
        self._write = {name: network.writer(f"{namespace}/{name}", kind).write for name, kind in KINDS.items()}

    def write(self, sensed: Sensed, frame: str) -> None:
        """Publish a state, all of it in one frame."""
        state, heading = sensed
        header = Header(Time.of(state.stamp), frame)
        wall = Vector3(*obstacle_vector(state.obstacle_distance, state.obstacle_direction))
        self._write["twist"](TwistStamped(header, Twist(Vector3(*state.velocity))))
        self._write["goal"](PoseStamped(header, Pose(Point(*state.goal))))
        self._write["obstacle"](Vector3Stamped(header, wall))
        self._write["pose"](PoseStamped(header, Pose(Point(*state.position), Quaternion(*to_quaternion(heading)))))


class Network:
    """A participant of a domain on one interface, with topics named as ROS 2 does.

    Args:
        domain_id, interface, peers: see :class:`DDSTransport`.

    Attributes:
        events: what has been logged.

    Examples:
        >>> Network(233)
        Traceback (most recent call last):
        ...
        ValueError: domain_id: got 233, must be from 0 to 232
    """

    def __init__(self, domain_id: int, interface: str = "lo", peers: Sequence[str] = ()) -> None:
        if not 0 <= domain_id <= LARGEST_DOMAIN:
            raise ValueError(f"domain_id: got {domain_id}, must be from 0 to {LARGEST_DOMAIN}")
        self.events = Events(log)
        self._domain = _domain(domain_id, interface, tuple(peers))
        self._participant = DomainParticipant(domain_id)

    def writer(self, topic: str, kind: type) -> DataWriter:
        """A reliable writer of the ROS topic of this name."""
        return DataWriter(self._participant, Topic(self._participant, f"rt/{topic}", kind), RELIABLE)

    def reader(self, topic: str, kind: type) -> _Reader:
        """A best-effort reader of the ROS topic of this name."""
        qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(DEPTH))
        return _Reader(DataReader(self._participant, Topic(self._participant, f"rt/{topic}", kind), qos), self.events)

    def close(self) -> None:
        """Leave the domain, once nothing holds a reader or writer."""
        del self._participant


class _Reader:
    """Messages of a topic; one that cannot be decoded is passed over."""

    def __init__(self, reader: DataReader, events: Events) -> None:
        self._reader, self._events, self._name = reader, events, reader.topic.name

    def take(self) -> Iterator[Any]:
        """What has come since the last call, oldest first."""
        for _ in range(DEPTH):
            try:
                samples = self._reader.take(1)  # one by one, or one that is broken takes the others with it
            except Exception as error:  # whatever a decoder may raise on bytes that anyone may send
                self._events.begin(self._name, f"ignoring messages on {self._name} that cannot be decoded: {error}")
                continue
            if not samples:
                return
            if samples[0].sample_info.valid_data:  # not of a writer that has left
                yield samples[0]


@cache
def _domain(domain_id: int, interface: str, peers: tuple[str, ...]) -> Domain:
    """The domain of this process; loopback has no multicast, so participants look for each other by their ports."""
    local = interface == "lo"
    addresses = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in (("127.0.0.1",) if local else ()) + peers)
    multicast = "false" if local or peers else "true"
    return Domain(
        domain_id,
        f"<CycloneDDS><Domain id='any'><General><AllowMulticast>{multicast}</AllowMulticast><Interfaces>"
        f"<NetworkInterface name={quoteattr(interface)}/></Interfaces></General><Discovery>"
        f"<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
        f"<Peers>{addresses}</Peers></Discovery></Domain></CycloneDDS>",
    )
