"""Learning rates of the comparison: every method on every task, on a seed that is not reported.

``python recipes/compare_tuning.py`` runs what ``runs/compare-tuning`` does not hold yet, and writes ``tuning.csv``.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import compare
import tyro
from compare_methods import METHODS
from compare_tasks import GYM

from redig.files import write_csv

RATES = (3e-4, 1e-3)
DDPG_RATES = (1e-4, *RATES)  # its actor saturates at high rates
ALPHAS = (1.0, 0.01)  # with so few updates SAC's entropy still outweighs the small rewards of a team if it begins at 1
FRAMES = {"single": 5000, "team": 60_000}


@dataclass
class Arguments:
    """Try learning rates."""

    tasks: tuple[str, ...] = tuple(METHODS)
    """Tasks to tune on."""
    methods: tuple[str, ...] = ("sac", "td3", "iddpg", "maddpg", "masac", "dipo")
    """Methods to tune, where a task has them."""
    seed: int = 100
    """Seed of the runs; 0 to 99 are for results."""
    out: Path = Path("runs/compare-tuning")
    """Folder of the runs and of tuning.csv."""


def main(arguments: Arguments) -> list[dict[str, object]]:
    """Run the grid and write ``tuning.csv``; returns its rows."""
    if arguments.seed < 100:
        raise ValueError(f"seed: got {arguments.seed}, must be at least 100: lower ones are for results")
    rows: list[dict[str, object]] = []
    for task, method in product(arguments.tasks, arguments.methods):
        if method not in METHODS[task]:
            continue
        rates = DDPG_RATES if method in ("iddpg", "maddpg") else RATES
        for lr, alpha in product(rates, ALPHAS if method == "masac" else (1.0,)):
            change = {"lr": lr, "alpha_init": alpha, "frames": FRAMES["single" if task in GYM else "team"]}
            folder = arguments.out / f"lr{lr:g}-alpha{alpha:g}"
            path = folder / f"{task}-{method}-seed{arguments.seed}.csv"
            if not path.exists():
                compare.main(compare.Arguments(task, method, arguments.seed, folder, change))
            with open(path, newline="") as file:
                last = list(csv.DictReader(file))[-1]
            result = {"final_return": float(last["return_mean"]), "return_sd": float(last["return_sd"])}
            rows.append({"task": task, "method": method, "seed": arguments.seed, **change, **result})
            write_csv(arguments.out / "tuning.csv", rows)
    return rows


if __name__ == "__main__":
    main(tyro.cli(Arguments))
