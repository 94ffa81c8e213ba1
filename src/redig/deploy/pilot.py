"""What one robot decides: the policy's command if all is well, to stand if not, and within its limits in any case."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from queue import Empty, Queue
from threading import Lock, Thread

from numpy.typing import ArrayLike

from redig.deploy.events import Events
from redig.deploy.hearing import Hearing
from redig.deploy.messages import RobotState, Vector

Policy = Callable[[RobotState, Sequence[RobotState]], ArrayLike]
STAND = (0.0, 0.0)
log = logging.getLogger(__name__)


class Pilot:
    """Decides for one robot: own state and messages in, velocity command in the world frame out.

    It drives by the policy on the newest own state and the neighbours that it believes, see
    :class:`~redig.deploy.hearing.Hearing`. Within ``goal_radius`` of its goal it has arrived, and holds there until it
    is given another goal, as robots of the scenario do. It stands while its own state is older than ``own_timeout``,
    and when the policy fails, is late, or gives what is not a finite number.

    Args:
        robot: its name.
        neighbours: names of those to listen to.
        policy: of own state and neighbours to a velocity ``[2]`` (m/s), such as a
            :class:`~redig.deploy.RobotPolicy`.
        max_speed: limit of the command's norm (m/s).
        timeout: after which a neighbour that is not heard is dropped (s).
        own_timeout: after which its own state is stale (s).
        goal_radius: within which it has arrived (m).
        hold_time: in which it returns to a goal that it has arrived at (s).

    Raises:
        ValueError: if a number is not positive.

    Examples:
        >>> pilot = Pilot("robot_0", ["robot_1"], lambda own, neighbours: (3.0, 4.0), max_speed=1.0)
        >>> pilot.decide(now=0.0)  # it does not know where it is
        (0.0, 0.0)
        >>> pilot.sense(RobotState("robot_0", 0.0, (0.0, 0.0), (0.0, 0.0), (5.0, 0.0), 1.0, (0.0, 1.0)), now=0.0)
        True
        >>> pilot.decide(now=0.1)
        (0.6, 0.8)
    """

    def __init__(
        self,
        robot: str,
        neighbours: Sequence[str],
        policy: Policy,
        *,
        max_speed: float = 1.0,
        timeout: float = 0.5,
        own_timeout: float = 0.3,
        goal_radius: float = 0.1,
        hold_time: float = 0.4,
    ) -> None:
        limits = {
            "max_speed": max_speed,
            "own_timeout": own_timeout,
            "goal_radius": goal_radius,
            "hold_time": hold_time,
        }
        for name, value in limits.items():
            if not 0 < value < math.inf:
                raise ValueError(f"{name}: got {value}, must be greater than 0")
        self.robot, self.max_speed = robot, max_speed
        self._policy, self._goal_radius, self._hold_time = policy, goal_radius, hold_time
        self._events = Events(log)
        fastest = 3 * max_speed  # bumped, or measured badly; above that it is no robot of this team
        self._own = Hearing([robot], own_timeout, fastest, self._events)
        self._mates = Hearing([mate for mate in neighbours if mate != robot], timeout, fastest, self._events)
        self._arrived_at: Vector | None = None

    def sense(self, state: RobotState, now: float) -> bool:
        """Take an own state that came at ``now`` (s); returns whether it can be used."""
        return self._own.hear(state, now)

    def hear(self, state: RobotState, now: float) -> bool:
        """Take a neighbour's message that came at ``now`` (s); returns whether it is believed."""
        return self._mates.hear(state, now)

    def decide(self, now: float) -> Vector:
        """The command (m/s) at ``now`` (s)."""
        believed = self._own.believed(now)
        if not believed:
            self._events.begin("own", f"standing: {self.robot} has no own state")
            return STAND
        self._events.end("own", f"{self.robot} knows its own state")
        own, neighbours = believed[0], self._mates.believed(now)
        return limited(self._hold(own) if self._arrived(own) else self._drive(own, neighbours), self.max_speed)

    def _arrived(self, own: RobotState) -> bool:
        if self._arrived_at != own.goal:
            self._arrived_at = own.goal if math.dist(own.position, own.goal) < self._goal_radius else None
            if self._arrived_at is not None:
                log.info("%s has arrived", self.robot)
        return self._arrived_at is not None

    def _hold(self, own: RobotState) -> Vector:
        (x, y), (goal_x, goal_y) = own.position, own.goal
        return (goal_x - x) / self._hold_time, (goal_y - y) / self._hold_time

    def _drive(self, own: RobotState, neighbours: Sequence[RobotState]) -> Vector:
        try:
            x, y = map(float, self._policy(own, neighbours))  # type: ignore[arg-type]
            if not (math.isfinite(x) and math.isfinite(y)):
                raise ValueError(f"the policy gave {x}, {y}")
        except Exception as error:  # whatever it is, the robot must stand, and must not stop deciding
            self._events.begin("policy", f"standing: {type(error).__name__}: {error}")
            return STAND
        self._events.end("policy", "the policy drives again")
        return x, y


class Deadline:
    """A policy that is given so long for a step; what takes longer raises ``TimeoutError``, and is thrown away.

    The step goes on in its thread; until it is done, all further steps raise at once. The robot stands meanwhile.

    Args:
        policy: what is to be called.
        seconds: for a step.

    Raises:
        ValueError: if ``seconds`` is not positive.

    Examples:
        >>> Deadline(lambda own, neighbours: (1.0, 0.0), seconds=1.0)(None, [])
        (1.0, 0.0)
    """

    def __init__(self, policy: Policy, seconds: float) -> None:
        if not seconds > 0:
            raise ValueError(f"deadline: got {seconds} s, must be greater than 0")
        self._policy, self._seconds, self._busy = policy, seconds, Lock()

    def __call__(self, own: RobotState, neighbours: Sequence[RobotState]) -> ArrayLike:
        """The command of the policy, in time."""
        if not self._busy.acquire(blocking=False):
            raise TimeoutError(f"a step of the policy still takes longer than {self._seconds:g} s")
        answer: Queue[tuple[ArrayLike | None, Exception | None]] = Queue(1)
        Thread(target=self._step, args=(own, neighbours, answer), daemon=True).start()
        try:
            command, error = answer.get(timeout=self._seconds)
        except Empty:
            raise TimeoutError(f"a step of the policy takes longer than {self._seconds:g} s") from None
        if error is not None:
            raise error
        return command  # type: ignore[return-value]

    def _step(self, own: RobotState, neighbours: Sequence[RobotState], answer: Queue) -> None:
        command, failure = None, None
        try:
            command = self._policy(own, neighbours)
        except Exception as error:
            failure = error
        self._busy.release()
        answer.put((command, failure))


def limited(vector: Vector, limit: float) -> Vector:
    """A vector shortened to a norm of at most ``limit``, its direction kept.

    Examples:
        >>> limited((3.0, 4.0), 1.0)
        (0.6, 0.8)
    """
    norm = math.hypot(*vector)
    return vector if norm <= limit else (vector[0] * limit / norm, vector[1] * limit / norm)
