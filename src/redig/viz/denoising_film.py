"""The denoising of every robot's velocity on the map, as GIF or MP4."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from redig.envs.maps import ObstacleMap
from redig.envs.occupancy import OccupancyMap
from redig.viz.animation import write_film
from redig.viz.canvas import BLOCK, DPI
from redig.viz.denoising import check_chain
from redig.viz.scene import INK, VIDEO_SUFFIXES, check_suffix, check_trajectory, draw_map, robot_style, view
from redig.viz.team import number_robots

WIDTH = 480  # pixels
REACH = 0.4  # metres that an arrow is long for each m/s


def animate_denoising(
    path: str | os.PathLike,
    steps: Sequence[int],
    velocity: Tensor,
    position: Tensor,
    obstacle_map: ObstacleMap | OccupancyMap,
    radius: float = 0.1,
    fps: int = 10,
    hold: float = 2.0,
) -> None:
    """Animate how noise becomes every robot's command: a frame a step, arrows for one chain, dots for all chains.

    Args:
        path: of the film, GIF or MP4 by its suffix; an existing file is replaced at once.
        steps: S steps of the chain, the noisiest first, see :func:`redig.evaluation.denoising.denoising_path`.
        velocity: ``[S, L, n, 2]`` (m/s) of L chains; the arrows are the first.
        position: of the robots, ``[n, 2]`` (m).
        obstacle_map: the map.
        radius: of a robot (m).
        fps: frames a second.
        hold: for how long the actions are shown (s).

    Raises:
        ValueError: if the shapes do not fit each other, the suffix is not one of those allowed, or ``fps`` is less
            than 1.

    Examples:
        >>> import tempfile
        >>> import imageio.v2 as imageio
        >>> import torch
        >>> from redig.envs import corridor, formation_offsets
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     film, place = f"{folder}/chain.gif", formation_offsets("wedge", 5)
        ...     animate_denoising(film, [100, 50, 0], torch.randn(3, 16, 5, 2), place, corridor(), hold=0.1)
        ...     len(imageio.mimread(film))
        3
    """
    path = check_suffix(path, VIDEO_SUFFIXES)
    if fps < 1:
        raise ValueError(f"fps: got {fps}, must be at least 1")
    chain = check_chain(steps, velocity)
    place = check_trajectory(position.unsqueeze(0), None)[0]
    if place.shape[1] != chain.shape[2]:
        raise ValueError(f"position: got {place.shape[1]} robots, velocity has {chain.shape[2]}")
    region = view(place, None, margin=1.0)
    height = BLOCK * round(WIDTH * (region[3] - region[2]) / (region[1] - region[0]) / BLOCK)
    figure = Figure(figsize=(WIDTH / DPI, height / DPI), dpi=DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    draw_map(axes, obstacle_map, region)
    tips = place + REACH * chain  # [S, L, n, 2]
    dots, arrows = [], []
    for i, at in enumerate(place[0]):
        colour, _ = robot_style(i)
        dots.append(axes.scatter([], [], s=5, color=colour, alpha=0.5, linewidths=0, zorder=3))
        style: dict[str, Any] = {"arrowstyle": "-|>", "color": colour, "linewidth": 2, "mutation_scale": 11}
        arrows.append(axes.annotate("", at, at, arrowprops={**style, "shrinkA": 0, "shrinkB": 0}, zorder=5))
        axes.scatter(at[0], at[1], s=60, color=colour, zorder=5)
    number_robots(axes, place[0], size=6)
    canvas.draw()
    figure.set_layout_engine("none")  # it stays as it is
    clock = axes.text(0.01, 0.98, "", transform=axes.transAxes, size=8, color=INK, va="top")

    def frames() -> Iterator[NDArray]:
        for step, ends in zip(steps, tips, strict=True):
            for i, (cloud, arrow) in enumerate(zip(dots, arrows, strict=True)):
                cloud.set_offsets(ends[:, i])
                arrow.xy = ends[0, i]
            clock.set_text(f"diffusion step k = {step}")
            canvas.draw()
            frame = np.asarray(canvas.buffer_rgba())[..., :3].copy()
            yield from [frame] * (max(round(hold * fps), 1) if step == steps[-1] else 1)

    write_film(path, frames(), fps)
