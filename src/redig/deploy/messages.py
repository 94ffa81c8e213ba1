"""What a robot knows of itself, and says to its neighbours: one type for both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

VELOCITY = slice(2, 4)  # where an observation has it
LARGEST = 1e6  # m, m/s: float32 holds positions of up to here to 6 cm, and nothing that drives is farther or faster

Vector = tuple[float, float]


@dataclass(frozen=True)
class RobotState:
    """State of one robot: its own, or as a neighbour sent it.

    Positions and vectors are along the axes of one world frame, which all robots of a team share.

    Args:
        robot: its name, by which a team tells its robots apart.
        stamp: time at which this was so (s), of the sender's clock.
        position: (m).
        velocity: (m/s).
        goal: where it is to go (m), not relative to its position.
        obstacle_distance: to the nearest obstacle (m), from the robot's centre; negative inside one.
        obstacle_direction: unit vector to that obstacle; shorter near where another one becomes the nearest, if the
            policy was trained with ``direction_smoothing``; zeros where it is not known.

    Examples:
        >>> state = RobotState("robot_0", 12.5, (0.0, 1.0), (0.3, 0.0), (5.5, 1.0), 0.8, (0.0, -1.0))
        >>> state.check()
        >>> RobotState("robot_1", 12.5, (math.nan, 1.0), (0.3, 0.0), (5.5, 1.0), 0.8, (0.0, -1.0)).check()
        Traceback (most recent call last):
        ...
        ValueError: position of robot_1: got (nan, 1.0), must be two finite numbers of at most 1e+06
    """

    robot: str
    stamp: float
    position: Vector
    velocity: Vector
    goal: Vector
    obstacle_distance: float
    obstacle_direction: Vector

    @classmethod
    def of_observation(cls, robot: str, stamp: float, observation: Sequence[float]) -> RobotState:
        """The state that nine numbers of :class:`~redig.envs.FormationNavigation` tell of.

        Examples:
            >>> RobotState.of_observation("robot_0", 12.5, [0.0, 1.0, 0.3, 0.0, 5.5, 0.0, 0.8, 0.0, -1.0]).goal
            (5.5, 1.0)
        """
        x, y, vx, vy, goal_x, goal_y, distance, ox, oy = observation
        return cls(robot, stamp, (x, y), (vx, vy), (x + goal_x, y + goal_y), distance, (ox, oy))

    def observation(self) -> list[float]:
        """The same nine numbers: position, velocity, goal - position, distance and direction of the obstacle."""
        (x, y), (goal_x, goal_y) = self.position, self.goal
        return [x, y, *self.velocity, goal_x - x, goal_y - y, self.obstacle_distance, *self.obstacle_direction]

    def check(self) -> None:
        """Make sure that a policy can use this; whether it is true or fresh, only the receiver can judge.

        Raises:
            ValueError: naming what is missing, not finite, beyond 1e6 m or m/s, or not a direction.
        """
        if not isinstance(self.robot, str) or not self.robot:
            raise ValueError(f"robot: got {self.robot!r}, must be a name")
        for name in ("position", "velocity", "goal", "obstacle_direction"):
            value = getattr(self, name)
            if not (_is_pair(value) and all(_is_finite(x) and abs(x) <= LARGEST for x in value)):
                allowed = f"two finite numbers of at most {LARGEST:g}"
                raise ValueError(f"{name} of {self.robot}: got {value!r}, must be {allowed}")
        for name, limit in (("stamp", math.inf), ("obstacle_distance", LARGEST)):
            value = getattr(self, name)
            if not (_is_finite(value) and abs(value) <= limit):
                allowed = "a finite number" if limit == math.inf else f"a finite number of at most {limit:g}"
                raise ValueError(f"{name} of {self.robot}: got {value!r}, must be {allowed}")
        length = math.hypot(*self.obstacle_direction)
        if length > 1 + 1e-3:
            got = f"got {self.obstacle_direction!r} of length {length:.4g}"
            raise ValueError(f"obstacle_direction of {self.robot}: {got}, must have a length of at most 1")


def _is_pair(value: Any) -> bool:
    try:
        return len(value) == 2
    except TypeError:
        return False


def _is_finite(value: Any) -> bool:
    try:
        return not isinstance(value, bool | str | bytes) and math.isfinite(value)
    except (TypeError, OverflowError):  # no number; an integer that no float can hold
        return False


def check_pace(pace: float) -> float:
    """The same, if it can be a pace.

    Raises:
        ValueError: if it is not greater than 0 and at most 1.

    Examples:
        >>> check_pace(0.5)
        0.5
    """
    if not 0 < pace <= 1:
        raise ValueError(f"pace: got {pace}, must be greater than 0 and at most 1")
    return pace
