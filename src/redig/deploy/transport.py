"""How a robot's node reaches its sensors, its wheels and its neighbours; and a radio in one process, for tests.

Over ROS 2 this is :class:`redig.deploy.dds.DDSTransport`, over ROS 1 :class:`redig.deploy.ros1.ROS1Transport`.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import count
from typing import NamedTuple, Protocol

from redig.deploy.messages import RobotState


class Sensed(NamedTuple):
    """What a robot senses of itself: its state, and its heading (rad) from the x axis of the world.

    Examples:
        >>> state = RobotState("robot_0", 0.0, (0.0, 0.0), (0.0, 0.0), (5.0, 0.0), 1.0, (0.0, 1.0))
        >>> Sensed(state, heading=0.5).heading
        0.5
    """

    state: RobotState
    heading: float


class BodyVelocity(NamedTuple):
    """A command along the robot's own axes, as ROS's ``Twist`` has it: forward and left (m/s), turn (rad/s).

    Examples:
        >>> BodyVelocity(0.5, 0.0, turn=0.1).forward
        0.5
    """

    forward: float
    left: float
    turn: float


class Transport(Protocol):
    """What a node needs of a robot and of its radio. No call waits.

    Examples:
        >>> transport: Transport = Radio().join("robot_0")
        >>> transport.sense() is None
        True
    """

    def sense(self) -> Sensed | None:
        """This robot's own state, if there is a new one since the last call."""

    def send(self, sensed: Sensed) -> None:
        """Say this to all neighbours."""

    def receive(self) -> Iterable[RobotState]:
        """What neighbours have said since the last call, in the order in which it came."""

    def command(self, velocity: BodyVelocity) -> None:
        """Drive like this until the next command."""

    def close(self) -> None:
        """Leave the network."""


@dataclass(frozen=True)
class Faults:
    """What a radio does to messages, each copy to each receiver by itself.

    Args:
        loss: part that never arrives, from 0 to 1.
        delay: of every message (s).
        jitter: largest further delay (s), drawn uniformly; messages overtake each other if it exceeds their interval.
        duplication: part that arrives once more, up to ``delay + jitter + 0.5`` s later.

    Raises:
        ValueError: for a part outside [0, 1], or a negative time.

    Examples:
        >>> Faults(loss=0.3, delay=0.2)
        Faults(loss=0.3, delay=0.2, jitter=0.0, duplication=0.0)
    """

    loss: float = 0.0
    delay: float = 0.0
    jitter: float = 0.0
    duplication: float = 0.0

    def __post_init__(self) -> None:
        for name in ("loss", "duplication"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: got {getattr(self, name)}, must be in [0, 1]")
        for name in ("delay", "jitter"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name}: got {getattr(self, name)} s, must be at least 0")


class Radio:
    """A medium between robots of one process, in simulated time: it loses, delays, repeats and reorders messages.

    Args:
        faults: what it does to them.
        seed: of which messages that befalls.

    Attributes:
        now: simulated time (s), set by whoever moves the robots.

    Examples:
        >>> radio = Radio(Faults(delay=0.2))
        >>> first, second = radio.join("robot_0"), radio.join("robot_1")
        >>> state = RobotState("robot_0", 0.0, (0.0, 0.0), (0.0, 0.0), (5.0, 0.0), 1.0, (0.0, 1.0))
        >>> first.send(Sensed(state, heading=0.0))
        >>> len(second.receive())
        0
        >>> radio.now = 0.2
        >>> [message.robot for message in second.receive()]
        ['robot_0']
    """

    def __init__(self, faults: Faults | None = None, seed: int = 0) -> None:
        self.faults = Faults() if faults is None else faults
        self.now = 0.0
        self._random, self._number = random.Random(seed), count()
        self._air: dict[str, list[tuple[float, int, RobotState]]] = {}

    def join(self, robot: str) -> InProcessTransport:
        """A transport for the robot of this name.

        Raises:
            ValueError: if there is one already.
        """
        if robot in self._air:
            raise ValueError(f"robot: got {robot!r}, which has joined already")
        self._air[robot] = []
        return InProcessTransport(self, robot)

    def send(self, sender: str, state: RobotState) -> None:
        """Put a message on the air, whatever it says, to all but its sender."""
        for robot, queue in self._air.items():
            if robot == sender or self._random.random() < self.faults.loss:
                continue
            due = self.now + self.faults.delay + self.faults.jitter * self._random.random()
            heapq.heappush(queue, (due, next(self._number), state))
            if self._random.random() < self.faults.duplication:
                heapq.heappush(queue, (due + 0.5 * self._random.random(), next(self._number), state))

    def receive(self, robot: str) -> list[RobotState]:
        """What has come to this robot by now."""
        queue, arrived = self._air[robot], []
        while queue and queue[0][0] <= self.now + 1e-9:  # sums of time steps are off by some 1e-15
            arrived.append(heapq.heappop(queue)[2])
        return arrived


class InProcessTransport:
    """One robot on a :class:`Radio`; made by :meth:`Radio.join`.

    Attributes:
        sensed: what :meth:`sense` is to give next, set by the world.
        commanded: the last command, read by the world; at first to stand.

    Examples:
        >>> transport = Radio().join("robot_0")
        >>> transport.command(BodyVelocity(0.5, 0.0, 0.0))
        >>> transport.commanded.forward
        0.5
    """

    def __init__(self, radio: Radio, robot: str) -> None:
        self._radio, self._robot = radio, robot
        self.sensed: Sensed | None = None
        self.commanded = BodyVelocity(0.0, 0.0, 0.0)

    def sense(self) -> Sensed | None:
        """What the world has set, once."""
        sensed, self.sensed = self.sensed, None
        return sensed

    def send(self, sensed: Sensed) -> None:
        """To all robots that have joined."""
        self._radio.send(self._robot, sensed.state)

    def receive(self) -> list[RobotState]:
        """What has come by the radio's time."""
        return self._radio.receive(self._robot)

    def command(self, velocity: BodyVelocity) -> None:
        """Leave it for the world."""
        self.commanded = velocity

    def close(self) -> None:
        """Nothing to leave."""
