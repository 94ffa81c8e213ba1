"""Maps with random sizes, in two splits that share none: one to train on, one to evaluate on."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

from redig.envs.map_batch import MapBatch
from redig.envs.map_kinds import bollards, curve, doorway, forest, narrowing, passages, with_route
from redig.envs.maps import ObstacleMap, corridor
from redig.envs.occupancy import OccupancyMap, load_occupancy_map

EVALUATION_MAPS = 32  # of each kind
SPLITS = ("train", "evaluation")
Range = tuple[float, float]  # least and greatest value; whole numbers are drawn as such

# A team about 2 m broad cannot cross any of these without changing its formation, and five robots of radius 0.1 m can.
RANGES: dict[str, dict[str, Range]] = {
    "corridor": {"width": (0.8, 1.4), "length": (1.0, 3.0)},
    "narrowing": {"gap": (0.7, 1.2), "entrance": (1.8, 2.6), "length": (2.0, 4.0)},
    "passages": {
        "gap": (0.8, 1.4), "count": (2, 3), "length": (0.3, 0.8), "spacing": (1.6, 2.4), "shift": (0.0, 0.4),
    },
    "curve": {"gap": (0.9, 1.4), "radius": (2.5, 4.0), "turn": (0.8, 1.6)},
    "bollards": {"gap": (0.8, 1.4), "radius": (0.2, 0.5)},
    "forest": {"gap": (0.6, 0.9), "count": (6, 12), "length": (2.5, 4.0), "seed": (0, 2**31 - 1)},
    "doorway": {"gap": (0.8, 1.3), "thickness": (0.1, 0.4), "hallway": (4.2, 5.0), "offset": (-0.4, 0.4)},
}  # fmt: skip
MAP_KINDS = tuple(RANGES)
_MAKE: dict[str, Callable[..., ObstacleMap]] = {
    "corridor": corridor, "narrowing": narrowing, "passages": passages, "curve": curve, "bollards": bollards,
    "forest": forest, "doorway": doorway,
}  # fmt: skip


def random_map(kind: str, seed: int, split: str = "train") -> ObstacleMap:
    """A map of a kind with sizes drawn uniformly from ``RANGES``; a curve turns left or right.

    The draw has a generator of its own, seeded with kind, split and seed together, so that no training map is ever an
    evaluation map, whatever the seeds, and nothing else is disturbed. There are ``EVALUATION_MAPS`` = 32 evaluation
    maps of each kind and any number of training maps.

    Args:
        kind: one of ``MAP_KINDS``: corridor, narrowing, passages, curve, bollards, forest, doorway.
        seed: number of the map within its split, from 0.
        split: ``train`` or ``evaluation``.

    Raises:
        ValueError: for an unknown kind or split, or a seed out of range.

    Examples:
        >>> random_map("doorway", seed=0).gap == random_map("doorway", seed=0).gap
        True
        >>> random_map("doorway", seed=0).gap == random_map("doorway", seed=0, split="evaluation").gap
        False
    """
    for name, value, allowed in (("kind", kind, MAP_KINDS), ("split", split, SPLITS)):
        if value not in allowed:
            raise ValueError(f"{name}: got {value!r}, allowed are {', '.join(allowed)}")
    if seed < 0 or (split == "evaluation" and seed >= EVALUATION_MAPS):
        raise ValueError(f"seed: got {seed}, must be 0 or more, and less than {EVALUATION_MAPS} in evaluation")
    generator = random.Random(f"{kind} {split} {seed}")  # Python hashes a string with SHA-512
    sizes: dict[str, Any] = {
        name: generator.randint(int(low), int(high)) if isinstance(low, int) else generator.uniform(low, high)
        for name, (low, high) in RANGES[kind].items()
    }
    if kind == "curve":
        sizes["turn"] *= generator.choice((1, -1))
    drawn = _MAKE[kind](**sizes)
    if kind == "corridor":  # the only one without a route: give it the room of the others, whatever its length
        reach = sizes["length"] / 2 + 1.75
        drawn = with_route(drawn.obstacles.tolist(), drawn.gap, [(-reach, 0.0), (reach, 0.0)])
    return drawn


def named_map(name: str, num_envs: int) -> ObstacleMap | MapBatch | OccupancyMap:
    """The map or maps that a name stands for, so that a scenario can be written down as JSON.

    Args:
        name: ``KIND:SPLIT``, such as ``forest:train``, or the path of a YAML file, see
            :func:`~redig.envs.occupancy.load_occupancy_map`. Of a split, environment i gets map i; in evaluation map i
            modulo 32.
        num_envs: number of environments.

    Raises:
        ValueError: for any other name.
        FileNotFoundError: if there is no such file.

    Examples:
        >>> len(named_map("forest:train", num_envs=3).maps)
        3
    """
    kind, _, split = name.partition(":")
    if kind in MAP_KINDS and split in SPLITS:
        last = EVALUATION_MAPS if split == "evaluation" else num_envs
        maps = tuple(random_map(kind, i % last, split) for i in range(num_envs))
        return maps[0] if num_envs == 1 else MapBatch(maps)
    if Path(name).suffix.lower() in (".yaml", ".yml"):
        return load_occupancy_map(name)
    raise ValueError(
        f"obstacle_map: got {name!r}, must be KIND:SPLIT with a kind of {', '.join(MAP_KINDS)} and a split of "
        f"{', '.join(SPLITS)}, or the path of a map's .yaml file"
    )
