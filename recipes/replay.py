"""Metrics and figures of a recorded run: ``python recipes/replay.py run.mcap --scenario POLICY.safetensors``."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from evaluate import draw_team
from numpy.typing import NDArray
from tensordict import TensorDict

from redig.deploy.record import Run, read_run
from redig.envs.factory import make_env
from redig.envs.map_batch import map_at
from redig.envs.navigation import FormationNavigation
from redig.envs.rewards import mate_clearance
from redig.evaluation import format_table, jerk, mean_metrics, team_metrics, write_metrics
from redig.files import write_csv
from redig.policy import read_header
from redig.viz import plot_jerk

TOUCH = 1e-3  # m; the simulated worlds move robots that collide just out of contact before they are recorded


@dataclass
class Arguments:
    """Measure and draw a run that recipes/robots.py or mujoco_robots.py has recorded, as if it had just been driven.

    Each sample is a time step of the world; what a run does not say, such as the radius of robots and the shape they
    keep, is that of the scenario. A robot collides that comes within 1 mm of a wall or a teammate.
    """

    run: Annotated[Path, tyro.conf.Positional]
    """The recording (.mcap)."""
    scenario: Path
    """Policy file (.safetensors) of whose scenario the run is."""
    speed: float = 1.0
    """How much faster than real time the world ran."""
    start: int = 0
    """Which of the recorded starts is drawn."""
    out: Path = Path("runs/replay")
    """Folder for starts.csv, metrics.json and the pictures."""


def split(run: Run) -> list[slice]:
    """The samples of each start: with another one, all goals are others."""
    leaps = np.linalg.norm(np.diff(run.goal, axis=0), axis=-1).max(-1) > 1e-3
    ends = [0, *(np.flatnonzero(leaps) + 1).tolist(), len(run.stamp)]
    return [slice(begin, end) for begin, end in pairwise(ends)]


def trajectory(run: Run, samples: slice, scenario: FormationNavigation) -> TensorDict:
    """One start ``[1, T]`` with what :func:`~redig.evaluation.team_metrics` needs, and the goals."""
    position, goal, obstacle = (_tensor(x[samples]) for x in (run.position, run.goal, run.obstacle))
    mate = mate_clearance(position, scenario.radius)
    collision = (obstacle.norm(dim=-1) < scenario.radius + TOUCH) | (mate < TOUCH)
    near = (goal - position).norm(dim=-1) < scenario.goal_radius
    arrived = near.int().cummax(-2).values.bool()
    mask = torch.ones(len(position), dtype=torch.bool)
    fields = {"position": position, "goal": goal, "arrived": arrived, "collision": collision, "mask": mask}
    return TensorDict(fields, mask.shape).unsqueeze(0)


def check(run: Run, starts: list[slice], scenario: FormationNavigation, arguments: Arguments) -> None:
    """Raise a ValueError if the run cannot be one of this scenario, or there is no such start."""
    if len(run.robots) != scenario.n_robots:
        raise ValueError(f"scenario: it has {scenario.n_robots} robots, the run has {len(run.robots)}")
    if not 0 <= arguments.start < len(starts):
        raise ValueError(f"start: got {arguments.start}, the run has starts 0 to {len(starts) - 1}")
    spacing = [np.diff(run.stamp[samples]) for samples in starts]
    step = float(np.median(np.concatenate(spacing))) if run.stamp.size > len(starts) else 0.0
    expected = scenario.dt / arguments.speed
    if not 0.8 * expected < step < 1.25 * expected:
        raise ValueError(
            f"speed: got {arguments.speed:g}, at which samples should be {expected:.3g} s apart, "
            f"but they are {step:.3g} s"
        )


def main(arguments: Arguments) -> dict[str, float]:
    """Print and write the metrics of all starts, draw one."""
    run = read_run(arguments.run)
    scenario: FormationNavigation = make_env(1, **read_header(arguments.scenario)[1]).scenario
    starts = split(run)
    check(run, starts, scenario, arguments)
    teams = [trajectory(run, samples, scenario) for samples in starts]
    figures = [team_metrics(team, scenario) for team in teams]
    rows = [{"start": i, **{key: value.item() for key, value in each.items()}} for i, each in enumerate(figures)]
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_csv(arguments.out / "starts.csv", rows)
    metrics = mean_metrics(figures)
    print(format_table(metrics))
    write_metrics(arguments.out / "metrics.json", metrics)
    draw(arguments.out, teams[arguments.start][0], scenario)
    print(f"written to {arguments.out}")
    return metrics


def draw(folder: Path, team: TensorDict, scenario: FormationNavigation) -> None:
    """Trajectories, as a figure and as an animation, and the jerk of a team ``[T]``."""
    here = map_at(scenario.obstacle_map, 0)
    draw_team(folder / "trajectories.mp4", team["position"], scenario.formation, here, team["goal"][0])
    profile = jerk(team["position"], scenario.dt).masked_fill(team["arrived"][2:-1], torch.nan)
    plot_jerk(folder / "jerk.png", {scenario.formation: profile}, scenario.dt)


def _tensor(values: NDArray) -> torch.Tensor:
    return torch.as_tensor(values, dtype=torch.float32)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
