"""Samplers of trained policies, side by side: ``python recipes/samplers.py recipes/policies/wedge.safetensors``.

Writes ``samplers.csv`` and ``smoothness.csv``, one row a policy and setting, and the tables of ``docs/samplers.md``.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from evaluate import load_critics, with_memory
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from redig.envs.factory import make_env
from redig.envs.seeding import preserve_rng_state
from redig.evaluation import evaluate
from redig.files import replacing, write_csv
from redig.modules import DDIM, DDPM, BestOfN, DPMSolver, Sampler
from redig.policy import load_policy, read_header

STEPS = (1, 2, 3, 5, 10, 20, 100)
FIGURES = ("success_rate", "team_success_rate", "travel_time", "cfi_0.5", "jerk_mean", "jerk_peak")
RANDOM, DETERMINISTIC = ExplorationType.RANDOM, ExplorationType.DETERMINISTIC


@dataclass
class Arguments:
    """Measure every sampler at every number of steps, and the ways to a smoother motion, with the same weights."""

    policies: Annotated[list[Path], tyro.conf.Positional]
    """Policy files; the tables give mean and standard deviation over them."""
    out: Path = Path("samplers")
    """Folder for the tables."""
    starts: int = 256
    """Starts of each evaluation."""
    seed: int = 2_000_000
    """Seed of the starts."""
    critics: list[Path] | None = None
    """The run of each policy, for best-of-N; left out without."""
    max_steps: int = 200
    """Steps after which a team that has not arrived has failed."""


def main(arguments: Arguments) -> None:
    """Measure and write both tables."""
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, settings in (("samplers", sampler_settings), ("smoothness", smoothness_settings)):
        rows = []
        for i, path in enumerate(arguments.policies):
            critics = arguments.critics[i] if arguments.critics else None
            for label, options in tqdm(list(settings(critics)), desc=f"{name}, {path.name} {i + 1}"):
                rows.append({"policy": i, **label, **measure(arguments, path, **options)})
        write(arguments.out / name, rows, keys=list(label))


def sampler_settings(critics: Path | None) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """All samplers as a robot would use them: from a zero latent, without noise."""
    kinds: dict[str, Callable[[int], Sampler]] = {
        "DDPM, noise 0": lambda steps: DDPM(steps, noise_ratio=0),
        "DDIM": DDIM,
        "DPM-Solver++(2M)": DPMSolver,
    }
    for kind, make in kinds.items():
        for steps in STEPS:
            yield {"sampler": kind, "steps": steps}, {"sampler": make(steps), "compare": True}


def smoothness_settings(critics: Path | None) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Where the randomness of the action comes from, and what a robot keeps from step to step."""
    yield {"setting": "DDPM 5, zero latent, noise 0"}, {"sampler": DDPM(5, 0), "kind": DETERMINISTIC}
    yield {"setting": "DDPM 5, fixed latent, noise 0"}, {"sampler": DDPM(5, 0), "fixed_latent": True}
    for noise in (0.0, 0.5, 1.0):
        for steps in (5, 100):
            yield {"setting": f"DDPM {steps}, random latent, noise {noise}"}, {"sampler": DDPM(steps, noise)}
    yield {"setting": "DDIM 5, random latent"}, {"sampler": DDIM(5)}
    yield {"setting": "DDIM 5, fixed latent"}, {"sampler": DDIM(5), "fixed_latent": True}
    for kind, latent in ((DETERMINISTIC, "zero"), (RANDOM, "random")):
        for step in (19, 39, 59, 79):
            yield (
                {"setting": f"DDPM 20, {latent} latent, noise 0, warm start at {step}"},
                {"sampler": DDPM(20, 0), "kind": kind, "warm_start": step},
            )
    if critics is not None:
        for n in (4, 32):
            yield (
                {"setting": f"DDPM 5, random latent, noise 1.0, best of {n} by min Q"},
                {"sampler": DDPM(5, 1.0), "best_of_n": n, "critics": critics},
            )


def measure(
    arguments: Arguments,
    path: Path,
    sampler: Sampler,
    kind: ExplorationType | None = None,
    compare: bool = False,
    best_of_n: int = 1,
    critics: Path | None = None,
    **memory: Any,
) -> dict[str, float]:
    """Metrics of one setting; with ``compare`` also the distance to the full chain and the time of an action."""
    _, scenario = read_header(path)
    env = make_env(arguments.starts, **{**scenario, "max_steps": arguments.max_steps})
    policy = load_policy(path, sampler=sampler, **memory)
    driver: Any = policy if critics is None else BestOfN(policy, load_critics(critics), best_of_n)
    kind = kind or (DETERMINISTIC if compare else RANDOM)
    metrics = evaluate(driver, with_memory(env, policy), seed=arguments.seed, exploration_type=kind)
    figures = {name: metrics[name] for name in FIGURES}
    if compare:
        states = states_of(path, arguments.seed)
        full = load_policy(path, sampler=DDPM(noise_ratio=0))
        figures["action_error"] = (act(policy, states) - act(full, states)).norm(dim=-1).square().mean().sqrt().item()
        figures["latency_ms"] = latency(policy, states[:1])
    return figures


@cache
def states_of(path: Path, seed: int) -> Tensor:
    """Observations ``[N, n, F]`` that teams meet on their way, driven as the policy was trained."""
    _, scenario = read_header(path)
    env = make_env(16, **scenario)
    with preserve_rng_state(), torch.no_grad(), set_exploration_type(DETERMINISTIC):
        env.set_seed(seed)
        return env.rollout(60, load_policy(path))["agents", "observation"].flatten(0, 1)


def act(policy: TensorDictSequential, states: Tensor) -> Tensor:
    """Deterministic actions ``[N, n, 2]`` (m/s)."""
    with torch.no_grad(), set_exploration_type(DETERMINISTIC):
        return policy(TensorDict({"agents": {"observation": states}}, states.shape[:1]))["agents", "action"]


def latency(policy: TensorDictSequential, state: Tensor, repeats: int = 30) -> float:
    """Median time of an action of the whole team, observation to command (ms), on one thread."""
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        act(policy, state)
        times.append(1e3 * (time.perf_counter() - started))
    return statistics.median(times)


def write(path: Path, rows: list[dict[str, Any]], keys: list[str]) -> None:
    """The rows as CSV, and their mean and standard deviation over policies as a Markdown table."""
    write_csv(path.with_suffix(".csv"), rows)
    columns = [name for name in rows[0] if name not in ("policy", *keys)]
    groups: dict[tuple, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    lines = [f"| {' | '.join([*keys, *columns])} |", "|" + "---|" * (len(keys) + len(columns))]
    for key, group in groups.items():
        cells = [cell([row[name] for row in group]) for name in columns]
        lines.append(f"| {' | '.join([*map(str, key), *cells])} |")
    with replacing(path.with_suffix(".md")) as file:
        file.write_text("\n".join(lines) + "\n")


def cell(values: list[float]) -> str:
    """Mean, and standard deviation where there are several values."""
    mean = statistics.fmean(values)
    if math.isnan(mean):
        return "-"
    return f"{mean:.3f}" + (f" ± {statistics.stdev(values):.3f}" if len(values) > 1 else "")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
