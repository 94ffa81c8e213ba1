"""A team's motion as GIF or MP4."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
from torch import Tensor

from redig.envs.maps import ObstacleMap
from redig.envs.occupancy import OccupancyMap
from redig.files import replacing
from redig.viz.canvas import BLOCK, TeamCanvas
from redig.viz.scene import VIDEO_SUFFIXES, check_suffix, check_trajectory, view


def animate(
    path: str | os.PathLike,
    position: Tensor,
    formation: str,
    obstacle_map: ObstacleMap | OccupancyMap,
    goal: Tensor | None = None,
    radius: float = 0.1,
    dt: float = 0.1,
    fps: int = 10,
) -> None:
    """Animate one team, one frame a sample: robots in their true size, the paths so far, and the formation's outline.

    Args:
        path: of the film, GIF or MP4 by its suffix; an existing file is replaced at once.
        position: ``[T, n, 2]`` (m).
        formation: name, see :func:`redig.envs.formations.formation_offsets`.
        obstacle_map: the map.
        goal: ``[n, 2]`` (m), drawn as crosses.
        radius: of a robot (m).
        dt: time between samples (s), for the clock in the picture.
        fps: frames a second; ``1 / dt`` shows real time.

    Raises:
        ValueError: if the suffix, a shape or the name is not one of those allowed, or ``fps`` is less than 1.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from redig.envs import corridor, formation_offsets
        >>> position = formation_offsets("wedge", 5) + torch.tensor([[-2.0, 0.0], [-1.9, 0.0]])[:, None]  # two samples
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     animate(f"{folder}/crossing.gif", position, "wedge", corridor())
        ...     len(imageio.mimread(f"{folder}/crossing.gif"))
        2
    """
    path = check_suffix(path, VIDEO_SUFFIXES)
    if fps < 1:
        raise ValueError(f"fps: got {fps}, must be at least 1")
    track, goals = check_trajectory(position, goal)
    canvas = TeamCanvas(view(track, goals), track.shape[1], formation, obstacle_map, goals, radius)
    with replacing(path) as unfinished, film_writer(unfinished, fps) as writer:
        for k in range(len(track)):
            writer.append_data(canvas.draw(track[: k + 1], k * dt))


def film_writer(path: Path, fps: int) -> Any:
    """A writer of frames ``[H, W, 3]`` (uint8) into a GIF or MP4; the sides of an MP4 must be multiples of 16.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "film.gif")
        ...     with film_writer(path, fps=10) as writer:
        ...         writer.append_data(np.zeros((16, 16, 3), dtype=np.uint8))
        ...     len(imageio.mimread(path))
        1
    """
    if path.suffix.lower() == ".gif":
        return imageio.get_writer(path, mode="I", duration=1000 / fps, loop=0, subrectangles=True)
    return imageio.get_writer(path, mode="I", fps=fps, codec="libx264", macro_block_size=BLOCK)
