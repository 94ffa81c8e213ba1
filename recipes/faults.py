"""What faults cost a team: ``python recipes/faults.py robot.onnx --scenario recipes/policies/wedge.safetensors``."""

from __future__ import annotations

import csv
import logging
import random
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from tensordict.nn import TensorDictModule
from torch import Tensor

from redig.deploy.messages import RobotState
from redig.deploy.node import REST, RobotNode
from redig.deploy.pilot import Pilot
from redig.deploy.robot import RobotPolicy
from redig.deploy.transport import Faults, Radio, Sensed
from redig.envs.factory import make_env
from redig.evaluation import evaluate
from redig.files import write_csv
from redig.policy import ACTION, OBSERVATION, read_header
from redig.viz.scene import PALETTE, save_figure

RATES = ("success_rate", "team_success_rate")


@dataclass
class Arguments:
    """Teams whose robots each decide alone, in one process, with a radio that has faults; success over the faults."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Policy file of one robot (recipes/export.py --ego)."""
    scenario: Path
    """Policy file (.safetensors) of whose scenario the world is."""
    starts: int = 32
    """Starts of each point and seed."""
    seeds: int = 2
    """Seeds of each point, of starts and faults."""
    first_seed: int = 3_000_000
    """The first of them; starts that no policy was trained or chosen on."""
    out: Path = Path("docs/results/robots")
    """Folder for faults.csv and faults.png."""


@dataclass(frozen=True)
class Case:
    """What goes wrong.

    Args:
        radio: what happens to messages.
        lies: part of messages that are followed by another one in the same name, made by ``lie``.
        lie: from a message to the one that follows it.
        outage: times (s) from when to when robot 1 is dead: it neither speaks nor hears nor drives.
        stall: part of steps at which a robot's policy begins to take 0.3 s.
        clock_offset: half range of the robots' clocks (s).
    """

    radio: Faults = field(default_factory=Faults)
    lies: float = 0.0
    lie: Callable[[RobotState], RobotState] = lambda state: state
    outage: tuple[float, float] = (0.0, 0.0)
    stall: float = 0.0
    clock_offset: float = 0.0


def not_a_number(state: RobotState) -> RobotState:
    """A message without a position."""
    return replace(state, stamp=state.stamp + 0.01, position=(float("nan"), 0.0))


def huge(state: RobotState) -> RobotState:
    """A message of a robot that is everywhere at once."""
    return replace(state, stamp=state.stamp + 0.01, velocity=(1e5, -1e5), obstacle_distance=1e5)


def forged(state: RobotState) -> RobotState:
    """A message that puts a robot 1 m ahead of where it is; only its leap gives it away."""
    x, y = state.position
    return replace(state, stamp=state.stamp + 0.01, position=(x + 1.0, y))


def drives_back(state: RobotState) -> RobotState:
    """A message that nothing gives away: the place is right, and the speed is possible."""
    return replace(state, stamp=state.stamp + 0.01, velocity=(-1.0, 0.0))


CASES: dict[str, dict[float | str, Case]] = {
    "messages lost (%)": {p: Case(Faults(loss=p / 100)) for p in (0, 10, 30, 50, 70, 90, 100)},
    "delay (ms)": {d: Case(Faults(delay=d / 1000)) for d in (0, 100, 200, 300, 400, 600, 800)},
    "fault": {
        "30 % lost, 200 ms late": Case(Faults(loss=0.3, delay=0.2)),
        "half sent twice": Case(Faults(duplication=0.5)),
        "reordered: 0 to 300 ms late": Case(Faults(jitter=0.3)),
        "half followed by NaN": Case(lies=0.5, lie=not_a_number),
        "half followed by huge values": Case(lies=0.5, lie=huge),
        "half followed by a forged place": Case(lies=0.5, lie=forged),
        "half followed by a forged speed": Case(lies=0.5, lie=drives_back),
        "one robot dead from 2 to 4 s": Case(outage=(2.0, 4.0)),
        "steps of 0.3 s, 5 % of all": Case(stall=0.05),
        "clocks up to 1000 s off": Case(clock_offset=1000.0),
    },
}


class Team:
    """All robots of one team, each with a node of its own, and what goes wrong for them.

    Args:
        case: what does.
        policy: of one robot.
        n: number of robots.
        limits: of the pilots.
        dt: time step (s).
        seed: of the faults.
    """

    def __init__(self, case: Case, policy: RobotPolicy, n: int, limits: dict[str, float], dt: float, seed: int) -> None:
        self._case, self._dt, self._limits, self._random = case, dt, limits, random.Random(seed)
        self._policy = Stalls(policy, case.stall, self._random) if case.stall else policy
        self._radio = Radio(case.radio, seed)
        self._names = [f"robot_{i}" for i in range(n)]
        self._transports = [self._radio.join(name) for name in self._names]
        self._offsets = [case.clock_offset * self._random.uniform(-1, 1) for _ in self._names]
        self._nodes = [self._node(i) for i in range(n)]

    def step(self, rows: list[list[float]]) -> list[tuple[float, float]]:
        """Commands (m/s) of robots that see ``rows`` of 9 numbers; all have spoken before any listens."""
        begin, end = self._case.outage
        alive = [i != 1 or not begin <= self._radio.now < end for i in range(len(rows))]
        if begin <= self._radio.now < begin + self._dt and begin < end:
            self._transports[1].command(REST)
            self._nodes[1] = self._node(1)  # when it is back, it remembers nothing
        for i, row in enumerate(rows):
            if alive[i]:
                self._speak(i, row)
        for i, node in enumerate(self._nodes):
            if alive[i]:
                node.act()
        self._radio.now += self._dt
        return [(transport.commanded.forward, transport.commanded.left) for transport in self._transports]

    def _speak(self, i: int, row: list[float]) -> None:
        state = RobotState.of_observation(self._names[i], self._radio.now + self._offsets[i], row)
        self._transports[i].sensed = Sensed(state, heading=0.0)
        self._nodes[i].tell()
        if self._random.random() < self._case.lies:
            self._radio.send(self._names[i], self._case.lie(state))

    def _node(self, i: int) -> RobotNode:
        pilot = Pilot(self._names[i], self._names, self._policy, **self._limits)
        return RobotNode(self._transports[i], pilot, clock=lambda: self._radio.now)


class Stalls:
    """A policy that is late for three steps now and then, as :class:`redig.deploy.pilot.Deadline` reports it."""

    def __init__(self, policy: RobotPolicy, part: float, draw: random.Random) -> None:
        self._policy, self._part, self._draw = policy, part, draw
        self._late: dict[str, int] = {}

    def __call__(self, own: RobotState, neighbours: Sequence[RobotState]) -> ArrayLike:
        """The command, or ``TimeoutError``."""
        late = self._late.get(own.robot, 0)
        if late == 0 and self._draw.random() < self._part:
            late = 3
        self._late[own.robot] = max(late - 1, 0)
        if late:
            raise TimeoutError("a step of the policy takes longer than 0.1 s")
        return self._policy(own, neighbours)


def measure(case: Case, policy: RobotPolicy, arguments: Arguments, seed: int) -> dict[str, float]:
    """Metrics of the teams of one seed."""
    _, scenario = read_header(arguments.scenario)
    env = make_env(arguments.starts, **scenario)
    world = env.scenario
    limits = {"max_speed": world.max_speed, "goal_radius": world.goal_radius}
    teams = [
        Team(case, policy, world.n_robots, limits, world.dt, seed=1000 * seed + team)
        for team in range(arguments.starts)
    ]

    def act(observation: Tensor) -> Tensor:
        return torch.tensor([team.step(rows) for team, rows in zip(teams, observation.tolist(), strict=True)])

    return evaluate(TensorDictModule(act, [OBSERVATION], [ACTION]), env, seed=arguments.first_seed + seed)


def main(arguments: Arguments) -> list[dict[str, str]]:
    """Measure all cases that ``faults.csv`` does not have yet, add them to it, and draw ``faults.png``."""
    logging.getLogger("redig").setLevel(logging.CRITICAL)  # thousands of robots report their faults
    policy, file = RobotPolicy(arguments.policy), arguments.out / "faults.csv"
    rows = read(file)
    done = {(row["sweep"], row["value"], row["seed"]) for row in rows}
    for seed in range(arguments.seeds):
        for sweep, cases in CASES.items():
            for value, case in cases.items():
                point = {"sweep": sweep, "value": str(value), "seed": str(seed)}
                if tuple(point.values()) in done:
                    continue
                metrics = measure(case, policy, arguments, seed)
                rows.append(
                    {**point, "starts": str(arguments.starts), **{rate: f"{metrics[rate]:.4f}" for rate in RATES}}
                )
                print(*rows[-1].values(), flush=True)
                write_csv(file, rows)
    save_figure(draw(rows), arguments.out / "faults.png")
    return rows


def read(file: Path) -> list[dict[str, str]]:
    """What has been measured before."""
    if not file.is_file():
        return []
    with open(file, newline="") as lines:
        return list(csv.DictReader(lines))


def draw(rows: Sequence[dict[str, str]]) -> Figure:
    """Success over loss and over delay, and for each of the other faults; bars and bands span the seeds."""
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(1, 1.2))
    for place, (sweep, cases) in zip((grid[0, 0], grid[0, 1], grid[1, :]), CASES.items(), strict=True):
        axes = figure.add_subplot(place)
        mine = [row for row in rows if row["sweep"] == sweep]
        measured = [value for value in cases if any(row["value"] == str(value) for row in mine)]
        for number, (rate, label) in enumerate(zip(RATES, ("robots", "whole teams"), strict=True)):
            values = [[float(row[rate]) for row in mine if row["value"] == str(value)] for value in measured]
            middle = [statistics.mean(at) for at in values]
            spread = [[m - min(at) for m, at in zip(middle, values, strict=True)]]
            spread += [[max(at) - m for m, at in zip(middle, values, strict=True)]]
            if sweep == "fault":
                bars(axes, number, middle, spread, label)
            else:
                places = [float(value) for value in measured]
                axes.errorbar(
                    places, middle, spread, color=PALETTE[number], marker="os"[number], ms=4, capsize=2, label=label
                )
        if sweep == "fault":
            axes.set_yticks(range(len(measured)), measured, size=8)  # type: ignore[arg-type]
            axes.invert_yaxis()
            axes.set_xlim(0, 1.03)
            axes.set_xlabel("success rate", size=9)
        else:
            axes.set_ylim(-0.03, 1.03)
            axes.set_xlabel(sweep, size=9)
            axes.set_ylabel("success rate", size=9)
            axes.legend(fontsize=8, frameon=False, loc="lower left")
        axes.tick_params(labelsize=8)
    return figure


def bars(axes: Axes, number: int, middle: list[float], spread: list[list[float]], label: str) -> None:
    """One of two bars for each fault."""
    places = [i + 0.4 * (number - 0.5) for i in range(len(middle))]
    axes.barh(places, middle, 0.38, xerr=spread, color=PALETTE[number], label=label, error_kw={"linewidth": 0.8})


if __name__ == "__main__":
    main(tyro.cli(Arguments))
