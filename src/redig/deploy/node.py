"""The loop of one robot: sense, tell the neighbours, listen, decide, drive. One process a robot."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from threading import Event

from redig.deploy.drive import DifferentialDrive
from redig.deploy.events import Events
from redig.deploy.messages import Vector
from redig.deploy.pilot import STAND, Pilot
from redig.deploy.proximity import to_robot
from redig.deploy.transport import BodyVelocity, Transport

Drive = Callable[[Vector, float], BodyVelocity]
REST = BodyVelocity(0.0, 0.0, 0.0)
log = logging.getLogger(__name__)


class RobotNode:
    """A pilot between a transport's two ends.

    Args:
        transport: to the robot and to its neighbours.
        pilot: decides.
        drive: turns a velocity in the world frame (m/s) and the robot's heading (rad) into a command along its axes;
            default: :func:`holonomic`.
        clock: seconds that never go back.

    Examples:
        >>> from redig.deploy.messages import RobotState
        >>> from redig.deploy.transport import Radio, Sensed
        >>> transport = Radio().join("robot_0")
        >>> node = RobotNode(transport, Pilot("robot_0", [], lambda own, neighbours: (0.6, 0.0)))
        >>> state = RobotState("robot_0", 0.0, (0.0, 0.0), (0.0, 0.0), (5.0, 0.0), 1.0, (0.0, 1.0))
        >>> transport.sensed = Sensed(state, heading=0.0)
        >>> node.step()
        >>> transport.commanded
        BodyVelocity(forward=0.6, left=0.0, turn=0.0)
    """

    def __init__(
        self,
        transport: Transport,
        pilot: Pilot,
        drive: Drive | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._transport, self._pilot, self._clock = transport, pilot, clock
        self._drive = holonomic if drive is None else drive
        self._events = Events(log)
        self._heading = 0.0

    def step(self) -> None:
        """One round."""
        self.tell()
        self.act()

    def tell(self) -> None:
        """Take the own state, if there is a new one that can be used, and send it to the neighbours."""
        sensed = self._transport.sense()
        if sensed is None or not math.isfinite(sensed.heading):
            return
        if self._pilot.sense(sensed.state, self._clock()):
            self._heading = sensed.heading
            self._transport.send(sensed)

    def act(self) -> None:
        """Take what neighbours have sent, decide, and command; a command is always finite."""
        now = self._clock()
        for state in self._transport.receive():
            self._pilot.hear(state, now)
        command = self._drive(self._pilot.decide(now), self._heading)
        self._transport.command(command if all(map(math.isfinite, command)) else REST)

    def run(self, rate: float, stop: Event) -> None:
        """Rounds at ``rate`` (Hz) until ``stop`` is set; then the robot is told to stand.

        A round that raises is logged, the robot is told to stand, and the next one is tried.

        Raises:
            ValueError: if ``rate`` is not positive.
        """
        if not 0 < rate < math.inf:
            raise ValueError(f"rate: got {rate} Hz, must be greater than 0")
        due = time.monotonic()
        while not stop.is_set():
            try:
                self.step()
                self._events.end("step", f"{self._pilot.robot} works again")
            except Exception as error:
                self._events.begin("step", f"standing: {type(error).__name__}: {error}")
                self._stand()
            due = max(due + 1 / rate, time.monotonic())  # rounds that were missed are not made up for
            stop.wait(due - time.monotonic())
        self._stand()

    def _stand(self) -> None:
        try:
            self._transport.command(REST)
        except Exception as error:
            self._events.begin("stand", f"cannot command: {type(error).__name__}: {error}")


class Wheels:
    """The command of a robot with differential drive; to stand is to stand at once.

    Args:
        drive: of its base.
        clock: seconds that never go back.

    Examples:
        >>> from redig.deploy.drive import LIMO
        >>> Wheels(DifferentialDrive(LIMO))((0.0, 0.0), heading=0.0)
        BodyVelocity(forward=0.0, left=0.0, turn=0.0)
    """

    def __init__(self, drive: DifferentialDrive, clock: Callable[[], float] = time.monotonic) -> None:
        self._drive, self._clock = drive, clock
        self._last = clock()

    def __call__(self, velocity: Vector, heading: float) -> BodyVelocity:
        """Linear and angular velocity that follow ``velocity`` (m/s, world frame) within the limits of the base."""
        now = self._clock()
        since, self._last = max(now - self._last, 1e-3), now
        linear, angular = self._drive.stop() if velocity == STAND else self._drive(velocity, heading, since)
        return BodyVelocity(linear, 0.0, angular)


def holonomic(velocity: Vector, heading: float) -> BodyVelocity:
    """The command of a robot that drives in all directions: the velocity along its own axes, no turn.

    Examples:
        >>> forward, left, turn = holonomic((0.0, 1.0), heading=1.5707963)
        >>> round(forward, 6), round(left, 6), turn
        (1.0, 0.0, 0.0)
    """
    return BodyVelocity(*to_robot(velocity, heading), 0.0)
