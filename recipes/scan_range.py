"""What a policy loses with a sensor that sees only so far: ``python recipes/scan_range.py``.

A laser scan that hits nothing gives its range and no direction (:meth:`redig.deploy.LaserScan.nearest`), which training
never shows. The policy drives teams whose observations are like that beyond each range, or that keep the true direction
with the range as distance. Writes ``scan_range.csv``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor

from redig.envs.factory import make_env
from redig.evaluation import evaluate
from redig.files import write_csv
from redig.policy import OBSERVATION, load_policy, read_header

FIGURES = ("success_rate", "team_success_rate", "travel_time", "cfi_0.5")


@dataclass
class Arguments:
    """Drive with each range, with and without the direction to what is out of range."""

    policy: Path = Path("recipes/policies/wedge.safetensors")
    """The policy file."""
    ranges: tuple[float, ...] = (2.0, 1.0, 0.5)
    """Ranges of the sensor (m)."""
    starts: int = 64
    """Starts of each drive."""
    seed: int = 1_000_000
    """Seed of the starts, of those that settings may be chosen by."""
    out: Path = Path("docs/results/robots")
    """Folder for the table."""


def main(arguments: Arguments) -> list[dict[str, Any]]:
    """Drive and write the table."""
    _, scenario = read_header(arguments.policy)
    policy, rows = load_policy(arguments.policy), []
    for reach in (*arguments.ranges, float("inf")):
        for keeps in (False, True):
            sensor = TensorDictModule(lambda o, r=reach, k=keeps: out_of(o, r, k), [OBSERVATION], [OBSERVATION])
            env = make_env(arguments.starts, **scenario)
            metrics = evaluate(TensorDictSequential(sensor, *policy), env, seed=arguments.seed)
            rows.append(
                {"range (m)": reach, "direction beyond": "true" if keeps else "zeros"}
                | {name: round(metrics[name], 4) for name in FIGURES}
            )
            print(*rows[-1].values(), sep="\t", flush=True)
    write_csv(arguments.out / "scan_range.csv", rows)
    return rows


def out_of(observation: Tensor, reach: float, keeps_direction: bool) -> Tensor:
    """Observations ``[*B, n, 9]`` of a sensor that sees obstacles to ``reach`` (m)."""
    state, distance, direction = observation.split([6, 1, 2], -1)
    if not keeps_direction:
        direction = torch.where(distance <= reach, direction, 0.0)
    return torch.cat([state, distance.clamp_max(reach), direction], -1)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
