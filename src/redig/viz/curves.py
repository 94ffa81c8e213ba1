"""Learning curves: the metrics of the evaluations during training, over the updates."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from redig.viz.scene import IMAGE_SUFFIXES, INK, PALETTE, check_suffix, save_figure

DASHES = (0, (4, 3))
Row = Mapping[str, float | None]
PANELS = (
    ("success rate", {"success_rate": "robots", "team_success_rate": "teams"}, (-0.03, 1.03)),
    ("travel time (s)", {"travel_time": ""}, None),
    ("CFI at δ = 0.5 m", {"cfi_0.5": ""}, None),
    ("mean jerk (m/s³)", {"jerk_mean": ""}, None),
)


def plot_learning_curves(path: str | os.PathLike, *runs: Sequence[Row]) -> None:
    """Draw success, travel time, CFI and jerk over the updates; dashed lines mark the cloned policy.

    Several runs are drawn as thin lines with their mean on top; they must have been evaluated after the same updates.

    Args:
        path: of the figure, PNG, PDF or SVG by its suffix; an existing file is replaced at once.
        runs: the evaluations of each run, in order, with the keys of :func:`redig.evaluation.evaluate` and
            ``updates``. The first row is the cloned policy. Missing values (``None`` or NaN) leave gaps.

    Raises:
        ValueError: if a run has no rows, runs differ in their updates, or the suffix is not one of those allowed.
        KeyError: if a row lacks a key.

    Examples:
        >>> import tempfile
        >>> row = {"success_rate": 0.5, "team_success_rate": 0.25, "travel_time": 9.0, "cfi_0.5": 0.7, "jerk_mean": 1.0}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_learning_curves(f"{folder}/curve.svg", [{"updates": 0, **row}, {"updates": 100, **row}])
        ...     os.listdir(folder)
        ['curve.svg']
    """
    path = check_suffix(path, IMAGE_SUFFIXES)
    if not runs or not all(runs):
        raise ValueError("runs: got none, or one without rows; expected at least one evaluation of each")
    if any(_column(rows, "updates") != _column(runs[0], "updates") for rows in runs):
        raise ValueError("runs: they were evaluated after different numbers of updates")
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    for axes, (title, series, limits) in zip(figure.subplots(2, 2, sharex=True).flat, PANELS, strict=True):
        _panel(axes, runs, series)
        axes.set_title(title, size=9, loc="left")
        if limits is not None:
            axes.set_ylim(limits)
        if axes.get_subplotspec().is_last_row():
            axes.set_xlabel("updates", size=9)
    cloned = Line2D([], [], color=INK, linestyle=DASHES, linewidth=0.9, label="before online training")
    figure.legend(handles=[cloned], loc="outside upper right", fontsize=8, frameon=False)
    save_figure(figure, path)


def _panel(axes: Axes, runs: Sequence[Sequence[Row]], series: Mapping[str, str]) -> None:
    """One panel: a line and its dashed reference for every key in ``series``, which maps keys to labels."""
    updates = _column(runs[0], "updates")
    for (key, label), colour, marker in zip(series.items(), PALETTE, "os", strict=False):
        columns = [_column(rows, key) for rows in runs]
        values = [sum(at) / len(at) for at in zip(*columns, strict=True)]
        if len(columns) > 1:
            for column in columns:
                axes.plot(updates, column, color=colour, linewidth=0.7, alpha=0.5)
        axes.plot(updates, values, color=colour, marker=marker, markersize=3, linewidth=1.3, label=label)
        axes.axhline(values[0], color=colour, linestyle=DASHES, linewidth=0.9)
    if len(series) > 1:
        axes.legend(fontsize=8, frameon=False)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)


def _column(rows: Sequence[Row], key: str) -> list[float]:
    """Values of one key, NaN where one is missing."""
    values = (row[key] for row in rows)
    return [float("nan") if value is None else value for value in values]
