"""Whose messages count: arrows between robots and tables of numbers, the counterpart of the paper's Fig. 6."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from numpy.typing import NDArray
from torch import Tensor

from redig.envs.maps import ObstacleMap
from redig.envs.occupancy import OccupancyMap
from redig.viz.panels import TWO_COLUMNS
from redig.viz.scene import INK, draw_map, robot_style, save_figure
from redig.viz.team import number_robots

# from pale to dark, so that the order of the values survives without colours
SHADES = LinearSegmentedColormap.from_list("importance", mpl.colormaps["Blues"](np.linspace(0.12, 1.0, 256)))
WIDEST = 4.5  # arrow (points)


def plot_importance(
    path: str | os.PathLike,
    importance: Mapping[str, Tensor],
    position: Tensor,
    moments: Sequence[str],
    obstacle_map: ObstacleMap | OccupancyMap,
    radius: float = 0.1,
) -> None:
    """Draw who moves whom: for each policy a row of graphs and a row of tables, a column a moment, on one scale.

    An arrow goes from the robot that speaks to the one that hears; the wider and darker, the more its command depends
    on what was said. The tables hold the same numbers. The figure is two columns of a page wide.

    Args:
        path: of the figure, PNG, PDF or SVG by its suffix; an existing file is replaced at once.
        importance: of each policy, ``[M, n, n]`` (1/s), row hears column, see
            :func:`redig.evaluation.message_importance.message_importance`; the diagonal is not drawn.
        position: of the robots at the M moments, ``[M, n, 2]`` (m).
        moments: what to call the moments.
        obstacle_map: the map.
        radius: of a robot (m).

    Raises:
        ValueError: if there is no policy, shapes do not fit each other, or the suffix is not one of those allowed.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from redig.envs import corridor, formation_offsets
        >>> place, before = formation_offsets("wedge", 5)[None], torch.rand(1, 5, 5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     graphs = {"before": before, "after": 2 * before}
        ...     plot_importance(f"{folder}/graph.svg", graphs, place, ["in the corridor"], corridor())
        ...     os.listdir(folder)
        ['graph.svg']
    """
    if position.ndim != 3 or position.shape[0] != len(moments) or position.shape[-1] != 2:
        raise ValueError(f"position: got shape {list(position.shape)}, expected [{len(moments)}, n, 2]")
    if not importance:
        raise ValueError("importance: got no policy, expected one or more")
    expected = [len(moments), position.shape[1], position.shape[1]]
    for name, given in importance.items():
        if list(given.shape) != expected:
            raise ValueError(f"importance: got shape {list(given.shape)} of {name!r}, expected {expected}")
    place = position.numpy(force=True)
    values = {name: _others_only(value.numpy(force=True)) for name, value in importance.items()}
    scale = Normalize(0, max(float(np.nanmax(value)) for value in values.values()) or 1.0)
    half = (place.max(1) - place.min(1)).max() / 2 + 4 * radius
    panel = (TWO_COLUMNS - 1.3) / len(moments)
    height = len(values) * (panel * 1.62 + 0.25) + 0.6
    figure = Figure(figsize=(TWO_COLUMNS, height), layout="constrained")
    ratios = [1.0, 0.62] * len(values)
    grid = figure.subplots(2 * len(values), len(moments), height_ratios=ratios, squeeze=False)
    for row, (name, value) in enumerate(values.items()):
        for k, moment in enumerate(moments):
            graph, table = grid[2 * row, k], grid[2 * row + 1, k]
            centre = (place[k].min(0) + place[k].max(0)) / 2
            region = (centre[0] - half, centre[0] + half, centre[1] - half, centre[1] + half)
            draw_map(graph, obstacle_map, region)
            graph.set(xticks=[], yticks=[], xlabel="", ylabel="")
            _draw_graph(graph, value[k], place[k], radius, scale)
            _draw_table(table, value[k], scale)
            if row == 0:
                graph.set_title(moment, size=8)
        grid[2 * row, 0].set_ylabel(name, size=9, weight="bold")
        grid[2 * row + 1, 0].set_ylabel("robot that hears", size=8)
    for table in grid[-1]:
        table.set_xlabel("robot that speaks", size=8)
    bar = figure.colorbar(mpl.cm.ScalarMappable(scale, SHADES), ax=grid, aspect=40, pad=0.01)
    bar.set_label("importance of a message: change of the command by a metre (m/s for each m)", size=8)
    bar.ax.tick_params(labelsize=7)
    save_figure(figure, path)


def _others_only(value: NDArray) -> NDArray:
    """The same without the diagonal."""
    return np.where(np.eye(value.shape[-1], dtype=bool), np.nan, value)


def _draw_graph(axes: Axes, value: NDArray, place: NDArray, radius: float, scale: Normalize) -> None:
    """Arrows from speakers to hearers, the faintest first, and the robots on top, larger than they are."""
    n = len(place)
    pairs = sorted(((i, j) for i in range(n) for j in range(n) if i != j), key=lambda pair: value[pair])
    for order, (hears, speaks) in enumerate(pairs):
        share = float(scale(value[hears, speaks]))
        if share > 0:
            arrow = FancyArrowPatch(
                place[speaks],
                place[hears],
                arrowstyle="-|>",
                connectionstyle="arc3,rad=0.18",
                color=SHADES(share),
                linewidth=0.3 + WIDEST * share,
                mutation_scale=4 + 8 * share,
                shrinkA=6,
                shrinkB=6,
                zorder=3 + order / n**2,
            )
            axes.add_patch(arrow)
    for i, at in enumerate(place):
        axes.scatter(at[0], at[1], s=90, color=robot_style(i)[0], edgecolors="white", linewidths=0.8, zorder=5)
    number_robots(axes, place)


def _draw_table(axes: Axes, value: NDArray, scale: Normalize) -> None:
    """The numbers, on the shades of the arrows."""
    n = len(value)
    axes.imshow(value, cmap=SHADES, norm=scale, aspect="auto")
    axes.set_xticks(range(n))
    axes.set_yticks(range(n))
    axes.tick_params(length=0, labelsize=7)
    axes.spines[:].set_visible(False)
    for i in range(n):
        for j in range(n):
            if i != j:
                ink = "white" if scale(value[i, j]) > 0.55 else INK
                axes.text(j, i, f"{value[i, j]:.2f}", size=6.5, color=ink, ha="center", va="center")
