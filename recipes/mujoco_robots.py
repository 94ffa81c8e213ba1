"""Robots in MuJoCo, each driven by a process over DDS: ``python recipes/mujoco_robots.py POLICY --domain-id 7``."""

from __future__ import annotations

import signal
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from evaluate import draw_team
from robots import Arguments as WorldArguments
from robots import Robot, wait_for
from tensordict import TensorDict

from redig.deploy.dds import DDSWorld
from redig.deploy.record import Recorder
from redig.envs.factory import make_env
from redig.envs.map_batch import map_at
from redig.envs.navigation import FormationNavigation
from redig.evaluation import format_table, mean_metrics, team_metrics, write_metrics
from redig.physics import PhysicsWorld
from redig.physics.live import LiveTeam
from redig.physics.navigation import boxes
from redig.policy import read_header

TICK = 0.02  # s of physics between two states
SILENCE = 2.0  # s before a start, in which robots forget where the others were at the end of the last one


@dataclass
class Arguments(WorldArguments):
    """One process owns the physics; one ``redig-robot`` for each robot drives it, knowing its own state and what its
    neighbours say. Starts, goals, ends and metrics are those of recipes/mujoco_crossing.py with as many starts.
    """

    rate: float = 20.0
    """Commands per simulated second of each robot (Hz)."""
    drive: str = "limo"
    """Drive of the robots, see redig-robot --help; it must be one with wheels."""
    pace: float = 1.0
    """Drive in slow motion, see redig-robot --help."""
    max_angular: float | None = None
    """Fastest turn (rad/s); default: that of the drive, 1 rad/s of the Limo's."""
    out: Path = Path("runs/mujoco-robots")
    """Folder for metrics.json, pictures and the robots' logs."""


class WheeledRobot(Robot):
    """The process of one robot with wheels."""

    def __init__(self, arguments: Arguments, robot: str, robots: list[str]) -> None:
        super().__init__(arguments, robot, robots)
        self._command += ["--drive", arguments.drive, "--deadline", str(0.1 / arguments.speed)]
        self._command += ["--pace", str(arguments.pace)]
        if arguments.max_angular is not None:
            self._command += ["--max-angular", str(arguments.max_angular)]


def cross(
    team: LiveTeam,
    scenario: FormationNavigation,
    start: int,
    speed: float,
    recorder: Recorder | None = None,
    max_steps: int = 200,
) -> TensorDict:
    """One start in real time, over ``speed``: a trajectory ``[1, T]`` as of ``rollout_trajectories``, and ``late`` (s).

    ``late`` is how far the world was behind its clock at most; then it was slower than it should have been.
    """
    position = scenario._positions()[start].numpy()
    goal = scenario.goal[start].numpy()
    ahead = goal - position
    time.sleep(SILENCE / speed)
    team.reset(position, np.arctan2(ahead[:, 1], ahead[:, 0]), goal, time.time())
    due, late = time.monotonic(), 0.0
    arrived, held = np.zeros(team.world.n_robots, bool), 0
    samples = [(team.world.position, team.world.velocity, arrived, np.zeros_like(arrived))]
    record(recorder, team)
    while held < scenario.hold_steps and len(samples) <= max_steps:
        collision = np.zeros_like(arrived)
        for _ in range(round(scenario.dt / TICK)):
            due += TICK / speed
            time.sleep(max(due - time.monotonic(), 0.0))
            late = max(late, time.monotonic() - due)
            team.step(TICK, time.time())
            collision |= team.world.wall_contact | team.world.robot_contact
        near = np.linalg.norm(goal - team.world.position, axis=-1) < scenario.goal_radius
        arrived = arrived | near
        held = held + 1 if arrived.all() else 0
        samples.append((team.world.position, team.world.velocity, arrived, collision))
        record(recorder, team)
    keys = ("position", "velocity", "arrived", "collision")
    fields = {k: torch.as_tensor(np.stack(v)[None]) for k, v in zip(keys, zip(*samples, strict=True), strict=True)}
    fields |= {k: fields[k].float() for k in ("position", "velocity")}
    mask = torch.ones(1, len(samples), dtype=torch.bool)
    return TensorDict({**fields, "mask": mask, "late": torch.full_like(mask, late, dtype=torch.float32)}, mask.shape)


def record(recorder: Recorder | None, team: LiveTeam) -> None:
    """Where the robots are, and what they are commanded, into the recording if there is one."""
    if recorder is not None:
        for sensed, command in zip(team.sensed(time.time()), team.commands, strict=True):
            recorder.write(sensed, command)


def main(arguments: Arguments) -> dict[str, float]:
    """Start the robots, let the team cross from each start, print and write the metrics."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the robots must stop with their world
    _, options = read_header(arguments.scenario or arguments.policy)
    env = make_env(arguments.starts, **options)
    env.set_seed(arguments.seed)
    env.reset()
    scenario: FormationNavigation = env.scenario
    robots = [f"robot_{i}" for i in range(scenario.n_robots)]
    arguments.out.mkdir(parents=True, exist_ok=True)
    network = DDSWorld(robots, domain_id=arguments.domain_id)
    obstacle_map = boxes(map_at(scenario.obstacle_map, 0))
    world = PhysicsWorld(obstacle_map, scenario.n_robots)
    smoothing = scenario.direction_smoothing
    team = LiveTeam(world, obstacle_map, robots, network, direction_smoothing=smoothing)
    runs = []
    with ExitStack() as stack:
        if arguments.spawn:
            for robot in robots:
                stack.enter_context(WheeledRobot(arguments, robot, robots))
        wait_for(network, robots, seconds=300.0)
        recorder = None if arguments.record is None else stack.enter_context(Recorder(arguments.record))
        for start in range(arguments.starts):
            runs.append(cross(team, scenario, start, arguments.speed, recorder))
            print(f"start {start}: {runs[-1]['arrived'][0, -1].sum()} arrived", flush=True)
    network.close()
    metrics = mean_metrics([team_metrics(run, scenario) for run in runs])
    metrics |= {
        "times_real_time": arguments.speed,
        "late": max(run["late"].max().item() for run in runs),
    }
    print(format_table(metrics))
    write_metrics(arguments.out / "metrics.json", metrics)
    first = runs[0]["position"][0]
    draw_team(arguments.out / "crossing.mp4", first, scenario.formation, obstacle_map, scenario.goal[0])
    return metrics


if __name__ == "__main__":
    main(tyro.cli(Arguments))
