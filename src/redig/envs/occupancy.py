"""Occupancy grids from files, as ROS map servers write them, with the interface of an obstacle map."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import torch
import yaml
from torch import Tensor

from redig.envs.routes import check_route

REQUIRED = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")  # of a YAML file


@dataclass(frozen=True)
class OccupancyMap:
    """Square cells, occupied or free, as a signed distance field; what lies beyond them is occupied.

    The distance from the centre of a cell is exact; between centres it is interpolated (bilinearly). So it is exact
    along a straight wall, at most 0.31 of a cell too great at a corner and 0.6 too small half way between walls.

    Args:
        occupied: bool ``[H, W]``; row 0 lies at the bottom (smallest y), column 0 at the left.
        resolution: length of a cell's side (m).
        origin: x, y (m) of the lower left corner of cell (0, 0), and the heading of the rows (rad).
        gap: breadth of the narrowest passage that the team must take (m).
        route: see :class:`~redig.envs.maps.ObstacleMap`.

    Raises:
        ValueError: if ``occupied`` is not a boolean matrix, resolution or gap not positive, the origin not three finite
            numbers, or the route not one.

    Examples:
        >>> free = OccupancyMap(torch.zeros(10, 20, dtype=torch.bool), 0.1, (-1.0, -0.5, 0.0), gap=1.0)
        >>> distance, direction = free.nearest(torch.tensor([0.0, 0.25]))
        >>> round(distance.item(), 4), direction[1].item()  # what is beyond the grid is a wall
        (0.25, 1.0)
    """

    occupied: Tensor
    resolution: float
    origin: tuple[float, float, float]
    gap: float
    route: Tensor | None = None

    def __post_init__(self) -> None:
        if self.occupied.ndim != 2 or self.occupied.dtype != torch.bool or self.occupied.numel() == 0:
            raise ValueError(
                f"occupied: got {self.occupied.dtype} of shape {list(self.occupied.shape)}, expected bool [H, W]"
            )
        for name, value in (("resolution", self.resolution), ("gap", self.gap)):
            if not 0 < value < math.inf:
                raise ValueError(f"{name}: got {value}, must be greater than 0 m")
        if len(self.origin) != 3 or not all(math.isfinite(number) for number in self.origin):
            raise ValueError(f"origin: got {self.origin}, must be x, y (m) and yaw (rad)")
        if self.route is not None:
            check_route(self.route)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """``(x_min, y_min, x_max, y_max)`` (m) of the grid, which may be turned."""
        corners = self._to_world(*self.occupied.shape[::-1])
        x, y = zip(*corners, strict=True)
        return min(x), min(y), max(x), max(y)

    @cached_property
    def field(self) -> Tensor:
        """Signed distance (m) at the centres of all cells and of a border of occupied ones: ``[H + 2, W + 2]``."""
        occupied = torch.nn.functional.pad(self.occupied, (1, 1, 1, 1), value=True)
        return (distance_to_cells(occupied) - distance_to_cells(~occupied)) * self.resolution

    def to(self, device: torch.device | str) -> OccupancyMap:
        """The same map on another device."""
        route = None if self.route is None else self.route.to(device)
        return replace(self, occupied=self.occupied.to(device), route=route)

    def signed_distance(self, point: Tensor) -> Tensor:
        """Signed distance (m) from ``point`` ``[*B, 2]`` to the nearest occupied cell: ``[*B]``."""
        return self._interpolate(point)[0]

    def nearest(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance ``[*B]`` (m) of ``point`` ``[*B, 2]`` and the unit vector to the nearest occupied cell.

        Inside an occupied cell the direction points away from the nearest way out. It is minus the normalised gradient
        of the distance; where that vanishes, half way between walls, it is along x.
        """
        distance, x, y = self._interpolate(point)
        flat = torch.hypot(x, y) < 1e-6
        x, y = torch.where(flat, -1.0, x), torch.where(flat, 0.0, y)  # before dividing, so that gradients stay finite
        norm = torch.hypot(x, y)
        x, y = x / norm, y / norm
        cos, sin = math.cos(self.origin[2]), math.sin(self.origin[2])
        return distance, -torch.stack([cos * x - sin * y, sin * x + cos * y], -1)

    def _interpolate(self, point: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Distance (m) and its gradient in the frame of the grid, each ``[*B]``; outside, down towards the border."""
        (x0, y0, yaw), field = self.origin, self.field.to(point.dtype)
        height, width = field.shape
        x, y = point[..., 0] - x0, point[..., 1] - y0
        x, y = math.cos(yaw) * x + math.sin(yaw) * y, math.cos(yaw) * y - math.sin(yaw) * x
        x, y = x / self.resolution + 0.5, y / self.resolution + 0.5  # in cells, from the centre of the border's corner
        near_x, near_y = x.clamp(0, width - 1), y.clamp(0, height - 1)
        column, row = near_x.long().clamp_max(width - 2), near_y.long().clamp_max(height - 2)
        u, v = near_x - column, near_y - row
        corner = row * width + column
        a, b, c, d = (field.flatten()[corner + step] for step in (0, 1, width, width + 1))
        inside = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
        beyond_x, beyond_y = x - near_x, y - near_y
        beyond = torch.stack([beyond_x, beyond_y], -1).norm(dim=-1)  # hypot has no gradient at 0
        outside = beyond > 0
        slope_x = torch.where(outside, -beyond_x, (1 - v) * (b - a) + v * (d - c))
        slope_y = torch.where(outside, -beyond_y, (1 - u) * (c - a) + u * (d - b))
        return inside - beyond * self.resolution, slope_x, slope_y

    def _to_world(self, width: float, height: float) -> list[tuple[float, float]]:
        """Corners (m) of a rectangle of cells whose lower left one is the origin's."""
        x0, y0, yaw = self.origin
        cos, sin = math.cos(yaw) * self.resolution, math.sin(yaw) * self.resolution
        cells = ((0, 0), (width, 0), (width, height), (0, height))
        return [(x0 + cos * x - sin * y, y0 + sin * x + cos * y) for x, y in cells]


def distance_to_cells(cells: Tensor) -> Tensor:
    """Distance (in cells) from the centre of every cell to the nearest marked square cell, 0 in a marked one.

    Exact: the square of the distance is the least sum of its parts along the rows and along the columns.

    Args:
        cells: bool ``[H, W]``.

    Returns:
        float ``[H, W]``; infinite if no cell is marked.

    Examples:
        >>> distance_to_cells(torch.tensor([[True, False, False], [False, False, False]]))
        tensor([[0.0000, 0.5000, 1.5000],
                [0.5000, 0.7071, 1.5811]])
    """
    row = torch.arange(len(cells), dtype=torch.float32, device=cells.device).unsqueeze(-1)
    above = torch.where(cells, row, -torch.inf).cummax(0).values
    below = torch.where(cells, row, torch.inf).flip(0).cummin(0).values.flip(0)
    # to the near side of the nearest marked cell of the same column, [W, H]
    squared = (torch.minimum(row - above, below - row) - 0.5).clamp_min(0).square().T
    nearest = squared.clone()
    for step in range(1, len(nearest)):
        across = (step - 0.5) ** 2
        if across >= nearest.max():  # what is further away cannot be nearer
            break
        torch.minimum(nearest[step:], squared[:-step] + across, out=nearest[step:])
        torch.minimum(nearest[:-step], squared[step:] + across, out=nearest[:-step])
    return nearest.T.sqrt()


def load_occupancy_map(
    path: str | os.PathLike,
    *,
    gap: float | None = None,
    route: Sequence[Sequence[float]] | None = None,
    resolution: float | None = None,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    unknown_is_free: bool = False,
) -> OccupancyMap:
    """An occupancy grid from a file: a YAML file of a ROS map server (mode trinary), or an image alone.

    The YAML file names the image (PGM or PNG), ``resolution`` (m), ``origin`` (x, y, yaw), ``negate``,
    ``occupied_thresh`` and ``free_thresh``. Two more keys, which map servers ignore, say what only a team needs:
    ``gap`` (m) and ``route`` (``[[x, y], ...]``, m). A pixel is occupied with probability ``p = 1 - shade`` (or
    ``shade``, if ``negate``), the shade being the mean of its channels; it is an obstacle if p is greater than
    ``occupied_thresh``, free if less than ``free_thresh``, and unknown in between.

    Args:
        path: of a ``.yaml`` file or of an image.
        gap: breadth of the narrowest passage (m); replaces the file's.
        route: the team's way ``[W, 2]`` (m), see :class:`~redig.envs.maps.ObstacleMap`; replaces the file's.
        resolution: length of a pixel's side (m), for an image alone, which has the thresholds 0.65 and 0.196.
        origin: x, y (m) and yaw (rad) of the lower left pixel's corner, for an image alone.
        unknown_is_free: unknown pixels are free; otherwise they are obstacles.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is not what it should be, or does not say what is needed.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> image = np.full((40, 60), 254, dtype=np.uint8)
        >>> image[15:25, 20:40] = 0  # a block in the middle
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     imageio.imwrite(f"{folder}/map.png", image)
        ...     grid = load_occupancy_map(f"{folder}/map.png", resolution=0.1, gap=1.5)
        >>> grid.bounds, round(grid.signed_distance(torch.tensor([3.0, 3.0])).item(), 4)
        ((0.0, 0.0, 6.0, 4.0), 0.5)
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"path: no such file: {path}")
    if path.suffix.lower() in (".yaml", ".yml"):
        settings = _read_yaml(path)
    elif resolution is None:
        raise ValueError(f"resolution: got None, but {path.name} is an image alone, which does not say it; give it (m)")
    else:
        settings = {"image": path, "resolution": resolution, "origin": origin}
    gap = settings.get("gap") if gap is None else gap
    if gap is None:
        raise ValueError(
            f"gap: got None, and {path.name} does not say it; give the breadth of the narrowest passage (m)"
        )
    route = settings.get("route") if route is None else route
    probability = _read_probability(settings["image"], bool(settings.get("negate", 0)))
    if unknown_is_free:
        occupied = probability > settings.get("occupied_thresh", 0.65)
    else:
        occupied = ~(probability < settings.get("free_thresh", 0.196))
    return OccupancyMap(
        occupied.flip(0),
        settings["resolution"],
        settings["origin"],
        gap,
        None if route is None else torch.tensor(route, dtype=torch.float32),
    )


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        settings = yaml.safe_load(path.read_text())
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"path: {path} is not a YAML file ({error})") from error
    missing = [key for key in REQUIRED if key not in settings] if isinstance(settings, dict) else REQUIRED
    if missing:
        raise ValueError(f"path: {path} lacks {', '.join(missing)}")
    if (mode := settings.get("mode", "trinary")) != "trinary":
        raise ValueError(f"mode: got {mode!r} in {path}, only trinary is supported")
    for key in ("resolution", "occupied_thresh", "free_thresh", "gap"):
        if not isinstance(settings.get(key, 1), (int, float)):
            raise ValueError(f"{key}: got {settings[key]!r} in {path}, must be a number")
    if not isinstance(settings["origin"], list):
        raise ValueError(f"origin: got {settings['origin']!r} in {path}, must be [x, y, yaw]")
    if not 0 <= settings["free_thresh"] <= settings["occupied_thresh"] <= 1:
        raise ValueError(f"free_thresh: got {settings['free_thresh']} in {path}, must be from 0 to occupied_thresh")
    return {**settings, "image": path.parent / str(settings["image"]), "origin": tuple(settings["origin"])}


def _read_probability(path: Path, negate: bool) -> Tensor:
    """Probability that a pixel is occupied, ``[H, W]``, the top row first."""
    if not path.is_file():
        raise FileNotFoundError(f"image: no such file: {path}")
    try:
        image = imageio.imread(path)
    except (OSError, ValueError, SyntaxError) as error:
        raise ValueError(f"image: {path} cannot be read ({error})") from error
    shade = torch.from_numpy(image / (255 if image.dtype == "uint8" else 65535))
    shade = shade.mean(-1) if shade.ndim == 3 else shade
    return shade if negate else 1 - shade
