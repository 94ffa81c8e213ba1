"""Events in a log: a line when something begins, not one for each message that it befalls."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass
class _Event:
    """When something last happened and was last logged (s), whether it goes on, and whether its begin was logged."""

    at: float
    logged: float
    on: bool
    told: bool


class Events:
    """Logs what begins, and what ends if its begin was logged; what comes and goes, only now and then.

    Args:
        log: where to.
        quiet: without it for so long (s), it has ended by itself; nor is its begin logged again any sooner.
        clock: seconds that never go back.

    Examples:
        >>> import sys
        >>> log = logging.Logger("robot_0")
        >>> log.addHandler(logging.StreamHandler(sys.stdout))
        >>> events = Events(log)
        >>> for _ in range(1000):
        ...     events.begin("robot_1", "robot_1 sends nonsense")
        robot_1 sends nonsense
        >>> events.end("robot_1", "robot_1 makes sense again")
        robot_1 makes sense again
        >>> events.begin("robot_1", "robot_1 sends nonsense")
    """

    def __init__(self, log: logging.Logger, quiet: float = 10.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._log, self._quiet, self._clock = log, quiet, clock
        self._seen: dict[str, _Event] = {}

    def begin(self, event: str, message: str) -> None:
        """It happens now; ``message`` is logged as a warning if that is new."""
        now = self._clock()
        seen = self._seen.setdefault(event, _Event(now, -math.inf, on=False, told=False))
        goes_on = seen.on and now - seen.at <= self._quiet
        if not goes_on:
            seen.told = now - seen.logged > self._quiet
            if seen.told:
                seen.logged = now
                self._log.warning(message)
        seen.at, seen.on = now, True

    def end(self, event: str, message: str) -> None:
        """It is over; ``message`` is logged if its begin was."""
        seen = self._seen.get(event)
        if seen is not None and seen.on:
            seen.on = False
            if seen.told:
                self._log.info(message)
