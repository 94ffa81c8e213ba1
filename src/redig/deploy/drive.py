"""Differential drive: how a robot with two wheels, or two sides of them, follows a velocity vector."""

from __future__ import annotations

import math
from dataclasses import dataclass

from redig.deploy.messages import Vector, check_pace


@dataclass(frozen=True)
class Base:
    """A mobile base with differential drive, by the numbers of its data sheet.

    Args:
        length, width: of the body (m).
        track: between the left and the right wheels (m).
        wheel_radius: (m).
        max_linear: forwards and backwards (m/s); also what a wheel may run at on the ground.
        max_angular: to either side (rad/s).
        max_linear_acceleration: (m/s²).
        max_angular_acceleration: (rad/s²).

    Raises:
        ValueError: for a number that is not greater than 0.

    Examples:
        >>> left, right = LIMO.wheel_speeds(0.5, 1.0)
        >>> round(left, 3), round(right, 3)  # rad/s
        (9.066, 12.912)
        >>> linear, angular = LIMO.body_speeds(left, right)
        >>> round(linear, 9), round(angular, 9)
        (0.5, 1.0)
    """

    length: float
    width: float
    track: float
    wheel_radius: float
    max_linear: float
    max_angular: float
    max_linear_acceleration: float = math.inf
    max_angular_acceleration: float = math.inf

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name}: got {value}, must be greater than 0")

    def wheel_speeds(self, linear: float, angular: float) -> tuple[float, float]:
        """Speeds of the left and the right wheels (rad/s) that make this motion (m/s, rad/s), without slip."""
        across = angular * self.track / 2
        return (linear - across) / self.wheel_radius, (linear + across) / self.wheel_radius

    def body_speeds(self, left: float, right: float) -> tuple[float, float]:
        """Motion (m/s, rad/s) that these wheel speeds (rad/s) make, without slip."""
        return (left + right) * self.wheel_radius / 2, (right - left) * self.wheel_radius / self.track

    def wheel_limit(self, linear: float, angular: float) -> float:
        """How fast the faster wheel runs on the ground (m/s)."""
        return abs(linear) + abs(angular) * self.track / 2


LIMO = Base(0.322, 0.220, 0.175, 0.0455, 1.0, 1.0, 2.5, 3.2)
"""AgileX Limo with four wheels. Size, track and speed: LIMO user manual (github.com/agilexrobotics/limo-doc); wheel
radius: its driver (github.com/agilexrobotics/limo_ros, ``limo_params.h``). The manual gives no limits of turning and of
acceleration; these are of the maker's own navigation (limo_ros, ``planner.yaml``), and lower than what the wheels
allow."""

WARTHOG = Base(1.52, 1.38, 1.08, 0.305, 5.0, 4.0, 50.0, 40.0)
"""Clearpath Warthog. Size, speed (18 km/h) and wheels (610 mm): Warthog user manual, system specifications
(docs.clearpathrobotics.com); track, limits of turning and of acceleration: the maker's controller
(github.com/warthog-cpr/warthog, ``control.yaml``). It is a skid-steered base: on asphalt it turns in place at
0.2 rad/s or more only, and by less than its wheels say; the maker's newer controller counts a track of 1.69 m."""


class DifferentialDrive:
    """Turns velocity vectors into linear and angular velocity, and keeps the limits of the base.

    The base turns towards the vector and drives by the part of it that lies ahead: with the angle ``e`` between them,
    ``v = s cos e``, and ``w = gain * e`` near, ``sqrt(2 a (e - a / (2 gain²)))`` far, with the limit ``a`` of the
    angular acceleration, so that it arrives without overshoot. Where the wheels cannot do both, it turns first.

    * **Behind**: it drives backwards rather than turn around (``reverse``); forwards and backwards change only where
      the vector is more than 120° away, so that noise at 90° changes nothing. Without ``reverse`` it turns in place
      while the vector is more than 90° away, and near 180° goes on to the side to which it turns already.
    * **Near zero**: it stops below ``stop_speed``, starts again above ``start_speed``, and below twice ``start_speed``
      turns the slower, the slower the vector is; there the direction is mostly noise.

    Args:
        base: whose limits it keeps.
        gain: how fast the angle is closed (1/s); at most half the rate of the calls, or it overshoots.
        reverse: drive backwards; not for a robot that does not see behind.
        stop_speed, start_speed: (m/s).
        pace: for vectors of a policy in slow motion, see :class:`~redig.pace.Paced`: ``stop_speed`` and ``start_speed``
            times ``pace``, limits of acceleration times ``pace**2``, which is gentle on ice. The gain stays.

    Raises:
        ValueError: for a gain that is not positive, not ``0 <= stop_speed <= start_speed``, or a pace that is not
            greater than 0 and at most 1.

    Examples:
        >>> drive = DifferentialDrive(LIMO)
        >>> for _ in range(30):
        ...     linear, angular = drive((0.5, 0.0), heading=0.1, dt=0.05)
        >>> round(linear, 3), round(angular, 3)  # a tenth of a radian to the left of the vector: to the right
        (0.498, -0.4)
        >>> drive.stop()
        (0.0, 0.0)
    """

    def __init__(
        self,
        base: Base,
        *,
        gain: float = 4.0,
        reverse: bool = True,
        stop_speed: float = 0.02,
        start_speed: float = 0.05,
        pace: float = 1.0,
    ) -> None:
        if not 0 < gain < math.inf:
            raise ValueError(f"gain: got {gain}, must be greater than 0")
        if not 0 <= stop_speed <= start_speed < math.inf:
            raise ValueError(f"stop_speed, start_speed: got {stop_speed}, {start_speed}, need 0 <= stop <= start")
        self.base, self.gain, self.reverse = base, gain, reverse
        self.stop_speed, self.start_speed = pace * stop_speed, pace * start_speed
        self._acceleration = check_pace(pace) ** 2 * base.max_linear_acceleration
        # of the wheels, too: then a turn can always go first
        self._turn_acceleration = min(pace**2 * base.max_angular_acceleration, 2 * self._acceleration / base.track)
        self.stop()

    def stop(self) -> tuple[float, float]:
        """Zeros at once, without regard to acceleration; what comes next starts from standing."""
        self._linear = self._angular = 0.0
        self._moving, self._gear = False, 1
        return 0.0, 0.0

    def __call__(self, velocity: Vector, heading: float, dt: float) -> tuple[float, float]:
        """Linear (m/s) and angular velocity (rad/s) for a base with this heading (rad).

        Args:
            velocity: vector to follow (m/s), in the frame of the heading.
            heading: of the base (rad), counter-clockwise from x.
            dt: since the last call (s).

        Raises:
            ValueError: for a number that is not finite, or a ``dt`` that is not positive.
        """
        x, y = float(velocity[0]), float(velocity[1])
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(heading)):
            raise ValueError(f"velocity, heading: got {velocity}, {heading}, must be finite")
        if not 0 < dt < math.inf:
            raise ValueError(f"dt: got {dt}, must be greater than 0 s")
        speed = min(math.hypot(x, y), self.base.max_linear)
        error = math.remainder(math.atan2(y, x) - heading, 2 * math.pi)
        linear, angular = self._wanted(speed, error)
        self._linear, self._angular = self._within_limits(linear, angular, dt)
        return self._linear, self._angular

    def _wanted(self, speed: float, error: float) -> tuple[float, float]:
        starts = not self._moving and speed > self.start_speed
        self._moving = starts or (self._moving and speed >= self.stop_speed)
        if not self._moving:
            return 0.0, 0.0
        error = self._folded(error, starts) if self.reverse else self._same_side(error)
        slowness = min(1.0, speed / (2 * self.start_speed)) if self.start_speed else 1.0
        angular = slowness * math.copysign(self._turn_rate(abs(error)), error)
        return self._gear * speed * max(math.cos(error), 0.0), angular

    def _folded(self, error: float, starts: bool) -> float:
        """Error of the end of the base that leads; changes which one that is where it is more than 120° away."""
        ahead = error if self._gear > 0 else math.remainder(error + math.pi, 2 * math.pi)
        if abs(ahead) > math.radians(90 if starts else 120):
            self._gear = -self._gear
            ahead = math.remainder(ahead + math.pi, 2 * math.pi)
        return ahead

    def _same_side(self, error: float) -> float:
        if abs(error) > math.radians(150) and error * self._angular < 0:
            return error - math.copysign(2 * math.pi, error)
        return error

    def _turn_rate(self, error: float) -> float:
        """From an error of at least 0 (rad), as fast as can still be stopped in time (rad/s)."""
        limit = self._turn_acceleration
        near = limit / self.gain**2
        rate = self.gain * error if error <= near else math.sqrt(2 * limit * (error - near / 2))
        return min(rate, self.base.max_angular, 2 * self.base.max_linear / self.base.track)

    def _within_limits(self, linear: float, angular: float, dt: float) -> tuple[float, float]:
        base = self.base
        angular = _towards(self._angular, angular, self._turn_acceleration * dt)
        linear = _towards(self._linear, linear, self._acceleration * dt)
        room = base.max_linear - abs(angular) * base.track / 2  # shrinks no faster than the base can brake
        return max(-room, min(linear, room)), angular


def _towards(start: float, end: float, most: float) -> float:
    return min(max(end, start - most), start + most)
