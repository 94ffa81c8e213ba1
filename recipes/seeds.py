"""Summarise runs that differ in their seed: ``python recipes/seeds.py runs/wedge-seed{0,1,2} --out summary``."""

from __future__ import annotations

import csv
import json
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from redig.files import replacing, write_csv
from redig.viz import plot_learning_curves

SHOWN = (
    "success_rate", "team_success_rate", "travel_time", "cfi_0.5", "cfi_0.1", "cfi_0.03", "cfi_literal_0.5",
    "cfi_literal_0.1", "cfi_literal_0.03", "jerk_mean", "jerk_peak", "collision_rate",
)  # fmt: skip


@dataclass
class Arguments:
    """Tables and learning curves over several seeds of one recipe."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of finished runs."""
    out: Path = Path("summary")
    """Folder for the CSV files, the table and the figure."""


def main(arguments: Arguments) -> str:
    """Write ``seeds.csv``, ``curves.csv``, ``table.md`` and ``curves.png``; returns the table."""
    metrics, curves = [], []
    for run in arguments.runs:
        seed = json.loads((run / "config.json").read_text())["seed"]
        metrics.append({"seed": seed, **json.loads((run / "metrics.json").read_text())})
        with open(run / "evaluations.csv") as file:
            curves.append([{"seed": seed, **row} for row in csv.DictReader(file)])
    write_csv(arguments.out / "seeds.csv", metrics)
    write_csv(arguments.out / "curves.csv", [row for rows in curves for row in rows])
    plot_learning_curves(arguments.out / "curves.png", *[[numbers(row) for row in rows] for rows in curves])
    table = markdown(metrics)
    with replacing(arguments.out / "table.md") as path:
        path.write_text(table)
    print(table)
    return table


def markdown(metrics: list[dict]) -> str:
    """Mean and standard deviation over seeds, cloned and trained, as a Markdown table."""
    lines = [f"| mean ± sd over {len(metrics)} seeds | cloned | after online training |", "|---|---|---|"]
    for name in SHOWN:
        cells = [spread([row[prefix + name] for row in metrics]) for prefix in ("cloned_", "")]
        lines.append(f"| {name} | {cells[0]} | {cells[1]} |")
    return "\n".join(lines) + "\n"


def spread(values: list[float | None]) -> str:
    """Mean ± standard deviation of what was measured."""
    found = [value for value in values if value is not None]
    if not found:
        return "-"
    return f"{statistics.fmean(found):.3f} ± {statistics.stdev(found) if len(found) > 1 else 0.0:.3f}"


def numbers(row: dict[str, str]) -> dict[str, float]:
    """The columns of a CSV row that hold numbers."""
    return {key: float(value) for key, value in row.items() if key != "phase"}


if __name__ == "__main__":
    main(tyro.cli(Arguments))
