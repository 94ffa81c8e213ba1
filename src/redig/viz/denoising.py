"""The denoising of every robot's velocity as a figure, the counterpart of the paper's Fig. 3."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from torch import Tensor

from redig.viz.panels import LEGEND, TWO_COLUMNS
from redig.viz.scene import INK, SHAPE, robot_style, save_figure

ROWS = 5


def plot_denoising(
    path: str | os.PathLike,
    steps: Sequence[int],
    velocity: Tensor,
    max_speed: float = 1.0,
) -> None:
    """Draw the velocities of all robots at five steps of the chain: a row a step, a column a robot.

    Dots are many chains for the same situation, arrows the first of them; the square holds the allowed commands. The
    figure is two columns of a page wide.

    Args:
        path: of the figure, PNG, PDF or SVG by its suffix; an existing file is replaced at once.
        steps: S steps of the chain, the noisiest first, see :func:`redig.evaluation.denoising.denoising_path`.
        velocity: ``[S, L, n, 2]`` (m/s) of L chains.
        max_speed: limit of each component of a command (m/s).

    Raises:
        ValueError: if the shapes do not fit each other, or the suffix is not one of those allowed.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_denoising(f"{folder}/chain.svg", [100, 50, 0], torch.randn(3, 16, 5, 2))
        ...     os.listdir(folder)
        ['chain.svg']
    """
    chain = check_chain(steps, velocity)
    shown = np.unique(np.linspace(0, len(steps) - 1, ROWS).round().astype(int))
    n = chain.shape[2]
    limit = max(float(np.quantile(np.abs(chain), 0.995)), 1.2 * max_speed)
    figure = Figure(figsize=(TWO_COLUMNS, (TWO_COLUMNS - 0.6) / n * len(shown) + 0.8), layout="constrained")
    grid = figure.subplots(len(shown), n, sharex=True, sharey=True, squeeze=False)
    for row, k in zip(grid, shown, strict=True):
        for i, axes in enumerate(row):
            colour, _ = robot_style(i)
            box = Rectangle((-max_speed, -max_speed), 2 * max_speed, 2 * max_speed, fill=False, edgecolor=SHAPE)
            box.set(linewidth=0.7, linestyle=(0, (3, 2)))
            axes.add_patch(box)
            axes.scatter(chain[k, :, i, 0], chain[k, :, i, 1], s=4, color=colour, alpha=0.45, linewidths=0, zorder=2)
            arrow: dict[str, Any] = {
                "arrowstyle": "-|>",
                "color": INK,
                "linewidth": 1.1,
                "mutation_scale": 7,
                "shrinkA": 0,
            }
            axes.annotate("", chain[k, 0, i], (0, 0), arrowprops={**arrow, "shrinkB": 0}, zorder=3)
            axes.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
            axes.tick_params(labelsize=7)
            axes.grid(color="#E6E6E6", linewidth=0.5)
        row[0].set_ylabel(f"k = {steps[k]}" + (" (action)" if steps[k] == 0 else ""), size=8)
    for i, axes in enumerate(grid[0]):
        axes.set_title(f"robot {i}", size=8)
    figure.supxlabel("forward velocity (m/s)", size=8)
    figure.supylabel("velocity to the left (m/s), at diffusion step k", size=8)
    handles = [
        Line2D([], [], color=SHAPE, marker="o", markersize=3, linestyle="", label=f"{chain.shape[1]} chains"),
        Line2D([], [], color=INK, marker=r"$\rightarrow$", markersize=9, linestyle="", label="one of them"),
        Line2D([], [], color=SHAPE, linestyle=(0, (3, 2)), linewidth=0.7, label="allowed commands"),
    ]
    figure.legend(handles=handles, ncols=3, **LEGEND)
    save_figure(figure, path)


def check_chain(steps: Sequence[int], velocity: Tensor) -> NDArray:
    """Velocities ``[S, L, n, 2]`` (m/s) as an array.

    Raises:
        ValueError: if they have another shape.

    Examples:
        >>> import torch
        >>> check_chain([100, 0], torch.zeros(2, 16, 5, 2)).shape
        (2, 16, 5, 2)
    """
    if velocity.ndim != 4 or velocity.shape[0] != len(steps) or velocity.shape[-1] != 2 or 0 in velocity.shape:
        raise ValueError(f"velocity: got shape {list(velocity.shape)}, expected [{len(steps)}, L, n, 2]")
    return velocity.numpy(force=True)
