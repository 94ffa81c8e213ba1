"""A team's motion as GIF or MP4."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
from numpy.typing import NDArray
from PIL import Image
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
    write_film(path, (canvas.draw(track[: k + 1], k * dt) for k in range(len(track))), fps)


def write_film(path: Path, frames: Iterable[NDArray], fps: int) -> None:
    """Write one frame ``[H, W, 3]`` (uint8) or more into a GIF or MP4, which replaces an existing file at once.

    The colours of a GIF are those of its first frame; the sides of an MP4 must be multiples of 16.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "film.gif")
        ...     write_film(path, [np.zeros((16, 16, 3), dtype=np.uint8)], fps=10)
        ...     len(imageio.mimread(path))
        1
    """
    with replacing(path) as unfinished:
        if path.suffix.lower() != ".gif":
            writer: Any = imageio.get_writer(unfinished, mode="I", fps=fps, codec="libx264", macro_block_size=BLOCK)
            with writer:
                for frame in frames:
                    writer.append_data(frame)
            return
        # one palette for all: to find each frame its own takes longer than to draw it
        pictures = (Image.fromarray(frame) for frame in frames)
        first = next(pictures).quantize(method=Image.Quantize.FASTOCTREE)  # which leaves white white
        others = (picture.quantize(palette=first, dither=Image.Dither.NONE) for picture in pictures)
        first.save(unfinished, format="GIF", save_all=True, append_images=others, duration=1000 / fps, loop=0)
