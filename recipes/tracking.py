"""How well differential drives follow velocity commands: ``python recipes/tracking.py``.

Commands are those of analytic curves and of teams that a trained policy drives through its scenario, where a robot
moves in any direction. A base (an ideal unicycle, integrated exactly) follows them through
:class:`~redig.deploy.DifferentialDrive`; the error is its distance from where the commands lead. Writes
``tracking.csv`` and ``tracking.png``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.deploy import LIMO, WARTHOG, Base, DifferentialDrive
from redig.envs.factory import make_env
from redig.files import replacing, write_csv
from redig.policy import OBSERVATION, load_policy, read_header
from redig.viz.scene import PALETTE

Array = NDArray[np.float64]

STEP = 0.1  # s, of a command, as in training
CALLS = 5  # of the drive in a step
BASES: dict[str, Base] = {
    "limo": LIMO,
    "limo, as its wheels allow": replace(LIMO, max_angular=11.4, max_angular_acceleration=28.5),
    "warthog": WARTHOG,
}


@dataclass
class Arguments:
    """Follow curves and teams with each base, backwards or turning in place, with and without position feedback."""

    policy: Path = Path("recipes/policies/wedge.safetensors")
    """The policy file."""
    starts: int = 16
    """Teams that it drives."""
    seed: int = 2_000_000
    """Seed of their starts."""
    feedback: float = 1.0
    """Speed towards where the commands lead, per distance from there (1/s); 0 in the other half of the table."""
    out: Path = Path("docs/results/robots")
    """Folder for the table and the figure."""


def main(arguments: Arguments) -> list[dict[str, Any]]:
    """Follow all, write and print the table, draw the figure."""
    paths = {name: curve(velocity) for name, velocity in CURVES.items()}
    paths["policy"] = team_paths(arguments)
    rows, drawn = [], {}
    for base_name, base in BASES.items():
        for reverse in (True, False):
            for feedback in (0.0, arguments.feedback):
                for name, path in paths.items():
                    followed = np.stack([follow(one, base, reverse, feedback) for one in path])
                    error = np.linalg.norm(followed - path, axis=-1)
                    drawn[base_name, reverse, feedback, name] = followed
                    rows.append(
                        {
                            "base": base_name,
                            "behind": "backwards" if reverse else "turns in place",
                            "feedback (1/s)": feedback,
                            "commands": name,
                            "rms (m)": round(float(np.sqrt((error**2).mean())), 4),
                            "max (m)": round(float(error.max()), 4),
                            "end (m)": round(float(error[:, -1].mean()), 4),
                            "aside, max (m)": round(max(map(aside, followed, path)), 4),
                        }
                    )
                    print(*rows[-1].values(), sep="\t")
    write_csv(arguments.out / "tracking.csv", rows)
    with replacing(arguments.out / "tracking.png") as file:
        draw(paths, drawn, arguments.feedback).savefig(file, dpi=130)
    return rows


CURVES: dict[str, Callable[[float], tuple[float, float]]] = {
    "straight": lambda t: (0.5, 0.0),
    "circle, radius 1 m": lambda t: (0.5 * math.cos(t / 2), 0.5 * math.sin(t / 2)),
    "figure of eight": lambda t: (0.5 * math.cos(t / 2), 0.5 * math.cos(t)),
    "square": lambda t: [(0.5, 0.0), (0.0, 0.5), (-0.5, 0.0), (0.0, -0.5)][int(t / 4) % 4],
    "forth and back": lambda t: (0.5 if int(t / 4) % 2 == 0 else -0.5, 0.0),
    "to the side": lambda t: (0.0, 0.5),
}
"""Velocities (m/s) at a time (s)."""


def curve(velocity: Callable[[float], tuple[float, float]], seconds: float = 16.0) -> Array:
    """Where commands lead that change every step: places ``[1, T + 1, 2]`` (m) from the origin."""
    steps = np.array([velocity((i + 0.5) * STEP) for i in range(round(seconds / STEP))])
    return np.concatenate([np.zeros((1, 2)), (steps * STEP).cumsum(0)])[None]


def team_paths(arguments: Arguments) -> Array:
    """Ways ``[starts * n, T + 1, 2]`` (m) of robots that the policy drives, until the first team has arrived."""
    _, scenario = read_header(arguments.policy)
    env = make_env(arguments.starts, seed=arguments.seed, **scenario)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        data = env.rollout(100, load_policy(arguments.policy))
    place = data[OBSERVATION][..., :2].double()  # [starts, T, n, 2]
    return place.transpose(1, 2).flatten(0, 1).numpy()


def follow(path: Array, base: Base, reverse: bool, feedback: float) -> Array:
    """Places ``[T + 1, 2]`` (m) at the ends of the steps of a base that starts where the path does, heading along x."""
    drive, dt = DifferentialDrive(base, reverse=reverse), STEP / CALLS
    x, y, heading = float(path[0, 0]), float(path[0, 1]), 0.0
    places = [(x, y)]
    for before, after in pairwise(path):
        command = (after - before) / STEP
        for call in range(CALLS):
            target = before + (after - before) * call / CALLS
            wanted = command + feedback * (target - (x, y))
            linear, angular = drive((wanted[0], wanted[1]), heading, dt)
            x, y, heading = advance(x, y, heading, linear, angular, dt)
        places.append((x, y))
    return np.array(places)


def aside(followed: Array, path: Array) -> float:
    """How far off the whole of the path ``[T + 1, 2]`` the places ``[T + 1, 2]`` are at most (m), whenever they are."""
    start, way = path[:-1], np.diff(path, axis=0)
    length = np.maximum((way**2).sum(-1), 1e-12)
    part = np.clip(((followed[:, None] - start) * way).sum(-1) / length, 0, 1)  # [T + 1, T]
    return float(np.linalg.norm(followed[:, None] - start - part[..., None] * way, axis=-1).min(-1).max())


def advance(x: float, y: float, heading: float, linear: float, angular: float, dt: float) -> tuple[float, float, float]:
    """An ideal unicycle after ``dt`` (s): along an arc, whose chord is ``sin(turn / 2) / (turn / 2)`` of it."""
    half = angular * dt / 2
    chord = linear * dt * (math.sin(half) / half if half else 1.0)
    return x + chord * math.cos(heading + half), y + chord * math.sin(heading + half), heading + 2 * half


def draw(paths: dict[str, Array], drawn: dict[tuple[str, bool, float, str], Array], feedback: float) -> Figure:
    """Some of the paths: where the commands lead, and two bases with feedback."""
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    for axes, name in zip(figure.subplots(1, 3), ["figure of eight", "square", "policy"], strict=True):
        for i in range(5 if name == "policy" else 1):
            lines = {"where the commands lead": ("0.7", 3.0, paths[name][i])}
            for base, colour in zip(list(BASES)[:2], PALETTE, strict=False):
                lines[base] = (colour, 1.0, drawn[base, True, feedback, name][i])
            for label, (colour, width, path) in lines.items():
                axes.plot(*path.T, color=colour, lw=width, label=label if i == 0 else None)
        axes.set(title=name, xlabel="x (m)", aspect="equal", ylabel="y (m)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


if __name__ == "__main__":
    main(tyro.cli(Arguments))
