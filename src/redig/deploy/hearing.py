"""What a robot believes of what it hears: fresh, in order, possible, and from robots that it knows."""

from __future__ import annotations

import logging
import math
from collections.abc import Collection
from dataclasses import dataclass

from redig.deploy.events import Events
from redig.deploy.messages import RobotState

LEAP = 0.5  # m: as far may a robot jump when its localisation corrects itself
DRIFT = 0.01  # s/s: by as much may the clocks of two robots run apart
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Heard:
    """A message, when it came (s, the receiver's clock) and the least lag of its sender's messages (s)."""

    state: RobotState
    at: float
    lag: float


class Hearing:
    """The newest message of each robot that can still be believed.

    Clocks of robots need not agree. How old a message is counts from when it came, by the receiver's clock. The
    sender's stamps tell in which order its messages were sent, and how much longer than the fastest of them one was
    under way: by more than ``timeout``, and it is passed over, as is one from the future. Passed over are also messages
    of robots not known, those that ``RobotState.check`` refuses, robots faster than
    ``fastest``, and robots that leap. One whose last message came more than ``timeout`` ago is forgotten, stamps and
    all: when it is back, even with a clock that was reset, it is heard like a new one.

    Args:
        robots: names of those to listen to.
        timeout: for which a message counts (s).
        fastest: speed of a robot (m/s) above which its message is taken for an error or a lie.
        events: to log with: lost, back, and what was passed over, once each.

    Raises:
        ValueError: if ``timeout`` or ``fastest`` is not positive.

    Examples:
        >>> hearing = Hearing(["robot_1"], timeout=0.5, fastest=2.0)
        >>> hearing.hear(RobotState("robot_1", 99.0, (0.0, 0.0), (0.5, 0.0), (5.0, 0.0), 1.0, (0.0, 1.0)), now=0.0)
        True
        >>> hearing.hear(RobotState("robot_1", 99.0, (0.0, 0.0), (0.5, 0.0), (5.0, 0.0), 1.0, (0.0, 1.0)), now=0.1)
        False
        >>> len(hearing.believed(now=0.5)), len(hearing.believed(now=0.6))
        (1, 0)
    """

    def __init__(self, robots: Collection[str], timeout: float, fastest: float, events: Events | None = None) -> None:
        for name, value in (("timeout", timeout), ("fastest", fastest)):
            if not value > 0:
                raise ValueError(f"{name}: got {value}, must be greater than 0")
        self._robots, self._timeout, self._fastest = set(robots), timeout, fastest
        self._events = Events(log) if events is None else events
        self._heard: dict[str, _Heard] = {}

    def hear(self, state: RobotState, now: float) -> bool:
        """Take a message that came at ``now`` (s, a clock that never goes back); returns whether it is believed."""
        self._forget(now)
        objection = self._objection(state, now)
        if objection:
            kind, words = objection
            self._events.begin(f"{kind} {_name(state)}", f"ignoring messages of {_name(state)}: {words}")
            return False
        last, lag = self._heard.get(state.robot), now - state.stamp
        if last is not None:
            lag = min(lag, last.lag + DRIFT * (now - last.at))
        self._heard[state.robot] = _Heard(state, now, lag)
        self._events.end(f"lost {state.robot}", f"hearing {state.robot} again")
        return True

    def believed(self, now: float) -> list[RobotState]:
        """The newest message of each robot that has been heard lately, by name."""
        self._forget(now)
        return [self._heard[robot].state for robot in sorted(self._heard)]

    def _forget(self, now: float) -> None:
        for robot in [robot for robot, heard in self._heard.items() if now - heard.at > self._timeout]:
            del self._heard[robot]
            self._events.begin(f"lost {robot}", f"lost {robot}: nothing heard for {self._timeout:g} s")

    def _objection(self, state: RobotState, now: float) -> tuple[str, str] | None:
        """What is wrong with a message, in short and in words."""
        try:
            state.check()
        except ValueError as error:
            return "unusable", str(error)
        if state.robot not in self._robots:
            return "unknown", "not one of the team"
        if math.hypot(*state.velocity) > self._fastest:
            return "speed", f"{math.hypot(*state.velocity):.3g} m/s, faster than {self._fastest:g} m/s"
        last = self._heard.get(state.robot)
        if last is None:
            return None
        if state.stamp <= last.state.stamp:
            return "order", "sent twice, or overtaken"
        late = now - state.stamp - last.lag
        if abs(late) > self._timeout:
            return "stale", f"{late:.3g} s later than others of it" if late > 0 else f"from {-late:.3g} s ahead"
        if math.dist(state.position, last.state.position) > LEAP + self._fastest * (state.stamp - last.state.stamp):
            return "leap", f"it would have leapt {math.dist(state.position, last.state.position):.3g} m"
        return None


def _name(state: RobotState) -> str:
    """For the log: as anyone may send a message, not more of its name than there is room for."""
    return repr(state.robot)[:40]
