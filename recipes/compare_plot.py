"""Curves and table of the comparison: ``python recipes/compare_plot.py runs/compare --out docs/results/compare``."""

from __future__ import annotations

import csv
import json
import statistics
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from compare_methods import METHODS
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from redig.files import replacing, write_csv
from redig.viz.scene import PALETTE, check_suffix

MARKERS = "os^Dv<P"
Curve = list[dict[str, float]]
Curves = dict[str, dict[str, dict[int, Curve]]]  # of a task, a method and a seed


@dataclass
class Arguments:
    """Draw learning curves of several seeds, and tabulate what they reach."""

    runs: Annotated[Path, tyro.conf.Positional]
    """Folder with the files of recipes/compare.py."""
    out: Path = Path("runs/compare/summary")
    """Folder for curves.csv, curves.png and table.md."""
    suffix: str = ".png"
    """Format of the figure: .png, .pdf or .svg."""


def main(arguments: Arguments) -> str:
    """Write ``curves.csv``, ``table.md`` and the figure; returns the table."""
    figure_path = check_suffix(arguments.out / f"curves{arguments.suffix}", (".png", ".pdf", ".svg"))
    curves = read(arguments.runs)
    rows = [
        {"task": task, "method": method, "seed": seed, **row}
        for task, methods in curves.items()
        for method, seeds in methods.items()
        for seed, curve in seeds.items()
        for row in curve
    ]
    write_csv(arguments.out / "curves.csv", rows)
    with replacing(figure_path) as path:
        draw(curves).savefig(path, dpi=200)
    table = markdown(curves)
    with replacing(arguments.out / "table.md") as path:
        path.write_text(table)
    print(table)
    return table


def read(folder: Path) -> Curves:
    """The curves in a folder, in the order in which tasks and methods are named.

    Raises:
        FileNotFoundError: if there are none.
        ValueError: if the runs of a task do not have equal frames.
    """
    found: dict[str, dict[str, dict[int, Curve]]] = defaultdict(lambda: defaultdict(dict))
    for path in sorted(folder.glob("*-seed*.csv")):
        config = json.loads(path.with_suffix(".json").read_text())
        with open(path, newline="") as file:
            curve = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
        found[config["task"]][config["method"]][config["seed"]] = curve
    if not found:
        raise FileNotFoundError(f"runs: {folder} holds no TASK-METHOD-seedSEED.csv")
    for task, methods in found.items():
        frames = {tuple(column(curve, "frames")) for seeds in methods.values() for curve in seeds.values()}
        if len(frames) > 1:
            ends = sorted({f"{at[-1]:.0f} frames, every {at[1] - at[0]:.0f}" for at in frames})
            raise ValueError(f"runs: those on {task} differ in their frames or evaluations: {'; '.join(ends)}")
    return {t: {m: found[t][m] for m in METHODS[t] if m in found[t]} for t in METHODS if t in found}


def draw(curves: Curves) -> Figure:
    """One panel a task: the mean return over seeds, and a band from the lowest to the highest seed."""
    figure = Figure(figsize=(3.4 * len(curves), 3.0), layout="constrained")
    names = list(dict.fromkeys(method for methods in curves.values() for method in methods))
    axes_of = figure.subplots(1, len(curves), squeeze=False).flat
    for axes, (task, methods) in zip(axes_of, curves.items(), strict=True):
        for method, seeds in methods.items():
            panel_line(axes, list(seeds.values()), method, names.index(method))
        axes.set_title(task, size=9, loc="left")
        axes.set_xlabel("frames", size=9)
        axes.grid(color="#DDDDDD", linewidth=0.6)
        axes.tick_params(labelsize=8)
        axes.ticklabel_format(axis="x", style="sci", scilimits=(3, 3))
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=7, frameon=False, loc="lower right")
    next(iter(figure.axes)).set_ylabel("return of an agent", size=9)
    return figure


def panel_line(axes: Axes, seeds: list[Curve], method: str, index: int) -> None:
    """The curves of one method on one task."""
    frames = column(seeds[0], "frames")
    at = list(zip(*(column(curve, "return_mean") for curve in seeds), strict=True))
    colour, marker = PALETTE[index % len(PALETTE)], MARKERS[index % len(MARKERS)]
    axes.fill_between(frames, [min(v) for v in at], [max(v) for v in at], color=colour, alpha=0.15, linewidth=0)
    mean = [statistics.fmean(v) for v in at]
    style = ("-", "--")[index // len(PALETTE) % 2]  # where the colours repeat
    axes.plot(frames, mean, style, color=colour, marker=marker, markersize=3, linewidth=1.3, label=method)


def markdown(curves: Curves) -> str:
    """Final return, area under the curve and training time of each method, mean ± sd over seeds."""
    lines = ["| task | method | seeds | final return | area under the curve | seconds |", "|---|---|---|---|---|---|"]
    for task, methods in curves.items():
        for method, seeds in methods.items():
            cells = [
                spread([curve[-1]["return_mean"] for curve in seeds.values()]),
                spread([area(curve) for curve in seeds.values()]),
                spread([curve[-1]["seconds"] for curve in seeds.values()]),
            ]
            lines.append(f"| {task} | {method} | {len(seeds)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def area(curve: Curve) -> float:
    """Area under the return over frames (trapezoids), divided by the frames: the mean return during training.

    Examples:
        >>> area([{"frames": 0, "return_mean": 0}, {"frames": 1, "return_mean": 2}, {"frames": 3, "return_mean": 2}])
        1.6666666666666667
    """
    frames, returns = column(curve, "frames"), column(curve, "return_mean")
    trapezoids = [(frames[i + 1] - frames[i]) * (returns[i + 1] + returns[i]) / 2 for i in range(len(frames) - 1)]
    return sum(trapezoids) / (frames[-1] - frames[0])


def spread(values: list[float]) -> str:
    """Mean ± standard deviation."""
    return f"{statistics.fmean(values):.4g} ± {statistics.stdev(values) if len(values) > 1 else 0.0:.2g}"


def column(curve: Curve, name: str) -> list[float]:
    """One column of a curve."""
    return [row[name] for row in curve]


if __name__ == "__main__":
    main(tyro.cli(Arguments))
