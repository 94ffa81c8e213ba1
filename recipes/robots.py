"""Five robots as five processes over DDS, in a simulated world: ``python recipes/robots.py POLICY --domain-id 7``."""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tensordict.nn import TensorDictModule
from torch import Tensor

from redig.deploy.dds import DDSWorld
from redig.deploy.messages import RobotState
from redig.deploy.record import Recorder
from redig.deploy.transport import BodyVelocity, Sensed
from redig.envs.factory import make_env
from redig.evaluation import evaluate, format_table, write_metrics
from redig.policy import ACTION, OBSERVATION, read_header


@dataclass
class Arguments:
    """A world of point robots, and one ``redig-robot`` for each of them."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Policy file of the robots: .safetensors, or .onnx of one robot with --scenario."""
    domain_id: int
    """DDS domain, one that nobody else uses; with ROS 2, ROS_DOMAIN_ID."""
    scenario: Path | None = None
    """Policy file (.safetensors) of whose scenario the world is; default: the policy itself."""
    starts: int = 10
    """Number of starts, one after the other."""
    seed: int = 2_000_000
    """Seed of the first start; those that follow have the next ones."""
    speed: float = 1.0
    """How much faster than real time the world runs; the robots' rate and timeouts go with it."""
    rate: float = 50.0
    """Commands per simulated second of each robot (Hz)."""
    spawn: bool = True
    """Start the robots; --no-spawn: they are started by hand, or elsewhere."""
    record: Path | None = None
    """Record all starts in this MCAP file (needs redig[record])."""
    out: Path = Path("runs/robots")
    """Folder for metrics.json and the robots' logs."""


class RemoteTeam:
    """A policy whose robots are other processes: states go out, and after a time step the newest commands count.

    Args:
        world: that the robots are reached through.
        robots: their namespaces, in the order of the formation.
        step: real time from states to commands (s).
        watchdog: after which a robot without a command stands (s).
        recorder: of what the robots sense and are commanded.
    """

    def __init__(
        self, world: DDSWorld, robots: list[str], step: float, watchdog: float, recorder: Recorder | None = None
    ) -> None:
        self._world, self._robots, self._step, self._watchdog = world, robots, step, watchdog
        self._recorder = recorder
        self._commands: dict[str, tuple[float, BodyVelocity]] = {}
        self._goal = torch.zeros(0)
        self._due = 0.0

    def __call__(self, observation: Tensor) -> Tensor:
        """Commands ``[1, n, 2]`` (m/s) of robots that see ``observation`` ``[1, n, 9]``."""
        goal = observation[0, :, :2] + observation[0, :, 4:6]
        if self._goal.shape != goal.shape or not torch.allclose(goal, self._goal, atol=1e-3):
            self._new_start(goal)
        now = time.time()
        states = map(RobotState.of_observation, self._robots, repeat(now), observation[0].tolist())
        team = [Sensed(state, heading=0.0) for state in states]
        for sensed in team:
            self._world.publish(sensed)
        self._due = max(self._due + self._step, time.monotonic())
        time.sleep(max(self._due - time.monotonic(), 0))
        heard = time.monotonic()
        self._commands |= {robot: (heard, command) for robot, command in self._world.commands().items()}
        commands = [self._current(robot, heard) for robot in self._robots]
        if self._recorder is not None:
            for sensed, (forward, left) in zip(team, commands, strict=True):
                self._recorder.write(sensed, BodyVelocity(forward, left, 0.0))
        return torch.tensor([commands])

    def _current(self, robot: str, now: float) -> tuple[float, float]:
        at, command = self._commands.get(robot, (-float("inf"), BodyVelocity(0.0, 0.0, 0.0)))
        return (command.forward, command.left) if now - at <= self._watchdog else (0.0, 0.0)

    def _new_start(self, goal: Tensor) -> None:
        """Wait until the robots have forgotten the last start: from one to the next, they leap."""
        self._goal = goal
        time.sleep(4 * self._watchdog)
        self._world.commands()
        self._commands.clear()
        self._due = time.monotonic() + self._step


def main(arguments: Arguments) -> dict[str, float]:
    """Start the robots, let the team cross from each start, print and write the metrics."""
    _, scenario = read_header(arguments.scenario or arguments.policy)
    env = make_env(1, **scenario)
    robots = [f"robot_{i}" for i in range(env.scenario.n_robots)]
    arguments.out.mkdir(parents=True, exist_ok=True)
    step, watchdog = env.scenario.dt / arguments.speed, 0.5 / arguments.speed
    world = DDSWorld(robots, domain_id=arguments.domain_id)
    with ExitStack() as stack:
        if arguments.spawn:
            for robot in robots:
                stack.enter_context(Robot(arguments, robot, robots))
        wait_for(world, robots)
        recorder = None if arguments.record is None else stack.enter_context(Recorder(arguments.record))
        team = RemoteTeam(world, robots, step, watchdog, recorder)
        policy = TensorDictModule(team, [OBSERVATION], [ACTION])
        metrics = evaluate(policy, env, seed=arguments.seed, num_starts=arguments.starts)
    world.close()
    print(format_table(metrics))
    write_metrics(arguments.out / "metrics.json", metrics)
    return metrics


def wait_for(world: DDSWorld, robots: list[str], seconds: float = 600.0) -> None:
    """Until each robot has been heard.

    Raises:
        TimeoutError: naming those that are not.
    """
    end, silent = time.monotonic() + seconds, set(robots)
    while silent:
        if time.monotonic() > end:
            raise TimeoutError(f"no command from {', '.join(sorted(silent))} in {seconds:g} s; their logs may say why")
        time.sleep(0.05)
        silent -= set(world.commands())


class Robot:
    """The process of one robot, as a context: started on entry, told to stop on exit."""

    def __init__(self, arguments: Arguments, robot: str, robots: list[str]) -> None:
        options: dict[str, object] = {
            "policy": arguments.policy,
            "namespace": robot,
            "domain-id": arguments.domain_id,
            "rate": arguments.rate * arguments.speed,
            "neighbour-timeout": 0.5 / arguments.speed,
            "own-timeout": 0.3 / arguments.speed,
        }
        self._command = [sys.executable, "-m", "redig.deploy.command", "--neighbours", *robots]
        for name, value in options.items():
            self._command += [f"--{name}", str(value)]
        self._log = arguments.out / f"{robot}.log"

    def __enter__(self) -> Robot:
        with open(self._log, "w") as log:
            self._process = subprocess.Popen(self._command, stdout=log, stderr=log)
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            code = self._process.wait(timeout=60)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        if code != 0:
            print(f"{self._log.stem} has failed; see {self._log}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
