"""Evaluate a policy file: ``python recipes/evaluate.py recipes/policies/wedge.safetensors --starts 256``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from tensordict.nn import TensorDictModuleBase

from redig.envs.factory import make_env
from redig.evaluation import evaluate, format_table, rollout_trajectories, write_metrics
from redig.policy import load_policy, read_header
from redig.viz import animate, plot_trajectories


@dataclass
class Arguments:
    """Drive teams from fresh starts with a trained policy, and measure what they do."""

    policy: Annotated[Path, tyro.conf.Positional]
    """The policy file."""
    starts: int = 256
    """Number of starts."""
    seed: int = 2_000_000
    """Seed of the starts; the recipe trains and validates on other ones."""
    out: Path = Path("evaluation")
    """Folder for metrics.json and the pictures."""
    formation: str | None = None
    """Another formation than the one that the policy was trained for."""
    n_robots: int | None = None
    """Another number of robots."""
    corridor_width: float | None = None
    """Another width of the corridor (m)."""
    animation: bool = True
    """Draw the first start as a figure and as an animation."""


def main(arguments: Arguments) -> dict[str, float]:
    """Evaluate, print the table, write ``metrics.json`` and the pictures."""
    if arguments.starts < 1:
        raise ValueError(f"starts: got {arguments.starts}, must be at least 1")
    _, scenario = read_header(arguments.policy)
    changes = {name: getattr(arguments, name) for name in ("formation", "n_robots", "corridor_width")}
    scenario |= {name: value for name, value in changes.items() if value is not None}
    env = make_env(arguments.starts, **scenario)
    policy = load_policy(arguments.policy, env.observation_spec["agents", "observation"].shape[-1])
    metrics = evaluate(policy, env, seed=arguments.seed)
    print(format_table(metrics))
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_metrics(arguments.out / "metrics.json", metrics)
    if arguments.animation:
        draw_crossing(arguments.out, policy, scenario, arguments.seed)
    print(f"written to {arguments.out}")
    return metrics


def draw_crossing(folder: Path, policy: TensorDictModuleBase, scenario: dict[str, Any], seed: int) -> None:
    """One crossing as a figure and as an animation."""
    env = make_env(1, **scenario)
    rollout = rollout_trajectories(policy, env, seed)
    position = rollout["position"][0, rollout["mask"][0]]
    world = env.base_env.scenario
    plot_trajectories(folder / "trajectories.png", position, world.formation, world.obstacle_map, world.goal[0])
    animate(folder / "trajectories.gif", position, world.formation, world.obstacle_map, world.goal[0])


if __name__ == "__main__":
    main(tyro.cli(Arguments))
