"""Jerk over time, one panel a method, in the manner of the paper's Fig. 7."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from redig.viz.panels import LEGEND, TWO_COLUMNS, panel_grid
from redig.viz.scene import INK, robot_style, save_figure

LEAST_WIDTH = 2.0  # of a panel (inches)
MARKERS = "os^Dv<>"
BAND = "#C8C8C8"  # the mean, under the lines of the robots


def plot_jerk(path: str | os.PathLike, jerk: Mapping[str, Tensor], dt: float = 0.1, width: float = TWO_COLUMNS) -> None:
    """Draw the jerk of every robot of one team, and their mean at each time, on the same scale for all methods.

    The dashed line, with its value, is the mean over robots and time.

    Args:
        path: of the figure, PNG, PDF or SVG by its suffix; an existing file is replaced at once.
        jerk: of each method's team, ``[T, n]`` (m/s³) with a T of its own, see :func:`redig.evaluation.metrics.jerk`;
            NaN where a robot has arrived and the environment holds it.
        dt: time between samples (s). The first value is drawn at 1.5 dt, in the middle of the four samples that a third
            difference takes.
        width: of the figure (inches).

    Raises:
        ValueError: if there is no method, one has no values, or the suffix is not one of those allowed.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_jerk(f"{folder}/jerk.svg", {"steady": torch.ones(40, 5), "nervous": 9 * torch.rand(60, 5)})
        ...     os.listdir(folder)
        ['jerk.svg']
    """
    values = {name: profile.numpy(force=True) for name, profile in jerk.items()}
    for name, profile in values.items():
        if profile.ndim != 2 or np.isnan(profile).all():
            raise ValueError(f"jerk: got shape {list(profile.shape)} of {name!r}, expected [T, n] with values")
    figure, panels = panel_grid(len(values), width, LEAST_WIDTH, ratio=0.6)
    for axes, (name, profile) in zip(panels, values.items(), strict=True):
        time = dt * (np.arange(len(profile)) + 1.5)
        for i, robot in enumerate(profile.T):
            colour, line = robot_style(i)
            marks: dict[str, Any] = {"marker": MARKERS[i % len(MARKERS)], "markersize": 2.8, "markevery": (2 * i, 10)}
            axes.plot(time, robot, color=colour, linestyle=line, linewidth=0.8, label=f"robot {i}", **marks)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # at times, all robots have arrived
            mean = np.nanmean(profile, 1)
        axes.plot(time, mean, color=BAND, linewidth=3.5, zorder=1.9, label="their mean")
        overall = float(np.nanmean(profile))
        axes.axhline(overall, color=INK, linestyle=(0, (4, 3)), linewidth=0.9, label="mean over time")
        axes.set_title(f"{name}: mean {overall:.2f} m/s³", size=9, loc="left")
        axes.set_xlabel("time (s)", size=8)
        axes.set_ylabel("jerk (m/s³)", size=8)
        axes.label_outer()
        axes.grid(color="#DDDDDD", linewidth=0.6)
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylim(bottom=0)
    panels[0].yaxis.set_major_locator(MaxNLocator(6, integer=True))
    handles, labels = panels[0].get_legend_handles_labels()
    columns = 4 if width < 5 else len(handles)
    figure.legend(handles, labels, ncols=columns, handlelength=1.8, **LEGEND)
    save_figure(figure, path)
