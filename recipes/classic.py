"""Evaluate a baseline that does not learn: ``python recipes/classic.py --method uncoordinated --formation wedge``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from evaluate import draw_crossing
from torchrl.envs import TransformedEnv

from redig.baselines import LeaderFollower, UncoordinatedPlanner, VirtualStructure
from redig.baselines.episode import EpisodePlanner
from redig.envs.factory import make_env
from redig.evaluation import evaluate, format_table, write_metrics

METHODS: dict[str, type[EpisodePlanner]] = {
    "leader_follower": LeaderFollower,
    "virtual_structure": VirtualStructure,
    "uncoordinated": UncoordinatedPlanner,
}


@dataclass
class Arguments:
    """Drive teams from fresh starts with a baseline that plans, and measure what they do."""

    method: Literal["leader_follower", "virtual_structure", "uncoordinated"]
    """Which baseline."""
    formation: str = "wedge"
    """wedge, line or circle."""
    n_robots: int = 5
    """Robots in the team."""
    corridor_width: float = 1.1
    """Width of the corridor (m)."""
    delay_cost: float | None = None
    """Of the virtual structure: formation integrity that a second of travel is worth; default 0.2."""
    starts: int = 256
    """Number of starts."""
    seed: int = 2_000_000
    """Seed of the starts."""
    out: Path = Path("classic")
    """Folder for metrics.json and the pictures."""
    animation: bool = True
    """Draw the first start as a figure and as an animation."""


def main(arguments: Arguments) -> dict[str, float]:
    """Evaluate, print the table, write ``metrics.json`` and the pictures."""
    if arguments.starts < 1:
        raise ValueError(f"starts: got {arguments.starts}, must be at least 1")
    if arguments.delay_cost is not None and arguments.method != "virtual_structure":
        raise ValueError(f"delay_cost: it is an option of virtual_structure, not of {arguments.method}")
    names = ("formation", "n_robots", "corridor_width")
    scenario = {name: getattr(arguments, name) for name in names}
    env = make_env(arguments.starts, **scenario)
    metrics = evaluate(policy(arguments, env), env, seed=arguments.seed)
    print(format_table(metrics))
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_metrics(arguments.out / "metrics.json", metrics)
    if arguments.animation:
        env = make_env(1, **scenario)
        draw_crossing(arguments.out, policy(arguments, env), env, arguments.seed)
    print(f"written to {arguments.out}")
    return metrics


def policy(arguments: Arguments, env: TransformedEnv) -> EpisodePlanner:
    """The baseline for the scenario of an environment."""
    options = {} if arguments.delay_cost is None else {"delay_cost": arguments.delay_cost}
    return METHODS[arguments.method](env.scenario, **options)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
