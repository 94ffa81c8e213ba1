"""Occupancy grid of an obstacle map: what the planners search."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor

from redig.envs.maps import ObstacleMap
from redig.envs.occupancy import OccupancyMap

Point = tuple[float, float]


@dataclass(frozen=True)
class OccupancyGrid:
    """Square cells, occupied or free.

    Cells are numbered column by column, with a border of occupied cells around the grid, so that neither the search nor
    the line of sight has to ask where the grid ends.

    Args:
        occupied: bool ``[H, W]``; row 0 lies at the bottom (smallest y), column 0 at the left.
        resolution: length of a cell's side (m).
        origin: lower left corner of the grid (m).

    Raises:
        ValueError: if ``occupied`` is not a boolean matrix, or the resolution is not positive.

    Examples:
        >>> import torch
        >>> grid = OccupancyGrid(torch.tensor([[False, True]]), resolution=0.5, origin=(0.0, 0.0))
        >>> grid.is_free((0.2, 0.3)), grid.is_free((0.7, 0.3)), grid.is_free((-0.1, 0.3))
        (True, False, False)
    """

    occupied: Tensor
    resolution: float
    origin: Point

    def __post_init__(self) -> None:
        if self.occupied.ndim != 2 or self.occupied.dtype != torch.bool:
            raise ValueError(
                f"occupied: got {self.occupied.dtype} of shape {list(self.occupied.shape)}, expected bool [H, W]"
            )
        if not self.resolution > 0:
            raise ValueError(f"resolution: got {self.resolution}, must be greater than 0 m")

    @property
    def stride(self) -> int:
        """Number of cells in a column, border included."""
        return self.occupied.shape[0] + 2

    @cached_property
    def blocked(self) -> bytes:
        """1 for an occupied cell, 0 for a free one, by cell number."""
        return bytes(torch.nn.functional.pad(self.occupied.cpu(), (1, 1, 1, 1), value=True).T.flatten().tolist())

    @cached_property
    def neighbours(self) -> list[tuple[tuple[int, float], ...]]:
        """Free neighbours of each free cell and the way there (cells); a diagonal needs both cells beside it free."""
        blocked, s = self.blocked, self.stride
        straight = (1, -1, s, -s)
        diagonal = ((s, 1), (s, -1), (-s, 1), (-s, -1))
        moves: list[tuple[tuple[int, float], ...]] = []
        for cell, closed in enumerate(blocked):
            if closed:
                moves.append(())
                continue
            direct = [(cell + d, 1.0) for d in straight if not blocked[cell + d]]
            across = [
                (cell + a + b, math.sqrt(2))
                for a, b in diagonal
                if not (blocked[cell + a] or blocked[cell + b] or blocked[cell + a + b])
            ]
            moves.append((*direct, *across))
        return moves

    def contains(self, point: Point) -> bool:
        """Whether a point (m) lies on the grid."""
        x, y = self._in_cells(point)
        height, width = self.occupied.shape
        return 1 <= x < width + 1 and 1 <= y < height + 1

    def cell(self, point: Point) -> int:
        """Number of the cell that holds a point (m) of the grid."""
        x, y = self._in_cells(point)
        return int(x) * self.stride + int(y)

    def centre(self, cell: int) -> Point:
        """Centre (m) of a cell."""
        column, row = divmod(cell, self.stride)
        return self.origin[0] + (column - 0.5) * self.resolution, self.origin[1] + (row - 0.5) * self.resolution

    def is_free(self, point: Point) -> bool:
        """Whether a point (m) lies in a free cell."""
        return self.contains(point) and not self.blocked[self.cell(point)]

    def nearest_free(self, name: str, point: Point) -> int:
        """Number of the free cell nearest to a point (m): its own if that is free.

        Raises:
            ValueError: naming ``name``, if the point lies outside the grid or no cell is free.
        """
        if not self.contains(point):
            height, width = self.occupied.shape
            corner = (self.origin[0] + width * self.resolution, self.origin[1] + height * self.resolution)
            raise ValueError(f"{name}: got {point} m, outside the bounds from {self.origin} m to {corner} m")
        if self.is_free(point):
            return self.cell(point)
        row, column = (~self.occupied.cpu()).nonzero().unbind(-1)
        if len(row) == 0:
            raise ValueError(f"{name}: got {point} m, but every cell of the grid is occupied")
        x, y = self._in_cells(point)
        nearest = int(((column + 1.5 - x) ** 2 + (row + 1.5 - y) ** 2).argmin())
        return (int(column[nearest]) + 1) * self.stride + int(row[nearest]) + 1

    def line_of_sight(self, start: Point, end: Point) -> bool:
        """Whether the straight line between two points (m) of the grid touches free cells only, edges included."""
        (x0, y0), (x1, y1) = sorted((self._in_cells(start), self._in_cells(end)))
        slope = (y1 - y0) / (x1 - x0) if x1 > x0 else 0.0
        for column in range(int(x0 - 1e-6), int(x1 + 1e-6) + 1):
            enter = y0 + slope * (column - x0) if column > x0 else y0
            leave = y0 + slope * (column + 1 - x0) if column + 1 < x1 else y1
            low, high = (enter, leave) if enter < leave else (leave, enter)
            first = column * self.stride
            if 1 in self.blocked[first + int(low - 1e-6) : first + int(high + 1e-6) + 1]:
                return False
        return True

    def _in_cells(self, point: Point) -> Point:
        """A point (m) in units of cells, counted from the corner of the border."""
        return (point[0] - self.origin[0]) / self.resolution + 1, (point[1] - self.origin[1]) / self.resolution + 1


def occupancy_grid(
    obstacle_map: ObstacleMap | OccupancyMap, resolution: float = 0.1, inflation: float = 0.25
) -> OccupancyGrid:
    """The grid over the bounds of a map: a cell is occupied if its centre is within ``inflation`` of an obstacle.

    Args:
        obstacle_map: the map.
        resolution: length of a cell's side (m).
        inflation: distance (m) to keep from obstacles: the robot's radius and some clearance. A point of a free cell
            may be closer by half a diagonal of the cell.

    Raises:
        ValueError: if the resolution is not positive or the inflation negative.

    Examples:
        >>> from redig.envs.maps import corridor
        >>> grid = occupancy_grid(corridor(width=1.1))
        >>> grid.occupied.shape, grid.is_free((0.0, 0.0)), grid.is_free((0.0, 0.45))
        (torch.Size([80, 80]), True, False)
    """
    if not resolution > 0:
        raise ValueError(f"resolution: got {resolution}, must be greater than 0 m")
    if not inflation >= 0:
        raise ValueError(f"inflation: got {inflation}, must not be negative (m)")
    x_min, y_min, x_max, y_max = obstacle_map.bounds
    width, height = (math.ceil((high - low) / resolution - 1e-6) for low, high in ((x_min, x_max), (y_min, y_max)))
    x = x_min + (torch.arange(width) + 0.5) * resolution
    y = y_min + (torch.arange(height) + 0.5) * resolution
    centres = torch.stack([x.expand(height, width), y.unsqueeze(-1).expand(height, width)], -1)
    distance = obstacle_map.to("cpu").signed_distance(centres)
    return OccupancyGrid(distance < inflation, resolution, (x_min, y_min))


def shortcut(grid: OccupancyGrid, points: list[Point]) -> list[Point]:
    """Pull a path tight: leave out way points as long as the next one is in sight of the last one kept.

    Args:
        grid: the occupancy grid.
        points: the path (m); consecutive points are taken to be connected.

    Examples:
        >>> import torch
        >>> grid = OccupancyGrid(torch.zeros(4, 4, dtype=torch.bool), 1.0, (0.0, 0.0))
        >>> shortcut(grid, [(0.5, 0.5), (1.5, 0.5), (2.5, 1.5), (3.5, 1.5)])
        [(0.5, 0.5), (3.5, 1.5)]
    """
    kept = [points[0]]
    for before, point in pairwise(points[1:]):
        if not grid.line_of_sight(kept[-1], point):
            kept.append(before)
    return [*kept, points[-1]]
