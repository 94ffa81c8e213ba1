"""A team's motion as one figure, in the manner of the paper's Fig. 2: the map, the paths, and the shape on the way."""

from __future__ import annotations

import os

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from torch import Tensor

from redig.envs.maps import ObstacleMap
from redig.envs.occupancy import OccupancyMap
from redig.viz.scene import (
    IMAGE_SUFFIXES,
    INK,
    PALETTE,
    SHAPE,
    check_suffix,
    check_trajectory,
    draw_map,
    formation_outline,
    save_figure,
    view,
)
from redig.viz.team import draw_formation, draw_paths, number_robots

INSTANTS = 6


def plot_trajectories(
    path: str | os.PathLike,
    position: Tensor,
    formation: str,
    obstacle_map: ObstacleMap | OccupancyMap,
    goal: Tensor | None = None,
    radius: float = 0.1,
) -> None:
    """Draw the paths of one team, and its formation at six instants that are equally far apart along the way.

    Robots are drawn in their true size and numbered at the start; each has a colour of its own.

    Args:
        path: of the figure, PNG, PDF or SVG by its suffix; an existing file is replaced at once.
        position: ``[T, n, 2]`` (m).
        formation: name, see :func:`redig.envs.formations.formation_offsets`.
        obstacle_map: the map.
        goal: ``[n, 2]`` (m), drawn as crosses.
        radius: of a robot (m).

    Raises:
        ValueError: if the suffix, a shape or the name is not one of those allowed.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from redig.envs import corridor, formation_offsets
        >>> position = formation_offsets("wedge", 5) + torch.tensor([[-2.0, 0.0], [-1.0, 0.0]])[:, None]  # two samples
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_trajectories(f"{folder}/crossing.svg", position, "wedge", corridor())
        ...     os.listdir(folder)
        ['crossing.svg']
    """
    path = check_suffix(path, IMAGE_SUFFIXES)
    track, goals = check_trajectory(position, goal)
    outline = formation_outline(formation, track.shape[1])
    region = view(track, goals)
    width = 7.0
    height = (width - 0.7) * (region[3] - region[2]) / (region[1] - region[0]) + 0.75
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    draw_map(axes, obstacle_map, region)
    draw_paths(axes, track)
    for k in _instants(track):
        draw_formation(axes, track[k], outline, radius, filled=k == 0)
    number_robots(axes, track[0])
    handles = [
        Line2D([], [], color=PALETTE[0], linewidth=1.4, label="path of a robot"),
        Line2D([], [], color=SHAPE, linewidth=0.9, label=f"formation ({formation})"),
    ]
    if goals is not None:
        axes.scatter(goals[:, 0], goals[:, 1], marker="x", s=24, color=INK, linewidths=1.2, zorder=5)
        handles.append(Line2D([], [], color=INK, marker="x", linestyle="", label="goal"))
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=8, frameon=False)
    save_figure(figure, path)


def _instants(track: NDArray) -> NDArray:
    """Indices of samples at equal distances along the way of the team's centroid, first and last included."""
    way = np.linalg.norm(np.diff(track.mean(1), axis=0), axis=-1).cumsum()
    if len(way) == 0 or way[-1] == 0:
        return np.array([0])
    way = np.concatenate([[0.0], way])
    return np.unique(np.searchsorted(way, np.linspace(0, way[-1], INSTANTS)))
