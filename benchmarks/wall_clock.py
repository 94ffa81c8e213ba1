"""How long the wedge recipe takes: to 99 % success, to all of its targets, and as a whole.

Run ``python benchmarks/wall_clock.py``; ``--before DIR`` runs the recipe of another checkout in turn with this one. The
clock starts with the process, imports and demonstrations included, and is read when an evaluation is written.
"""

from __future__ import annotations

import csv
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from harness import report

ROOT = Path(__file__).resolve().parents[1]
TARGETS = {  # of the wedge, as docs/results states them; CFI and success from below, the others from above
    "success_rate": (0.995, True),
    "team_success_rate": (0.98, True),
    "travel_time": (7.5, False),
    "cfi_0.5": (0.90, True),
    "jerk_mean": (2.0, False),
}


@dataclass
class Arguments:
    """Time the wedge recipe over several seeds, one run after the other."""

    seeds: tuple[int, ...] = (0, 1, 2)
    """Training seeds."""
    before: Path | None = None
    """Another checkout whose recipe is timed in turn, seed by seed."""
    threads: int = 2
    """Threads of each run."""
    until_targets: bool = False
    """Stop each run at the first validation that reaches all targets."""
    options: str = ""
    """Options passed on to the recipe, in one string: --options="--smoke"."""
    runs: Path | None = None
    """Keep the folders of this version's runs here; by default they are removed."""
    out: Path = Path("docs/results/speed")
    """Folder for the tables."""


def main(arguments: Arguments) -> list[dict[str, Any]]:
    """Run, time, and write ``wall_clock.csv`` and one row an evaluation in ``wall_clock_curves.csv``."""
    checkouts = {"this version": ROOT} | ({"before": arguments.before.resolve()} if arguments.before else {})
    rows, curves = [], []
    for seed in arguments.seeds:
        for name, root in checkouts.items():
            keep = arguments.runs / f"wedge-seed{seed}" if arguments.runs and root == ROOT else None
            options = shlex.split(arguments.options)
            row, curve = timed_run(root, seed, arguments.threads, options, keep, arguments.until_targets)
            rows.append({"recipe": name, "seed": seed, **row})
            curves += [{"recipe": name, "seed": seed, **evaluation} for evaluation in curve]
    targets = ", ".join(f"{name} {'≥' if least else '≤'} {value:g}" for name, (value, least) in TARGETS.items())
    notes = [
        f"Seconds since the process started. (a): the first validation in which 99 % of robots arrive; (b): the first "
        f"with {targets}, on the 128 validation starts of the seed. The last columns are the final evaluation on 256 "
        "starts never trained on."
    ]
    report(arguments.out, "wall_clock", rows, notes, arguments.threads)
    report(arguments.out, "wall_clock_curves", curves, threads=arguments.threads)
    return rows


def timed_run(
    root: Path,
    seed: int,
    threads: int,
    options: Sequence[str] = (),
    keep: Path | None = None,
    until_targets: bool = False,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """One run in a fresh folder: the times and final figures, and all evaluations with their times."""
    folder = Path(tempfile.mkdtemp(prefix="redig-wall-clock-"))
    command = [sys.executable, str(root / "recipes/redig_wedge.py"), "--seed", str(seed), "--threads", str(threads)]
    environment = {**os.environ, "PYTHONPATH": str(root / "src")}
    try:
        started = time.perf_counter()
        with open(folder / "output.txt", "w") as output:
            process = subprocess.Popen(
                [*command, "--out", str(folder / "run"), *options], stdout=output, stderr=output, env=environment
            )
            curve: list[dict[str, Any]] = []
            while process.poll() is None:
                time.sleep(0.1)
                for evaluation in evaluations(folder / "run")[len(curve) :]:
                    curve.append({"seconds": time.perf_counter() - started, **evaluation})
                if until_targets and any(map(reached, curve)):
                    process.kill()
                    process.wait()
        stopped = until_targets and any(map(reached, curve))
        seconds = time.perf_counter() - started
        if process.returncode and not stopped:
            raise RuntimeError(f"{' '.join(command)} failed:\n{(folder / 'output.txt').read_text()[-2000:]}")
        final = {} if stopped else json.loads((folder / "run" / "metrics.json").read_text())
        if keep is not None:
            shutil.copytree(folder / "run", keep)
    finally:
        shutil.rmtree(folder)
    row = {
        "to 99 % success (s)": next((e["seconds"] for e in curve if e["success_rate"] >= 0.99), "not reached"),
        "to all targets (s)": next((e["seconds"] for e in curve if reached(e)), "not reached"),
        "whole run (s)": "stopped" if stopped else seconds,
        "final: all targets": "" if stopped else reached(final),
    }
    return {**row, **{name: final.get(name, "") for name in TARGETS}}, curve


def evaluations(run: Path) -> list[dict[str, float]]:
    """The evaluations that a run has written so far."""
    path = run / "evaluations.csv"
    if not path.exists():
        return []
    with open(path) as file:
        rows = list(csv.DictReader(file))
    return [{name: float(row[name]) for name in ("updates", *TARGETS)} for row in rows]


def reached(metrics: dict[str, float]) -> bool:
    """Whether all targets are reached; a travel time of nobody is none."""
    return all(
        metrics[name] >= value if at_least else metrics[name] <= value for name, (value, at_least) in TARGETS.items()
    )


if __name__ == "__main__":
    main(tyro.cli(Arguments))
