"""Collection of experience: what the policy costs beside the simulator, from one team to thousands.

Run ``python benchmarks/collection.py``. A frame is one step of one team. Every collector is TorchRL's, with teams in
all phases of an episode, so that the share of resets is that of a long run.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from harness import alternate, ratio, report
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, StepCounter, TransformedEnv, VmasEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import AdditiveGaussianModule

sys.path.append(str(Path(__file__).resolve().parents[1] / "recipes"))
from config import Config
from redig_wedge import policy_architecture

from redig.envs.factory import make_env
from redig.policy import ACTION, OBSERVATION, build_policy, load_policy

MAX_STEPS = 200  # of an episode, as the recipe has it
POLICY = Path(__file__).resolve().parents[1] / "recipes" / "policies" / "wedge.safetensors"


@dataclass
class Arguments:
    """Compare collectors with our policy, with random actions, and of VMAS's own navigation scenario."""

    num_envs: tuple[int, ...] = (1, 8, 64, 256, 1024, 4096)
    """Numbers of teams simulated in parallel."""
    repeats: int = 3
    """Repetitions of each collector."""
    policy: Path = POLICY
    """Policy file, driven beside an untrained policy of the recipe's architecture."""
    threads: int = 1
    """Threads of PyTorch."""
    out: Path = Path("docs/results/speed")
    """Folder for the tables."""


def main(arguments: Arguments) -> list[dict[str, Any]]:
    """Measure and write ``collection.csv`` and ``collection.md``."""
    torch.set_num_threads(arguments.threads)
    rows = [row for n in arguments.num_envs for row in measure(n, arguments.policy, arguments.repeats)]
    notes = [
        "A frame is one step of one team of five robots. `policy share` is one minus the time of a step with random "
        "actions over the time with the policy, in alternation: the policy with its exploration noise, and what it "
        "adds in the collector. `policy alone` is a call of the policy outside the collector, over the same time. "
        "`ms a reset` is the time of a team's own, where an eighth of the teams start again; a step contains one for "
        "every 200 teams.",
        f"TorchRL's Collector, 20 steps a batch up to 128 teams and down to 5 from 512 on; medians of "
        f"{arguments.repeats} batches, after two; episodes of {MAX_STEPS} steps, begun at random times.",
    ]
    report(arguments.out, "collection", rows, notes, arguments.threads)
    return rows


def measure(
    num_envs: int, policy: Path = POLICY, repeats: int = 3, device: torch.device | str = "cpu"
) -> list[dict[str, Any]]:
    """One row for each collector over ``num_envs`` teams."""
    steps = min(20, max(5, 2560 // num_envs))
    envs = [recipe_env(num_envs, device) for _ in range(3)]
    untrained = build_policy(policy_architecture(Config(), envs[0].observation_spec[OBSERVATION].shape[-1]))
    policies = {
        "policy, untrained": with_noise(untrained, envs[0]),
        "policy, trained": with_noise(load_policy(policy), envs[1]),
    }
    collectors = {name: (env, behaviour) for (name, behaviour), env in zip(policies.items(), envs, strict=False)}
    collectors["random actions"] = (envs[2], None)
    collectors["VMAS navigation, random actions"] = (vmas_navigation(num_envs, device), None)
    observed = envs[2].reset()
    timings = alternate(
        {name: collection(*parts, steps) for name, parts in collectors.items()}
        | {f"{name}, alone": action(behaviour, observed) for name, behaviour in policies.items()},
        repeats,
    )
    rows = []
    for name, (env, _) in collectors.items():
        timing = timings[name]
        seconds = timing.median / steps
        row = {"envs": num_envs, "collector": name, "ms a step": 1e3 * seconds, "frames/s": num_envs / seconds}
        row["ms a reset"] = 1e3 * seconds_a_reset(env)
        if name in policies:
            row["policy share"] = 1 - ratio(timings["random actions"], timing)
            row["policy alone"] = ratio(timings[f"{name}, alone"], timing) * steps
        rows.append(row)
    return rows


def recipe_env(num_envs: int, device: torch.device | str) -> EnvBase:
    """The environment that the recipe trains in."""
    config = Config().resolve()
    return make_env(num_envs, max_steps=MAX_STEPS, device=device, reward_scale=config.reward_scale, **config.scenario())


def vmas_navigation(num_envs: int, device: torch.device | str) -> EnvBase:
    """VMAS's own scenario of the kind, with the same time limit."""
    env = VmasEnv("navigation", num_envs=num_envs, seed=0, device=device, n_agents=5)
    return TransformedEnv(env, StepCounter(MAX_STEPS))


def with_noise(policy: TensorDictSequential, env: EnvBase) -> TensorDictSequential:
    """The policy as the recipe explores with it."""
    noise = Config().exploration_noise
    return TensorDictSequential(
        policy.to(env.device), AdditiveGaussianModule(env.action_spec, noise, noise, action_key=ACTION)
    )


def collection(env: EnvBase, policy: Any, steps: int) -> Callable[[], TensorDictBase]:
    """A call that collects ``steps`` of all teams, which are in all phases of an episode."""
    collector = Collector(
        env,
        policy,
        frames_per_batch=env.batch_size.numel() * steps,
        total_frames=-1,
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=False,
    )
    batches = iter(collector)
    next(batches)
    collector._carrier["step_count"].random_(MAX_STEPS)

    def collect() -> TensorDictBase:
        return waited_for(next(batches))

    return collect


def waited_for(data: TensorDictBase) -> TensorDictBase:
    """The same data, once the device has finished."""
    if data.device is not None and data.device.type == "cuda":
        torch.cuda.synchronize(data.device)
    return data


def action(policy: TensorDictSequential, data: TensorDictBase) -> Callable[[], TensorDictBase]:
    """A call of the policy on the observations of all teams, outside the collector."""

    @torch.no_grad()
    def act() -> TensorDictBase:
        with set_exploration_type(ExplorationType.RANDOM):
            return waited_for(policy(data.copy()))

    return act


def seconds_a_reset(env: EnvBase, calls: int = 3) -> float:
    """Mean time of the reset of a team, where an eighth of them start again."""
    some = torch.zeros(*env.batch_size, 1, dtype=torch.bool, device=env.device)
    some[::8] = True
    data = env.reset()
    started = time.perf_counter()
    for _ in range(calls):
        waited_for(env.reset(data.copy().set("_reset", some)))
    return (time.perf_counter() - started) / calls / int(some.sum())


if __name__ == "__main__":
    main(tyro.cli(Arguments))
