"""Which error dominates when a run goes wrong: ``python recipes/theory.py``, explained in docs/theory.md.

Short runs, each spoiled in one way, are measured with the terms of Theorems 1 and 2, :mod:`redig.evaluation`. Each
clones demonstrations and then trains critics and actor on them offline; nothing is simulated after the demonstrations.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from config import Config
from redig_wedge import copy_to_targets, make_loss, make_optimizers, policy_architecture, transitions
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from theory_plot import draw
from torch import Tensor
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from redig.envs.factory import make_env
from redig.evaluation import (
    algorithmic_error,
    bellman_residual,
    coverage,
    discretization_error,
    discretization_term,
    matching_divergence,
    matching_error,
    prior_mismatch,
    prior_mismatch_floor,
)
from redig.files import replacing, write_csv
from redig.modules import DDIM, DDPM, NoiseSchedule
from redig.modules.samplers import Denoise
from redig.objectives import DIPOLoss, MultiStep
from redig.planning import demonstrations
from redig.policy import ACTION, EMBEDDING, OBSERVATION, build_policy

Rows = list[dict[str, float | str]]
REWARD, ACTIVE = ("next", "agents", "reward"), ("agents", "active")
MODE, MASS, WIDTH = 0.8, 0.8, 0.05  # actions near +0.8 with probability 0.8, else near -0.8: left or right of something


@dataclass
class Arguments:
    """Measure the terms of Theorems 1 and 2 on runs that go wrong in different ways, and draw them."""

    out: Path = Path("runs/theory")
    """Folder for the CSV files."""
    figure: Path | None = None
    """The figure; default: theory.png in the folder."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of weights and batches; demonstrations are the same for all."""
    trajectories: int = 1000
    """Demonstrations, of single robots; a fifth is held out for measuring."""
    clone_updates: int = 400
    """Updates of cloning."""
    updates: int = 200
    """Updates of the critics afterwards, and half as many of the actor."""
    hidden: int = 128
    """Width of the hidden layers of denoiser and critics."""
    samples: int = 20_000
    """Samples of the chain with the exact score."""
    num_steps: tuple[int, ...] = (5, 10, 20, 50, 100, 200, 500, 1000)
    """K for which schedules are compared."""
    smoke: bool = False
    """Do everything at toy size."""
    threads: int | None = None
    """Threads of PyTorch; default: its own choice."""


SMOKE = {
    "seeds": (0,), "trajectories": 40, "clone_updates": 20, "updates": 20, "hidden": 16, "samples": 200,
    "num_steps": (5, 20),
}  # fmt: skip


def failures(arguments: Arguments) -> dict[str, dict]:
    """What is spoiled: the options that differ from those of the run as it should be."""
    return {
        "as it should be": {},
        "linear schedule, K = 20": {"schedule": "linear", "diffusion_steps": 20},
        "cloning cut short": {"clone_updates": max(1, arguments.clone_updates // 20)},
        "one sampling step": {"sampling_steps": 1},
        "refinement too far": {"refine_step_size": 100.0, "refine_max_norm": None},
        "critics too fast": {"critic_lr": 0.1},
        "few critic updates": {"critic_updates": max(1, arguments.updates // 20)},
    }


def main(arguments: Arguments) -> dict[str, Rows]:
    """Write one CSV file for each kind of measurement, and the figure; returns the rows."""
    if arguments.smoke:
        arguments = dataclasses.replace(arguments, **SMOKE)  # type: ignore[arg-type]
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    base = Config(
        num_trajectories=arguments.trajectories,
        demonstration_speed=(0.5, 1.0),
        direction_smoothing=0.0,
        formation_tolerance=0.5,
        clone_updates=arguments.clone_updates,
        critic_updates=arguments.updates,
        clone_batch=32,
        batch_size=32,
        hidden=arguments.hidden,
        tau=0.05,  # a short run: targets must follow sooner
    ).resolve()
    known, held_out = demonstration_split(base)
    tables: dict[str, Rows] = {name: [] for name in ("terms", "steps", "samplers", "updates")}
    tables["schedules"] = compare_schedules(arguments.num_steps, arguments.samples)
    runs = [(seed, name, changes) for seed in arguments.seeds for name, changes in failures(arguments).items()]
    for seed, name, changes in tqdm(runs, unit="run", disable=None):
        config = dataclasses.replace(base, seed=seed, **changes)
        label: dict[str, float | str] = {"seed": seed, "run": name}
        for table, rows in measure_run(config, known, held_out, every_sampler=not changes).items():
            tables[table] += [label | row for row in rows]
    for table, rows in tables.items():
        write_csv(arguments.out / f"{table}.csv", rows)
    path = arguments.figure or arguments.out / "theory.png"
    with replacing(path) as unfinished:
        draw(tables).savefig(unfinished, dpi=160)
    print(f"written to {arguments.out} and {path}")
    return tables


def demonstration_split(config: Config) -> tuple[TensorDictBase, TensorDictBase]:
    """N-step transitions of four fifths of the demonstrated episodes, and of the rest."""
    scenario = config.scenario()
    env = make_env(min(100, config.num_trajectories), reward_scale=config.reward_scale, **scenario)
    episodes = demonstrations(env, planner=config.planner, **config.plans())
    keep = [OBSERVATION, ACTION, ("agents", "info", "arrived")]
    windows = MultiStep(config.n_steps, config.gamma, keep=keep)(episodes)
    split = len(episodes) * 4 // 5
    known, rest = (
        transitions(windows[part][episodes["mask"][part]], demonstration=True)
        for part in (slice(split), slice(split, None))
    )
    return known, rest


def measure_run(
    config: Config, known: TensorDictBase, held_out: TensorDictBase, every_sampler: bool
) -> dict[str, Rows]:
    """Train one run and measure it: its row of all terms, and what it adds to the other tables."""
    torch.manual_seed(config.seed)
    architecture = policy_architecture(config, known[OBSERVATION].shape[-1])
    policy = build_policy(architecture)
    loss = make_loss(config, architecture, policy)
    actor_optimizer, critic_optimizer = make_optimizers(config, loss)
    for _ in range(config.clone_updates):
        update(actor_optimizer, loss.actor_loss(batch_of(known, config.clone_batch))[0], config)
    copy_to_targets(loss)
    diffusion, tables = diffusion_terms(policy, held_out, config.seed, every_sampler)
    tables["updates"] = train_offline(loss, config, known, held_out, (actor_optimizer, critic_optimizer))
    gamma = config.gamma**config.n_steps
    largest_reward = known[REWARD].abs().max().item()
    tables["terms"] = [
        {
            **diffusion,
            "bellman_residual": max(float(row["residual"]) for row in tables["updates"]),
            "coverage": float(tables["updates"][-1]["coverage"]),
            "algorithmic_error": algorithmic_error(config.critic_updates * config.tau, largest_reward, gamma),
        }
    ]
    return tables


def diffusion_terms(
    policy: TensorDictSequential, held_out: TensorDictBase, seed: int, every_sampler: bool
) -> tuple[dict[str, float], dict[str, Rows]]:
    """The terms of Theorem 1 on held-out demonstrations, as sums and for each step or sampler."""
    actor, generator = policy[1], torch.Generator().manual_seed(seed)
    schedule = actor.module.schedule
    with torch.no_grad():
        teams = policy[0](batch_of(held_out, 256, generator).select(OBSERVATION, ACTION, ACTIVE))
    active = teams[ACTIVE].squeeze(-1)  # the environment steers robots that have arrived
    agents = TensorDict({"embedding": teams[EMBEDDING][active], "action": teams[ACTION][active]}, [int(active.sum())])
    data = TensorDict({"agents": agents}, agents.shape)
    error = matching_error(actor, data, generator=generator)
    divergence = matching_divergence(actor, data, generator=generator)
    steps: Rows = [
        {"k": k + 1, "matching_error": error[k].item(), "matching_divergence": divergence[k].item()}
        for k in range(schedule.num_steps)
    ]
    few = data[:24]
    terms = {
        "prior_mismatch": prior_mismatch(schedule, actor.module.normalize(data[ACTION])).mean().item(),
        "matching_error": error.sum().item(),
        "matching_divergence": divergence.sum().item(),
        "discretization_error": discretization_error(actor, few, num_samples=32, generator=generator).mean().item(),
    }
    samplers: Rows = []
    for count in (1, 2, 5, 10, 20, 50) if every_sampler else ():
        chains = {"ddpm": DDPM(count), "ddpm without noise": DDPM(count, noise_ratio=0.0), "ddim": DDIM(count)}
        for name, chain in chains.items():
            distance = discretization_error(actor, few, chain, num_samples=32, generator=generator).mean().item()
            samplers.append({"sampler": name, "num_steps": count, "discretization_error": distance})
    return terms, {"steps": steps, "samplers": samplers}


def train_offline(
    loss: DIPOLoss,
    config: Config,
    known: TensorDictBase,
    held_out: TensorDictBase,
    optimizers: tuple[torch.optim.Optimizer, torch.optim.Optimizer],
) -> Rows:
    """Train the critics, and the actor on refined actions; the terms of Theorem 2 at ten moments."""
    actor_optimizer, critic_optimizer = optimizers
    target = SoftUpdate(loss, tau=config.tau)
    generator = torch.Generator().manual_seed(config.seed)
    measured = batch_of(held_out, 128, generator)
    interval = max(1, config.critic_updates // 10)
    rows: Rows = []
    for i in range(config.critic_updates):
        batch = batch_of(known, config.batch_size)
        batch["demonstration"] = torch.zeros_like(batch["demonstration"])  # do refine these
        update(critic_optimizer, loss.qvalue_loss(batch)[0], config)
        target.step()
        if i % 2:
            update(actor_optimizer, loss.actor_loss(batch)[0], config)
        if (i + 1) % interval == 0:
            residual = bellman_residual(loss, measured)
            figures = {"residual": residual.mean().item(), "largest_residual": residual.max().item()}
            rows.append({"update": i + 1, **figures, "coverage": coverage(loss, measured).mean().item()})
    return rows


def compare_schedules(num_steps: tuple[int, ...], samples: int) -> Rows:
    """Mismatch of each schedule, and the mass that a chain with the exact score leaves the likelier of two modes."""
    rows: Rows = []
    actions = torch.tensor([[MODE]] * 4 + [[-MODE]], dtype=torch.float64)  # MASS = 4 / 5
    for kind in ("cosine", "linear", "vp"):
        for count in num_steps:
            schedule, generator = NoiseSchedule(count, kind), torch.Generator().manual_seed(0)
            latent = torch.randn(samples, 1, generator=generator)
            sampled = DDPM()(two_modes(schedule), latent, schedule, generator)
            row = {
                "prior_mismatch": prior_mismatch(schedule, actions).mean().item(),
                "prior_mismatch_floor": prior_mismatch_floor(schedule, actions).item(),
                "discretization_term": discretization_term(schedule).item(),
                "mass_sampled": (sampled > 0).float().mean().item(),
            }
            rows.append({"schedule": kind, "K": count, **row})
    return rows


def two_modes(schedule: NoiseSchedule) -> Denoise:
    """``E[eps | a^k]`` for the mixture of two Gaussians at +MODE and -MODE: a perfect denoiser."""
    modes, weights = torch.tensor([MODE, -MODE]), torch.tensor([MASS, 1 - MASS])

    def denoise(action: Tensor, step: int) -> Tensor:
        signal = schedule.signal(step)
        variance = signal * WIDTH**2 + 1 - signal
        distance = action - math.sqrt(signal) * modes
        share = torch.softmax(weights.log() - distance.square() / (2 * variance), -1)
        return math.sqrt(1 - signal) * (share * distance).sum(-1, keepdim=True) / variance

    return denoise


def batch_of(data: TensorDictBase, size: int, generator: torch.Generator | None = None) -> TensorDictBase:
    """Random transitions."""
    return data[torch.randint(len(data), (size,), generator=generator)]


def update(optimizer: torch.optim.Optimizer, loss: Tensor, config: Config) -> None:
    """One step of an optimizer, with clipped gradients."""
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], config.grad_norm)
    optimizer.step()


if __name__ == "__main__":
    main(tyro.cli(Arguments))
