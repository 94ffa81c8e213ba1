"""Several methods on the same start, side by side, in the manner of the paper's Figs. 2 and 4."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from torch import Tensor

from redig.envs.maps import ObstacleMap
from redig.envs.occupancy import OccupancyMap
from redig.viz.panels import LEGEND, TWO_COLUMNS, panel_grid
from redig.viz.scene import INK, SHAPE, check_trajectory, draw_map, formation_outline, save_figure, view
from redig.viz.team import draw_formation, draw_paths, number_robots

INSTANTS = 5
LEAST_WIDTH = 3.0  # of a panel (inches)
COLLISION: dict[str, Any] = {"marker": "X", "s": 36, "color": INK, "edgecolors": "white", "linewidths": 0.7}
PLATE: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}


def plot_comparison(
    path: str | os.PathLike,
    position: Mapping[str, Tensor],
    collision: Mapping[str, Tensor],
    formation: str,
    obstacle_map: ObstacleMap | OccupancyMap,
    goal: Tensor | None = None,
    radius: float = 0.1,
    dt: float = 0.1,
    width: float = TWO_COLUMNS,
) -> None:
    """Draw one crossing by each method: a panel each, in the same scale, with the formation at the same times.

    The times are equally far apart up to the end of the quickest team, and every team is shown at its own end too.
    Crosses mark where a robot begins to touch a wall or a teammate.

    Args:
        path: of the figure, PNG, PDF or SVG by its suffix; an existing file is replaced at once.
        position: of each method's team, ``[T, n, 2]`` (m) with a T of its own.
        collision: whether a robot touches something, ``[T, n]`` bool, of the same methods.
        formation: name, see :func:`redig.envs.formations.formation_offsets`.
        obstacle_map: the map.
        goal: ``[n, 2]`` (m), drawn as crosses of thin lines.
        radius: of a robot (m).
        dt: time between samples (s).
        width: of the figure (inches).

    Raises:
        ValueError: if there is no method, methods or shapes do not fit each other, or the suffix or the name is not one
            of those allowed.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from redig.envs import corridor, formation_offsets
        >>> position = formation_offsets("wedge", 5) + torch.tensor([[-2.0, 0.0], [-1.0, 0.0]])[:, None]  # two samples
        >>> methods = {"straight on": position}, {"straight on": torch.zeros(2, 5, dtype=torch.bool)}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_comparison(f"{folder}/crossing.svg", *methods, "wedge", corridor())
        ...     os.listdir(folder)
        ['crossing.svg']
    """
    if position.keys() != collision.keys() or not position:
        raise ValueError(f"position, collision: got methods {list(position)} and {list(collision)}, expected the same")
    tracks = {name: check_trajectory(places, goal)[0] for name, places in position.items()}
    goals = None if goal is None else goal.numpy(force=True)
    touching = {name: np.asarray(touch.numpy(force=True), dtype=bool) for name, touch in collision.items()}
    for name, track in tracks.items():
        if touching[name].shape != track.shape[:-1]:
            seen = f"{list(touching[name].shape)} of {name!r}"
            raise ValueError(f"collision: got shape {seen}, expected {list(track.shape[:-1])}")
    n = next(iter(tracks.values())).shape[1]
    for name, track in tracks.items():
        if track.shape[1] != n:
            raise ValueError(
                f"position: got {track.shape[1]} robots of {name!r}, expected the same number of robots, {n}"
            )
    outline = formation_outline(formation, n)
    region = view(np.concatenate([track.reshape(-1, 1, 2) for track in tracks.values()]), goals)
    ratio = (region[3] - region[2]) / (region[1] - region[0])
    instants = _instants([len(track) for track in tracks.values()], dt)
    figure, panels = panel_grid(len(tracks), width, LEAST_WIDTH, ratio)
    for axes, (name, track) in zip(panels, tracks.items(), strict=True):
        draw_map(axes, obstacle_map, region)
        axes.set_title(name, size=9, loc="left")
        axes.xaxis.label.set_fontsize(8)
        axes.yaxis.label.set_fontsize(8)
        axes.label_outer()
        draw_paths(axes, track, linewidth=1.1)
        for k in sorted({*instants, len(track) - 1}):
            draw_formation(axes, track[k], outline, radius, filled=k == 0)
            number_robots(axes, track[k], size=5, colour="white" if k == 0 else INK)
            _write_time(axes, track[k], k * dt, radius)
        x, y = _contacts(track, touching[name]).T
        axes.scatter(x, y, zorder=7, **COLLISION)
        if goals is not None:
            axes.scatter(goals[:, 0], goals[:, 1], marker="+", s=24, color=INK, linewidths=0.8, zorder=5)
    handles = [Line2D([], [], color=SHAPE, linewidth=0.9, label=f"formation ({formation})")]
    if goals is not None:
        handles.append(Line2D([], [], color=INK, marker="+", linestyle="", label="goal"))
    cross: dict[str, Any] = {"marker": "X", "color": INK, "linestyle": "", "markeredgecolor": "white", "markersize": 7}
    handles.append(Line2D([], [], **cross, label="collision begins"))
    figure.legend(handles=handles, ncols=len(handles), handlelength=1.5, **LEGEND)
    save_figure(figure, path)


def _instants(samples: Sequence[int], dt: float) -> list[int]:
    """Samples that all teams have, half seconds where there are enough, the start first."""
    last = min(samples) - 1
    step = max(round(0.5 / dt), 1)
    step = step if last >= step * (INSTANTS - 1) else 1
    return sorted({step * round(k / step) for k in np.linspace(0, last, INSTANTS)[:-1]})


def _contacts(track: NDArray, touching: NDArray) -> NDArray:
    """Where contacts begin, ``[C, 2]`` (m)."""
    before = np.concatenate([np.zeros_like(touching[:1]), touching[:-1]])
    return track[touching & ~before]


def _write_time(axes: Axes, place: NDArray, time: float, radius: float) -> None:
    """Write the time (s) above a formation."""
    x, y = place[:, 0].mean(), place[:, 1].max() + 1.5 * radius
    text = f"{time:.1f} s".replace(".0 s", " s")
    axes.text(x, y, text, size=7, color=INK, ha="center", va="bottom", zorder=8, bbox=PLATE)
