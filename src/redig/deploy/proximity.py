"""How far the nearest obstacle is and where, from what a robot has: a map of cells, or a planar laser scan.

Policies were trained on :meth:`ObstacleMap.nearest <redig.envs.ObstacleMap.nearest>`: the distance from the robot's
centre, and the unit vector towards the obstacle in the world frame; or, with ``direction_smoothing``, on
:func:`~redig.envs.direction.smoothed_direction`. Sensors know the robot's frame; :func:`to_world` and :func:`to_robot`
turn vectors between the two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from redig.deploy.messages import Vector


class Proximity(NamedTuple):
    """The nearest obstacle: distance (m), negative inside one, and the unit vector towards it, or a shorter one.

    Examples:
        >>> ahead = Proximity(0.5, (1.0, 0.0))
        >>> ahead.distance
        0.5
    """

    distance: float
    direction: Vector


def to_world(vector: Vector, heading: float) -> Vector:
    """A vector in the frame of a robot with this heading (rad), along the axes of the world.

    Examples:
        >>> x, y = to_world((1.0, 0.0), math.pi / 2)  # ahead of a robot that looks along y
        >>> round(x, 9), round(y, 9)
        (0.0, 1.0)
    """
    (x, y), cos, sin = vector, math.cos(heading), math.sin(heading)
    return cos * x - sin * y, sin * x + cos * y


def to_robot(vector: Vector, heading: float) -> Vector:
    """The inverse of :func:`to_world`.

    Examples:
        >>> x, y = to_robot((0.0, 1.0), math.pi / 2)
        >>> round(x, 9), round(y, 9)
        (1.0, 0.0)
    """
    return to_world(vector, -heading)


def _smoothed(distance: Callable[[Vector], float], place: Vector, reach: float) -> Vector:
    """:func:`~redig.envs.direction.smoothed_direction` at one place, for a distance that is a plain number."""
    x, y = place
    slope_x = (distance((x - reach, y)) - distance((x + reach, y))) / (2 * reach)
    slope_y = (distance((x, y - reach)) - distance((x, y + reach))) / (2 * reach)
    length = max(1.0, math.hypot(slope_x, slope_y))
    return slope_x / length, slope_y / length


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Square cells of a map, occupied or not, as in ROS's ``nav_msgs/OccupancyGrid``; beyond them all is occupied.

    Args:
        occupied: ``[H, W]``, bool; row 0 has the smallest y.
        resolution: length of a cell's side (m).
        origin: x, y (m) of the lower left corner of cell (0, 0), and the heading of the rows (rad).

    Raises:
        ValueError: if ``occupied`` is not a boolean matrix with a free cell, the resolution not positive, or the origin
            not three finite numbers.

    Examples:
        >>> cells = np.zeros((40, 40), bool)
        >>> cells[:, 30] = True  # a wall from x = 3 m on
        >>> grid = OccupancyGrid(cells, 0.1)
        >>> distance, direction = grid.nearest((2.0, 2.0))
        >>> round(distance, 6), direction
        (1.0, (1.0, 0.0))
        >>> distance, (x, y) = grid.nearest_from((2.0, 2.0), heading=math.pi / 2)
        >>> round(distance, 6), round(x, 6), round(y, 6)  # on the right of a robot that looks along y
        (1.0, 0.0, -1.0)
    """

    occupied: NDArray[np.bool_]
    resolution: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.occupied.ndim != 2 or self.occupied.dtype != bool or self.occupied.all():
            got = f"got {self.occupied.dtype} of shape {list(self.occupied.shape)}"
            raise ValueError(f"occupied: {got}, expected bool [H, W] with at least one free cell")
        if not 0 < self.resolution < math.inf:
            raise ValueError(f"resolution: got {self.resolution}, must be greater than 0 m")
        if len(self.origin) != 3 or not all(map(math.isfinite, self.origin)):
            raise ValueError(f"origin: got {self.origin}, must be x, y (m) and heading (rad)")

    def nearest(self, position: Vector, smoothing: float = 0.0) -> Proximity:
        """From a place (m), exact to the closest point of the cell, direction in the world frame.

        In an occupied cell, the distance is minus that to the nearest free one, and the direction points away from
        there, as in training. ``smoothing`` (m) is the ``direction_smoothing`` that the policy was trained with.
        """
        if smoothing > 0:
            direction = _smoothed(lambda place: self.nearest(place).distance, position, smoothing)
            return Proximity(self.nearest(position).distance, direction)
        x, y = to_robot((position[0] - self.origin[0], position[1] - self.origin[1]), self.origin[2])
        place = np.array([x, y]) / self.resolution
        inside = self._is_occupied(place)
        corners = self._free if inside else self._occupied
        offset = np.clip(place, corners, corners + 1) - place
        squared = np.einsum("ij,ij->i", offset, offset)
        closest = int(squared.argmin())
        towards = offset[closest] if squared[closest] > 0 else corners[closest] + 0.5 - place  # at the very edge
        sign = -1.0 if inside else 1.0
        unit = sign * towards / np.linalg.norm(towards)
        distance = sign * math.sqrt(squared[closest]) * self.resolution
        return Proximity(distance, to_world((float(unit[0]), float(unit[1])), self.origin[2]))

    def nearest_from(self, position: Vector, heading: float, smoothing: float = 0.0) -> Proximity:
        """The same with the direction in the frame of a robot with this heading (rad)."""
        distance, direction = self.nearest(position, smoothing)
        return Proximity(distance, to_robot(direction, heading))

    def _is_occupied(self, place: NDArray[np.float64]) -> bool:
        column, row = np.floor(place).astype(int)
        height, width = self.occupied.shape
        return not (0 <= row < height and 0 <= column < width) or bool(self.occupied[row, column])

    @cached_property
    def _occupied(self) -> NDArray[np.float64]:
        return _edge_cells(np.pad(self.occupied, 1, constant_values=True))

    @cached_property
    def _free(self) -> NDArray[np.float64]:
        return _edge_cells(np.pad(~self.occupied, 1, constant_values=False))


def _edge_cells(cells: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Lower left corners ``[M, 2]`` (x, y in cells) of those that touch one of the other kind: no other is nearest."""
    around = np.pad(cells, 1, mode="edge")
    height, width = cells.shape
    within = np.ones_like(cells)
    for row in range(3):
        for column in range(3):
            within &= around[row : row + height, column : column + width]
    return np.argwhere(cells & ~within)[:, ::-1].astype(float) - 1  # the pad


@dataclass(frozen=True, eq=False)
class LaserScan:
    """One planar scan, with the fields of ROS's ``sensor_msgs/LaserScan``.

    Args:
        angle_min: of the first beam (rad), counter-clockwise from ahead.
        angle_increment: from one beam to the next (rad).
        range_min, range_max: between which the sensor measures (m).
        ranges: ``[N]`` (m); ``inf``: nothing there, ``-inf``: too close to be measured, ``nan``: no measurement
            (REP 117).
        mount: x, y (m) and heading (rad) of the sensor in the robot's frame.

    Raises:
        ValueError: if there are no beams, or a number that must be is not finite.

    Examples:
        >>> scan = LaserScan(-math.pi / 2, math.pi / 2, 0.1, 8.0, [2.0, 0.7, math.inf])  # right, ahead, left
        >>> scan.nearest()
        Proximity(distance=0.7, direction=(1.0, 0.0))
    """

    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    ranges: ArrayLike
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if np.ndim(self.ranges) != 1 or np.size(self.ranges) == 0:
            raise ValueError(f"ranges: got shape {list(np.shape(self.ranges))}, expected [N] with N of at least 1")
        for name in ("angle_min", "angle_increment", "range_min", "range_max"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name}: got {getattr(self, name)}, must be finite")
        if not 0 <= self.range_min < self.range_max:
            raise ValueError(f"range_min: got {self.range_min}, must be from 0 to range_max, {self.range_max} m")
        if len(self.mount) != 3 or not all(map(math.isfinite, self.mount)):
            raise ValueError(f"mount: got {self.mount}, must be x, y (m) and heading (rad)")

    def nearest(self, ignore: Sequence[Vector] = (), ignore_radius: float = 0.0, smoothing: float = 0.0) -> Proximity:
        """The nearest of the points that the beams hit, from the robot's centre and in its frame.

        What is between two beams is not seen. Where nothing is hit, the distance is ``range_max`` and the direction is
        zeros: in training there always is a direction, but a wrong one would say more than is known.

        Args:
            ignore: places in the robot's frame (m) where teammates are. Obstacles of the training are walls, teammates
                it hears of, so a scan that shows both would not be what the policy knows.
            ignore_radius: around those places (m).
            smoothing: the ``direction_smoothing`` that the policy was trained with (m); its differences are taken along
                the robot's axes, not the world's.
        """
        ranges = np.asarray(self.ranges, float)
        ranges = np.where(np.isneginf(ranges), self.range_min, ranges)
        hit = (ranges >= self.range_min) & (ranges <= self.range_max)  # neither nan nor inf is
        x, y, heading = self.mount
        angle = heading + self.angle_min + self.angle_increment * np.flatnonzero(hit)
        points = np.stack([x + ranges[hit] * np.cos(angle), y + ranges[hit] * np.sin(angle)], -1)
        for place in ignore:
            points = points[np.hypot(*(points - place).T) > ignore_radius]
        if len(points) == 0:
            return Proximity(self.range_max, (0.0, 0.0))
        distances = np.hypot(*points.T)
        closest = int(distances.argmin())
        distance = float(distances[closest])
        if smoothing > 0:
            return Proximity(distance, _smoothed(lambda place: np.hypot(*(points - place).T).min(), (0, 0), smoothing))
        towards = points[closest] / distance if distance > 0 else np.zeros(2)
        return Proximity(distance, (float(towards[0]), float(towards[1])))
