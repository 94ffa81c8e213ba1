"""Control rate of the shipped policy, from observation to action, and what fewer steps cost: ``benchmarks/control.py``.

For each number of steps of DDPM without noise: actions of the whole team by the module and by the exported policy, and
of one robot that has heard its four neighbours (exported with ``ego``), in actions per second of one thread; then the
metrics of teams that the exported policy drives, beside those of the 100-step chain.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from harness import alternate, report
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.deploy import ExportedPolicy, export_policy, load_policy
from redig.envs.factory import make_env
from redig.evaluation import evaluate
from redig.modules import DDPM
from redig.policy import ACTION, OBSERVATION, read_header
from redig.policy import load_policy as load_module

FIGURES = ("success_rate", "team_success_rate", "travel_time", "cfi_0.5", "jerk_mean")
TEAM, ROBOT = "team, exported", "robot, exported"


@dataclass
class Arguments:
    """Time and drive the policy with several numbers of steps."""

    policy: Path = Path("recipes/policies/wedge.safetensors")
    """The policy file."""
    steps: tuple[int, ...] = (100, 10, 5, 3, 2)
    """Steps of the chain; the first is what the others are compared with."""
    starts: int = 256
    """Starts of each drive; 0: only timing."""
    seed: int = 2_000_000
    """Seed of the starts."""
    repeats: int = 20
    """Repetitions of each timing."""
    threads: int = 1
    """Threads."""
    out: Path = Path("docs/results/speed")
    """Folder for the tables."""


def main(arguments: Arguments) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Export, time in turn, drive; two tables."""
    torch.set_num_threads(arguments.threads)
    policies = {steps: load_module(arguments.policy, sampler=DDPM(steps, 0.0)) for steps in arguments.steps}
    exported = {
        (steps, form): through_a_file(policy, form == ROBOT, arguments.threads)
        for steps, policy in policies.items()
        for form in (TEAM, ROBOT)
    }
    rates = time_them(arguments, policies, exported)
    quality = []
    if arguments.starts:
        for steps in arguments.steps:
            metrics = drive(arguments, exported[steps, TEAM])
            quality.append({"steps": steps, **{name: metrics[name] for name in FIGURES}})
        quality = [beside(row, quality[0]) for row in quality]
        note = (
            f"{arguments.starts} starts of seed {arguments.seed:,}, driven by the exported policy, {arguments.policy}; "
            f"the last three columns: against {arguments.steps[0]} steps."
        )
        report(arguments.out, "control_quality", quality, [note], arguments.threads)
    return rates, quality


def through_a_file(policy: TensorDictSequential, ego: bool, threads: int) -> ExportedPolicy:
    """The policy as a robot has it."""
    with tempfile.TemporaryDirectory() as folder:
        export_policy(policy, f"{folder}/policy.onnx", ego=ego)
        return load_policy(f"{folder}/policy.onnx", threads=threads)


def time_them(
    arguments: Arguments,
    policies: dict[int, TensorDictSequential],
    exported: dict[tuple[int, str], ExportedPolicy],
) -> list[dict[str, Any]]:
    """Rates of the module and both exported forms, on the state of a team at its start."""
    _, scenario = read_header(arguments.policy)
    observation = make_env(1, seed=arguments.seed, **scenario).reset()[OBSERVATION]
    array = observation[0].numpy()
    calls: dict[tuple[int, str], Any] = {}
    for steps, policy in policies.items():
        calls[steps, "team, module"] = lambda policy=policy: act(policy, observation)
        for form in (TEAM, ROBOT):
            calls[steps, form] = lambda robots=exported[steps, form]: robots(array)
    largest = max(np.abs(calls[k, TEAM]() - calls[k, "team, module"]()[0].numpy()).max() for k in policies)
    if not largest < 1e-5:
        raise RuntimeError(f"actions differ by {largest}")
    timings = alternate({f"{steps} {form}": call for (steps, form), call in calls.items()}, arguments.repeats, 0.05)
    rows = []
    for steps in policies:
        row: dict[str, Any] = {"steps": steps}
        for form in ("team, module", TEAM, ROBOT):
            timing = timings[f"{steps} {form}"]
            row |= {f"{form} (Hz)": round(1 / timing.median), f"{form}, first call (ms)": 1e3 * timing.first}
        rows.append(row)
    notes = [
        f"Observation to action, encoder included, {arguments.policy}, DDPM without noise from a zero latent: the team "
        f"of {len(array)}, or one robot given its own observation and those of {len(array) - 1} neighbours. Medians of "
        f"{arguments.repeats} repetitions in alternation. The exported team's actions differ from the module's by at "
        f"most {largest:.1e} m/s.",
        "First call: of the timing, after the one that compares the actions.",
    ]
    report(arguments.out, "control", rows, notes, arguments.threads)
    return rows


def act(policy: TensorDictSequential, observation: Tensor) -> Tensor:
    """Deterministic actions of the module."""
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return policy(TensorDict({"agents": {"observation": observation}}, observation.shape[:1]))[ACTION]


def drive(arguments: Arguments, robots: ExportedPolicy) -> dict[str, float]:
    """Metrics of teams that the exported policy drives."""
    _, scenario = read_header(arguments.policy)
    driver = TensorDictModule(lambda state: torch.from_numpy(robots(state.numpy())), [OBSERVATION], [ACTION])
    return evaluate(driver, make_env(arguments.starts, **scenario), seed=arguments.seed)


def beside(row: dict[str, Any], reference: dict[str, Any]) -> dict[str, Any]:
    """A row with its distance to the reference: success in points, CFI and jerk in percent."""
    return {
        **row,
        "success (points)": 100 * (row["success_rate"] - reference["success_rate"]),
        "CFI (%)": 100 * (row["cfi_0.5"] / reference["cfi_0.5"] - 1),
        "jerk (%)": 100 * (row["jerk_mean"] / reference["jerk_mean"] - 1),
    }


if __name__ == "__main__":
    main(tyro.cli(Arguments))
