"""Every kind of map: a figure of them, and how a policy that was trained on another one fares on each.

``python recipes/maps.py`` draws ``docs/images/maps.png``; ``python recipes/maps.py --policy FILE`` measures.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from matplotlib.figure import Figure

from redig.envs import EVALUATION_MAPS, MAP_KINDS, make_env
from redig.envs.map_batch import map_at
from redig.evaluation import evaluate
from redig.files import replacing, write_csv
from redig.policy import load_policy, read_header
from redig.viz.scene import INK, draw_map, formation_outline
from redig.viz.team import draw_formation

SHOWN = (
    "success_rate",
    "team_success_rate",
    "travel_time",
    "travel_time_teams",
    "collision_rate",
    "cfi_0.5",
    "jerk_mean",
)


@dataclass
class Arguments:
    """Draw all kinds of maps, or measure a policy on the evaluation maps of each kind."""

    policy: Path | None = None
    """A policy file to measure; without one the figure is drawn."""
    starts: int = 8
    """Starts on each of the 32 evaluation maps of a kind."""
    seed: int = 2_000_000
    """Seed of the starts."""
    map_seed: int = 0
    """Training map of each kind that the figure shows."""
    out: Path | None = None
    """The figure (docs/images/maps.png) or the folder for zero_shot.csv and table.md (docs/results/maps)."""


def main(arguments: Arguments) -> None:
    """Draw or measure."""
    if arguments.policy is None:
        draw(arguments.out or Path("docs/images/maps.png"), arguments.map_seed)
    else:
        measure(arguments.policy, arguments.starts, arguments.seed, arguments.out or Path("docs/results/maps"))


def draw(path: Path, map_seed: int) -> None:
    """Every kind of map with a wedge at its start and at its goal."""
    figure = Figure(figsize=(8.6, 10.4), layout="constrained")
    panels = figure.subplots(4, 2).flat
    for kind in MAP_KINDS:
        env = make_env(map_seed + 1, obstacle_map=f"{kind}:train", position_jitter=0.0, heading_jitter=0.0)
        start = env.reset()["agents", "observation"][-1, :, :2]
        world, axes = env.base_env.scenario, next(panels)
        here = map_at(world.obstacle_map, map_seed)
        x_min, y_min, x_max, y_max = here.bounds
        draw_map(axes, here, (x_min, x_max, y_min, y_max))
        if here.route is not None:
            axes.plot(*here.route.T, color=INK, linewidth=0.8, linestyle=":")
        for team, filled in ((start, True), (world.goal[-1], False)):
            draw_formation(axes, team.numpy(), formation_outline("wedge", 5), world.radius, filled)
        axes.set_title(f"{kind}, gap {here.gap:.2f} m", size=9, loc="left")
    for unused in panels:
        unused.set_axis_off()
    with replacing(path) as unfinished:
        figure.savefig(unfinished, dpi=160)
    print(f"written to {path}")


def measure(file: Path, starts: int, seed: int, folder: Path) -> None:
    """Evaluate a policy on the evaluation maps of every kind; a row for each."""
    policy, (_, scenario) = load_policy(file), read_header(file)
    rows = []
    for kind in MAP_KINDS:
        env = make_env(EVALUATION_MAPS * starts, **{**scenario, "obstacle_map": f"{kind}:evaluation"})
        metrics = evaluate(policy, env, seed=seed)
        rows.append({"map": kind, **{name: round(metrics[name], 4) for name in SHOWN}})
        print(rows[-1])
    write_csv(folder / "zero_shot.csv", rows)
    body = [["-" if value != value else str(value) for value in row.values()] for row in rows]
    cells = [list(rows[0]), ["---"] * len(rows[0]), *body]
    with replacing(folder / "table.md") as path:
        path.write_text("".join(f"| {' | '.join(line)} |\n" for line in cells))


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
