"""Trials of the PPO baselines, by validation starts alone: the options of ``ppo_gnn.py``, and no final evaluation.

``python recipes/ppo_tuning.py --method dgnn --lr 1e-3 --seed 11`` runs one trial under ``runs/ppo-tuning`` and writes
``trials.csv`` there: for each trial so far the options that differ from the defaults, and what its validations found.
"""

from __future__ import annotations

import csv
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import ppo_gnn
import tyro
from finish import score
from ppo_config import PPOConfig
from seeds import numbers

from redig.files import write_csv

OUT = Path("runs/ppo-tuning")
SHOWN = ("updates", "success_rate", "team_success_rate", "travel_time", "cfi_0.5", "jerk_mean")


def main(config: PPOConfig, out: Path = OUT) -> list[dict[str, Any]]:
    """Train without a final evaluation; returns and writes one row a trial.

    Raises:
        ValueError: for a seed that is for results.
    """
    if config.resume is None:
        if config.seed < 10:
            raise ValueError(f"seed: got {config.seed}, must be at least 10: lower ones are for results")
        name = f"{config.formation}-{config.method}-{config.seed}-{time.strftime('%y%m%d-%H%M%S')}"
        config.out = config.out or out / name
    ppo_gnn.train(config, end=lambda run, config: {})
    rows = [row(folder) for folder in sorted(path.parent for path in out.glob("*/evaluations.csv"))]
    write_csv(out / "trials.csv", rows)
    return rows


def row(folder: Path) -> dict[str, Any]:
    """What a trial changed, and its best and its last validation."""
    config = json.loads((folder / "config.json").read_text())
    with open(folder / "evaluations.csv") as file:
        evaluations = [numbers(line) for line in csv.DictReader(file)]
    named = {name: config[name] for name in ("formation", "method", "seed")}
    preset = PPOConfig(formation=config["formation"], method=config["method"]).resolve()
    defaults = json.loads(json.dumps(asdict(preset)))  # tuples as lists, as in the file
    changed = [
        f"{name}={value}"
        for name, value in config.items()
        if name not in (*named, "out", "resume", "threads") and value != defaults.get(name)
    ]
    found: dict[str, Any] = {**named, "options": " ".join(changed)}
    for which, metrics in (("best", max(evaluations, key=score)), ("last", evaluations[-1])):
        found |= {f"{which}_{name}": round(metrics[name], 4) for name in SHOWN}
    return found


if __name__ == "__main__":
    main(tyro.cli(PPOConfig))
