"""A map for each of the environments that are simulated in parallel."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from redig.envs.maps import ObstacleMap, box_distances, nearest_box
from redig.envs.occupancy import OccupancyMap
from redig.envs.routes import pad_routes

FAR = 1e6  # (m) where the boxes are that fill up a map with fewer than the others


@dataclass(frozen=True)
class MapBatch:
    """Maps of obstacles for B environments, with the interface of one :class:`~redig.envs.maps.ObstacleMap`.

    Args:
        maps: one for each environment. Either all have a route or none.

    Raises:
        ValueError: if there are none, or only some have a route.

    Examples:
        >>> from redig.envs.maps import corridor
        >>> batch = MapBatch((corridor(1.1), corridor(0.8)))
        >>> batch.signed_distance(torch.zeros(2, 5, 2))[:, 0]  # five robots in each corridor
        tensor([0.5500, 0.4000])
    """

    maps: tuple[ObstacleMap, ...]

    def __post_init__(self) -> None:
        if not self.maps:
            raise ValueError("maps: got none, expected one for each environment")
        if len({one.route is None for one in self.maps}) > 1:
            raise ValueError("maps: some have a route and some have none; give all of them one")

    @cached_property
    def obstacles(self) -> Tensor:
        """``[M, B, 1, 6]``, M that of the map with the most."""
        most = max(len(one.obstacles) for one in self.maps)
        filling = torch.tensor([FAR, FAR, 0.0, 0.0, 0.0, 0.0]).to(self.maps[0].obstacles)
        rows = [torch.cat([one.obstacles, filling.expand(most - len(one.obstacles), 6)]) for one in self.maps]
        return torch.stack(rows, 1).unsqueeze(2)

    @cached_property
    def gap(self) -> Tensor:
        """Narrowest passage of each map (m), ``[B, 1]``: against metrics ``[B, T]``."""
        return torch.tensor([[one.gap] for one in self.maps], device=self.maps[0].obstacles.device)

    @cached_property
    def route(self) -> Tensor | None:
        """Routes ``[B, W, 2]`` (m), or None if the maps have none."""
        routes = [one.route for one in self.maps if one.route is not None]
        return pad_routes(routes) if routes else None

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Region that holds those of all maps (m)."""
        x_min, y_min, x_max, y_max = zip(*(one.bounds for one in self.maps), strict=True)
        return min(x_min), min(y_min), max(x_max), max(y_max)

    def to(self, device: torch.device | str) -> MapBatch:
        """The same maps on another device."""
        return MapBatch(tuple(one.to(device) for one in self.maps))

    def nearest(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance ``[*L, B, n]`` (m) of ``point`` ``[*L, B, n, 2]``, and unit vector to the obstacle."""
        return nearest_box(self.obstacles, point)

    def signed_distance(self, point: Tensor) -> Tensor:
        """Signed distance ``[*L, B, n]`` (m) of ``point`` ``[*L, B, n, 2]`` to the nearest obstacle."""
        return box_distances(self.obstacles, point)[2].amin(0)


AnyMap = ObstacleMap | OccupancyMap | MapBatch


def map_at(obstacle_map: AnyMap, env_index: int) -> ObstacleMap | OccupancyMap:
    """The map of one environment.

    Examples:
        >>> from redig.envs.maps import corridor
        >>> map_at(MapBatch((corridor(1.1), corridor(0.8))), 1).gap, map_at(corridor(0.9), 1).gap
        (0.8, 0.9)
    """
    return obstacle_map.maps[env_index] if isinstance(obstacle_map, MapBatch) else obstacle_map


def check_map(obstacle_map: AnyMap, num_envs: int, radius: float) -> None:
    """Raise unless there is a map for every environment, and a way for a robot of a radius (m).

    Raises:
        ValueError: if not.

    Examples:
        >>> from redig.envs.maps import corridor
        >>> check_map(corridor(0.2), num_envs=4, radius=0.1)
        Traceback (most recent call last):
        ...
        ValueError: obstacle_map: its gap of 0.2 m is too narrow for a robot of radius 0.1 m; it must be more than 0.2 m
    """
    maps = obstacle_map.maps if isinstance(obstacle_map, MapBatch) else (obstacle_map,)
    if isinstance(obstacle_map, MapBatch) and len(maps) != num_envs:
        raise ValueError(f"obstacle_map: got {len(maps)} maps, must be one for each of {num_envs} environments")
    narrowest = min(one.gap for one in maps)
    if not narrowest > 2 * radius:
        raise ValueError(
            f"obstacle_map: its gap of {narrowest} m is too narrow for a robot of radius {radius} m; it must be more "
            f"than {2 * radius} m"
        )
