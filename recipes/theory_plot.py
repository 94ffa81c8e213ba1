"""The figure of recipes/theory.py."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from redig.viz.scene import INK, PALETTE

Row = Mapping[str, float | str]
MARKERS = "os^Dv<"
HEALTHY = "as it should be"
TERMS = {  # column of terms.csv: label and unit
    "prior_mismatch": "prior mismatch\n(nats)",
    "matching_error": "matching error,\nas printed",
    "matching_divergence": "matching divergence\n(nats)",
    "discretization_error": "discretization\n(energy distance)",
    "bellman_residual": "Bellman residual S\n(reward)",
    "coverage": "coverage\n(mean density ratio)",
    "algorithmic_error": "algorithmic error\n(reward)",
}


def draw(tables: Mapping[str, Sequence[Row]]) -> Figure:
    """Six panels of curves, and all terms of all runs against those of the run as it should be."""
    figure = Figure(figsize=(10.0, 9.6), layout="constrained")
    grid = figure.add_gridspec(3, 3, height_ratios=(1, 1, 1.15))
    panels = [figure.add_subplot(grid[i, j]) for i in range(2) for j in range(3)]
    steps, updates = tables["steps"], tables["updates"]

    title(panels[0], "a  prior mismatch (nats)", "K")
    lines(panels[0], tables["schedules"], "schedule", "K", "prior_mismatch")
    panels[0].set(xscale="log", yscale="log")

    title(panels[1], "b  mass on a mode of 0.8, exact score", "K")
    lines(panels[1], tables["schedules"], "schedule", "K", "mass_sampled")
    panels[1].axhline(0.8, color=INK, linestyle="--", linewidth=0.9)
    panels[1].set(xscale="log")

    title(panels[2], "c  matching divergence at step k (nats)", "k")
    lines(panels[2], pick(steps, HEALTHY, "cloning cut short"), "run", "k", "matching_divergence", marked=False)
    panels[2].set(yscale="log")

    title(panels[3], "d  discretization (energy distance)", "steps of the chain, of 100")
    lines(panels[3], tables["samplers"], "sampler", "num_steps", "discretization_error")
    panels[3].set(xscale="log")

    title(panels[4], "e  Bellman residual, mean (reward)", "updates")
    lines(panels[4], pick(updates, HEALTHY, "critics too fast"), "run", "update", "residual")

    title(panels[5], "f  coverage, mean density ratio", "updates")
    lines(panels[5], pick(updates, HEALTHY, "refinement too far"), "run", "update", "coverage")

    matrix(figure, figure.add_subplot(grid[2, :]), tables["terms"])
    return figure


def pick(rows: Sequence[Row], *runs: str) -> list[Row]:
    """The rows of some runs."""
    return [row for row in rows if row["run"] in runs]


def title(axes: Axes, text: str, horizontal: str) -> None:
    """Title, label of the horizontal axis and what all panels share."""
    axes.set_title(text, size=9, loc="left")
    axes.set_xlabel(horizontal, size=9)
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.tick_params(which="both", labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)


def lines(axes: Axes, rows: Sequence[Row], group: str, x: str, y: str, marked: bool = True) -> None:
    """A line for each group: the mean over seeds, with a band from the lowest to the highest."""
    for i, name in enumerate(dict.fromkeys(row[group] for row in rows)):
        own = [row for row in rows if row[group] == name]
        at = list(dict.fromkeys(float(row[x]) for row in own))
        values = [[float(row[y]) for row in own if float(row[x]) == place] for place in at]
        means = [statistics.fmean(found) for found in values]
        marker = MARKERS[i] if marked else None
        axes.fill_between(
            at, [min(v) for v in values], [max(v) for v in values], color=PALETTE[i], alpha=0.2, linewidth=0
        )
        axes.plot(
            at,
            means,
            color=PALETTE[i],
            linestyle=("-", "--", ":")[i % 3],
            linewidth=1.3,
            label=str(name),
            marker=marker,
            markersize=3.5,
        )
    axes.legend(fontsize=7, frameon=False)


def matrix(figure: Figure, axes: Axes, rows: Sequence[Row]) -> None:
    """Every term of every run: the mean over seeds as a number, its ratio to the healthy run as a colour."""
    runs = list(dict.fromkeys(str(row["run"]) for row in rows))
    means = np.array([[statistics.fmean(float(r[t]) for r in rows if r["run"] == run) for t in TERMS] for run in runs])
    ratio = means / means[runs.index(HEALTHY)]
    norm = LogNorm(1, 10, clip=True)
    image = axes.imshow(ratio, cmap="Blues", norm=norm, aspect="auto")
    for i in range(len(runs)):
        for j in range(len(TERMS)):
            value, dark = means[i, j], norm(ratio[i, j]) > 0.6
            text = f"{value:.0f}" if value >= 100 else f"{value:.2g}"
            axes.text(j, i, text, ha="center", va="center", size=8, color="white" if dark else INK)
    axes.set_xticks(range(len(TERMS)), list(TERMS.values()), size=8)
    axes.set_yticks(range(len(runs)), runs, size=8)
    axes.set_title("g  every term of every run", size=9, loc="left")
    axes.tick_params(length=0)
    bar = figure.colorbar(image, ax=axes, pad=0.01, ticks=[1, 2, 5, 10])
    bar.ax.set_yticklabels(["≤ 1", "2", "5", "≥ 10"], size=8)
    bar.set_label(f"ratio to “{HEALTHY}”", size=8)
