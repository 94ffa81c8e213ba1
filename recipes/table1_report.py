"""Table 1 as Markdown and CSV: means with 95 % intervals over seeds and starts, beside the paper's own numbers."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from finish import TEST_SEED
from table1_methods import ABLATIONS, METHODS, Job

from redig.files import replacing, write_csv

COLUMNS = {  # metric: head of the column, factor, digits
    "success_rate": ("robots (%)", 100, 1),
    "team_success_rate": ("teams (%)", 100, 1),
    "travel_time": ("TT (s)", 1, 2),
    "cfi_0.5": ("CFI 0.5", 100, 1),
    "cfi_0.1": ("CFI 0.1", 100, 1),
    "cfi_0.03": ("CFI 0.03", 100, 1),
    "cfi_literal_0.5": ("literal 0.5", 100, 1),
    "cfi_literal_0.1": ("literal 0.1", 100, 1),
    "cfi_literal_0.03": ("literal 0.03", 100, 1),
    "jerk_mean": ("jerk (m/s³)", 1, 2),
}
ARRIVING = 0.95  # of the robots, for a travel time to count
PAPER = {  # SR (%), TT (s), CFI (%) at 0.5, 0.1 and 0.03: the paper's Table 1
    "leader_follower": {
        "circle": (60.00, 15.80, 75.11, 70.10, 66.04),
        "wedge": (60.00, 17.12, 81.44, 66.70, 62.86),
        "line": (60.00, 13.35, 63.76, 55.59, 55.59),
    },
    "dgnn": {
        "circle": (100.00, 34.70, 60.41, 58.91, 58.91),
        "wedge": (100.00, 63.70, 47.85, 42.33, 41.92),
        "line": (100.00, 36.80, 27.90, 20.16, 20.16),
    },
    "afor": {
        "circle": (100.00, 30.50, 92.89, 90.40, 88.66),
        "wedge": (100.00, 51.50, 91.39, 90.35, 87.96),
        "line": (100.00, 183.50, 88.60, 85.13, 72.90),
    },
    "redig": {
        "circle": (100.00, 13.10, 84.51, 81.52, 78.97),
        "wedge": (100.00, 12.46, 82.43, 81.21, 80.37),
        "line": (100.00, 10.03, 91.17, 87.68, 80.91),
    },
}


def write_report(out: Path, done: Sequence[Job], command: str) -> str:
    """Write ``seeds.csv``, one row a run, and ``table.md`` with the command that made it; returns the table."""
    starts = {job: read_starts(job.starts_file) for job in done}
    rows: list[dict[str, str | float]] = []
    for job, metrics in starts.items():
        run = {"method": job.method, "formation": job.formation, "seed": "" if job.seed is None else str(job.seed)}
        cost = {"frames": job.frames(), "seconds": round(job.seconds(), 1), "starts": len(metrics["success_rate"])}
        rows.append({**run, **cost, **{name: nanmean(values) for name, values in metrics.items()}})
    write_csv(out / "seeds.csv", rows)
    formations = dict.fromkeys(job.formation for job in done)
    table = "\n".join([head(command, starts), *(formation_table(formation, starts) for formation in formations)])
    with replacing(out / "table.md") as file:
        file.write_text(table)
    return table


def head(command: str, starts: dict[Job, dict[str, np.ndarray]]) -> str:
    """What made the table, and how to read it."""
    seeds = ", ".join(map(str, sorted({job.seed for job in starts if job.seed is not None}))) or "none"
    counts = ", ".join(map(str, sorted({len(metrics["success_rate"]) for metrics in starts.values()}))) or "no"
    return (
        f"`{command}`\n\nTraining seeds {seeds}; {counts} starts (seed {TEST_SEED:,}) that training never saw, the "
        "same for all. Mean and, in brackets, its 95 % interval (bootstrap over seeds, then starts). TT of teams that "
        f"arrive whole. Bold: the shortest of the methods of which {ARRIVING:.0%} of robots arrive. Grey: the paper.\n"
    )


def fastest(runs: dict[str, dict[Job, dict[str, np.ndarray]]]) -> str | None:
    """The method with the shortest travel time of those of which enough robots arrive."""
    times = {}
    for method, metrics in runs.items():
        rate, time = (
            nanmean(np.concatenate([run[name] for run in metrics.values()])) for name in ("success_rate", "travel_time")
        )
        if rate >= ARRIVING and not math.isnan(time):
            times[method] = time
    return min(times, key=times.__getitem__, default=None)


def formation_table(formation: str, starts: dict[Job, dict[str, np.ndarray]]) -> str:
    """The rows of one formation."""
    found: dict[str, dict[Job, dict[str, np.ndarray]]] = {}
    for job, metrics in starts.items():
        if job.formation == formation:
            found.setdefault(job.method, {})[job] = metrics
    best = fastest(found)
    heads = ["", "seeds", *(head for head, _, _ in COLUMNS.values()), "frames", "minutes"]
    lines = [f"### {formation.capitalize()}", "", f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for method, what in {**METHODS, **ABLATIONS}.items():
        if (runs := found.get(method)) is None:
            continue
        cells = []
        for name, (_, factor, digits) in COLUMNS.items():
            text = cell([metrics[name] for metrics in runs.values()], factor, digits)
            cells.append(f"**{text}**" if (method, name) == (best, "travel_time") else text)
        frames = max(job.frames() for job in runs)
        minutes = [job.seconds() / 60 for job in runs if job.seconds()]
        cost = [f"{frames:,}" if frames else "", f"{np.mean(minutes):.1f}" if minutes else ""]
        seeds = "" if any(job.seed is None for job in runs) else str(len(runs))
        lines.append(f"| {what.title} | {seeds} | {' | '.join([*cells, *cost])} |")
        if method in PAPER:
            rate, time, *integrity = (f"{value:g}" for value in PAPER[method][formation])
            row = ["the paper's", "", rate, "", time, *integrity, "", "", "", "", "", ""]
            shown = [f'<span style="color:gray">{value}</span>' if value else "" for value in row]
            lines.append(f"| {' | '.join(shown)} |")
    return "\n".join([*lines, ""])


def cell(runs: Sequence[np.ndarray], factor: float, digits: int) -> str:
    """Mean and interval as a cell of the table."""
    mean, low, high = (factor * value for value in bootstrap(runs))
    if math.isnan(mean):
        return "-"
    return f"{mean:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def bootstrap(runs: Sequence[np.ndarray], resamples: int = 2000, seed: int = 0) -> tuple[float, float, float]:
    """Mean over all seeds and starts, and its 95 % percentile interval.

    Seeds are drawn with replacement, then the starts of each: with one seed (or a method without any) the interval is
    that of the starts alone. NaN, where a start has no such metric, is left out.
    """
    rng = np.random.default_rng(seed)
    chosen = rng.integers(len(runs), size=(resamples, len(runs)))
    total, count = np.zeros(chosen.shape), np.zeros(chosen.shape)
    for k, values in enumerate(runs):
        where = chosen == k
        drawn = values[rng.integers(len(values), size=(where.sum(), len(values)))]
        total[where], count[where] = np.nansum(drawn, axis=1), (~np.isnan(drawn)).sum(1)
    mean, measured = nanmean(np.concatenate(list(runs))), count.sum(1) > 0
    if not measured.any():
        return mean, math.nan, math.nan
    low, high = np.percentile(total.sum(1)[measured] / count.sum(1)[measured], [2.5, 97.5])
    return mean, float(low), float(high)


def nanmean(values: np.ndarray) -> float:
    """Mean of what is not NaN, NaN if nothing is."""
    values = values[~np.isnan(values)]
    return float(values.mean()) if len(values) else math.nan


def read_starts(path: Path) -> dict[str, np.ndarray]:
    """The metrics of each start by their names."""
    with open(path) as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
