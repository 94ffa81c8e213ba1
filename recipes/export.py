"""Export a policy for robots without torch: ``python recipes/export.py recipes/policies/wedge.safetensors``."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig import deploy
from redig.envs.factory import make_env
from redig.envs.seeding import preserve_rng_state
from redig.policy import build_sampler, load_policy, read_header


@dataclass
class Arguments:
    """Write an ONNX file, and say what it costs and how far its actions are from the module's."""

    policy: Annotated[Path, tyro.conf.Positional]
    """The policy file."""
    out: Path = Path("policy.onnx")
    """The file to write."""
    sampler: Literal["ddpm", "ddim", "dpmsolver"] | None = None
    """Another sampler than the one that the policy was trained with."""
    sampling_steps: int | None = None
    """Steps of that sampler."""
    eta: float | None = None
    """Noise of ddim, from 0 to 1; has an effect with --stochastic only."""
    noise_ratio: float | None = None
    """Noise of ddpm, from 0 to 1; has an effect with --stochastic only."""
    stochastic: bool = False
    """Take a random latent and the sampler's noise as inputs, instead of a zero latent and none."""
    ego: bool = False
    """Give the action of the first robot only."""
    threads: int = 1
    """Threads of both runtimes."""
    repeats: int = 300
    """Timed calls."""


def main(arguments: Arguments) -> dict[str, float]:
    """Export, measure and print."""
    torch.set_num_threads(arguments.threads)
    config, environment = read_header(arguments.policy)
    given = {name: getattr(arguments, name) for name in ("sampler", "sampling_steps", "eta", "noise_ratio")}
    config = replace(config, **{name: value for name, value in given.items() if value is not None})
    sampler = build_sampler(config.sampler, config.sampling_steps, config.noise_ratio, config.early_stop, config.eta)
    policy = load_policy(arguments.policy, sampler=sampler)
    observation = observations_of(arguments.policy)
    options = {"stochastic": arguments.stochastic, "ego": arguments.ego}

    figures: dict[str, float] = {}
    figures["export (s)"], _ = timed(
        lambda: deploy.export_policy(policy, arguments.out, config, environment, **options)
    )
    figures["size (kB)"] = arguments.out.stat().st_size / 1e3
    figures["load (s)"], robots = timed(lambda: deploy.load_policy(arguments.out, threads=arguments.threads, seed=0))
    team = observation[0]
    figures["first call (ms)"] = 1e3 * timed(lambda: robots(team))[0]
    latency = statistics.median(timed(lambda: robots(team))[0] for _ in range(arguments.repeats))
    figures["latency (ms)"], figures["rate (Hz)"] = 1e3 * latency, 1 / latency
    if not arguments.stochastic:
        difference = np.abs(robots(observation) - module_actions(policy, observation, arguments.ego))
        figures["largest difference to the module (m/s)"] = float(difference.max())
    print(f"{arguments.out}: {sampler}, {len(team)} robots, {arguments.threads} thread(s)")
    for name, value in figures.items():
        print(f"{name:<40} {value:.4g}")
    return figures


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds that a call takes, and its result."""
    started = time.perf_counter()
    result = call()
    return time.perf_counter() - started, result


def observations_of(path: Path, starts: int = 16, steps: int = 60) -> np.ndarray:
    """Observations ``[N, n, F]`` that teams meet on their way, driven by the policy as it was trained."""
    _, scenario = read_header(path)
    with preserve_rng_state(), torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        crossing = make_env(starts, **scenario).rollout(steps, load_policy(path))
    return crossing["agents", "observation"].flatten(0, 1).numpy()


def module_actions(policy: Any, observation: np.ndarray, ego: bool) -> np.ndarray:
    """Actions of the module that was exported."""
    data = TensorDict({"agents": {"observation": torch.from_numpy(observation)}}, [len(observation)])
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        action = policy(data)["agents", "action"].numpy()
    return action[:, 0] if ego else action


if __name__ == "__main__":
    main(tyro.cli(Arguments))
