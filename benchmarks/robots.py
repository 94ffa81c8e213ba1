"""Five robots as five processes: rates held and latencies of the shipped policy, ``python benchmarks/robots.py``.

Each process (``robot_process.py``) has a policy of its own, acts on every tick of its clock on its own state and what
four neighbours sent, and sleeps in between. Latency counts from the tick, so it includes waiting for a core.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from harness import report

from redig.deploy import export_policy
from redig.policy import load_policy, read_header, save_policy


@dataclass
class Arguments:
    """Run a team of processes for each number of steps and each kind of policy file."""

    policy: Path = Path("recipes/policies/wedge.safetensors")
    """The policy file."""
    steps: tuple[int, ...] = (100, 5)
    """Steps of the chain (DDPM without noise)."""
    rates: tuple[float, ...] = (20.0, 100.0)
    """Wanted rates (Hz), one for each of the steps."""
    kinds: tuple[str, ...] = ("onnx", "safetensors")
    """Kinds of policy files."""
    robots: int = 5
    """Processes at a time."""
    seconds: float = 20.0
    """Length of each run."""
    out: Path = Path("docs/results/robots")
    """Folder for the table."""


def main(arguments: Arguments) -> list[dict[str, Any]]:
    """Write both files for each number of steps, run the teams, report what there is after each."""
    notes = [
        f"{arguments.robots} processes at once, {arguments.seconds:g} s each, {arguments.policy}, DDPM without noise, "
        f"own state and four neighbours, on {len(os.sched_getaffinity(0))} cores. Of the robots the worst: the lowest "
        "rate, the highest of all else; p50 and processor time are medians over the robots. Latency counts from the "
        "tick, waiting for a core included; late: not done before the next tick. Start: loading the file and the first "
        "action, after the imports.",
        "Load before: processes that wanted a core in the minute before, of other work on the machine.",
    ]
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for steps, rate in zip(arguments.steps, arguments.rates, strict=True):
            files = write_files(arguments.policy, steps, Path(folder))
            for kind in arguments.kinds:
                load = os.getloadavg()[0]
                robots = run_team(arguments, files[kind], rate)
                rows.append({"file": kind, "steps": steps, "wanted (Hz)": rate, **worst(robots), "load before": load})
                report(arguments.out, "rates", rows, notes, threads=1)
    return rows


def write_files(policy: Path, steps: int, folder: Path) -> dict[str, Path]:
    """The policy with a chain of so many steps, in both forms."""
    config, environment = read_header(policy)
    config = replace(config, sampler="ddpm", sampling_steps=steps, noise_ratio=0.0, early_stop=None)
    files = {"onnx": folder / f"{steps}.onnx", "safetensors": folder / f"{steps}.safetensors"}
    save_policy(files["safetensors"], load_policy(policy), config, environment)
    export_policy(load_policy(files["safetensors"]), files["onnx"], config, environment, ego=True)
    return files


def run_team(arguments: Arguments, path: Path, rate: float) -> list[dict[str, float]]:
    """What each of the processes measured."""
    command = [sys.executable, str(Path(__file__).with_name("robot_process.py")), str(path)]
    command += [str(number) for number in (rate, arguments.seconds)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    robots = [subprocess.Popen(command, env=environment, **pipes) for _ in range(arguments.robots)]
    if not all([robot.stdout.readline() for robot in robots]):
        raise RuntimeError("robot_process.py: a process ended before it was ready; its error is above")
    for robot in robots:
        robot.stdin.write("go\n")
        robot.stdin.flush()
    return [json.loads(robot.communicate()[0]) for robot in robots]


def worst(robots: list[dict[str, float]]) -> dict[str, float]:
    """One row for a team."""
    choose = {"rate (Hz)": min, "p50 (ms)": statistics.median, "cpu (ms/action)": statistics.median}
    return {name: float(choose.get(name, max)([robot[name] for robot in robots])) for name in robots[0]}


if __name__ == "__main__":
    main(tyro.cli(Arguments))
