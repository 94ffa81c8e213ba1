"""A team's motion as GIF or MP4."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray
from torch import Tensor

from redig.envs.maps import ObstacleMap
from redig.files import replacing
from redig.viz.scene import (
    INK,
    SHAPE,
    VIDEO_SUFFIXES,
    check_suffix,
    check_trajectory,
    draw_map,
    formation_outline,
    robot_style,
    view,
)

DPI = 128
BLOCK = 16  # video codecs want both sides of a frame to be multiples of it


def animate(
    path: str | os.PathLike,
    position: Tensor,
    formation: str,
    obstacle_map: ObstacleMap,
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
    """
    path = check_suffix(path, VIDEO_SUFFIXES)
    if fps < 1:
        raise ValueError(f"fps: got {fps}, must be at least 1")
    track, goals = check_trajectory(position, goal)
    frames = _frames(track, formation, obstacle_map, goals, radius, dt)
    with replacing(path) as unfinished, _writer(unfinished, fps) as writer:
        for frame in frames:
            writer.append_data(frame)


def _writer(path: Path, fps: int) -> Any:
    if path.suffix.lower() == ".gif":
        return imageio.get_writer(path, mode="I", duration=1000 / fps, loop=0, subrectangles=True)
    return imageio.get_writer(path, mode="I", fps=fps, codec="libx264", macro_block_size=BLOCK)


def _frames(
    track: NDArray, formation: str, obstacle_map: ObstacleMap, goals: NDArray | None, radius: float, dt: float
) -> Iterator[NDArray]:
    """Frames ``[H, W, 3]``, one a sample: what stands still is drawn once, and only the team is drawn anew in each."""
    n = track.shape[1]
    outline = formation_outline(formation, n)
    region = view(track, goals)
    width = 832
    height = BLOCK * round(width * (region[3] - region[2]) / (region[1] - region[0]) / BLOCK) + 3 * BLOCK
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    draw_map(axes, obstacle_map, region)
    if goals is not None:
        axes.scatter(goals[:, 0], goals[:, 1], marker="x", s=20, color=INK, linewidths=1.0, zorder=2)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)

    (shape,) = axes.plot([], [], color=SHAPE, linewidth=1.0)
    styles = [robot_style(i) for i in range(n)]
    paths = [axes.plot([], [], color=colour, linestyle=line, linewidth=1.2)[0] for colour, line in styles]
    robots = [Circle(track[0, i], radius, color=styles[i][0]) for i in range(n)]
    clock = axes.text(0.01, 0.98, "", transform=axes.transAxes, size=8, color=INK, va="top")
    for robot in robots:
        axes.add_patch(robot)
    for k in range(len(track)):
        canvas.restore_region(background)
        shape.set_data(*track[k][outline].T)
        for i in range(n):
            paths[i].set_data(*track[: k + 1, i].T)
            robots[i].set_center(track[k, i])
        clock.set_text(f"t = {k * dt:.1f} s")
        for artist in (*paths, shape, *robots, clock):
            axes.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
