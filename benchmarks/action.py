"""One action of a team of five, K = 100, by ourselves and by our peers: ``python benchmarks/action.py``.

All have the same layers (40-256-256-256-2, Mish; input: 2 of the action, 16 of the step, 22 of the embedding), one
thread and float32, start from a random latent and draw their noise themselves. The floor is the chain's matrix products
alone. Forms that sample the same posterior give the same action on the same numbers, to 1e-5, or the script fails.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from diffusers import DDPMScheduler
from dipo_loop import DIPOLoop
from harness import alternate, ratio, report
from tensordict import TensorDict
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torchrl.data import Bounded
from torchrl.modules import DiffusionActor as TorchRLDiffusionActor

from redig.deploy import ExportedPolicy, export_policy, load_policy
from redig.modules import DenoisingMLP, DiffusionActor

ACTION_DIM, STEP_DIM, EMBEDDING_DIM = 2, 16, 22
FLOOR, TORCHRL, OURS = "matrix products alone", "torchrl DiffusionActor", "redig DiffusionActor"
EXPORTED, COMPILED = "redig exported, ONNX Runtime", "redig DiffusionActor, torch.compile"


@dataclass
class Arguments:
    """Time one action."""

    robots: int = 5
    """Robots in the team."""
    hidden: int = 256
    """Width of the three hidden layers."""
    compile: bool = False
    """Also torch.compile (max-autotune) of our actor, which takes about a minute to compile."""
    repeats: int = 30
    """Repetitions of each."""
    threads: int = 1
    """Threads."""
    seed: int = 0
    """Seed of weights, embedding and noise."""
    out: Path = Path("docs/results/speed")
    """Folder for the table."""


@torch.no_grad()
def main(arguments: Arguments) -> list[dict[str, Any]]:
    """Time all forms in turn, then compare their actions."""
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(arguments.seed)
    actor = trained_actor(arguments.hidden)
    embedding = torch.randn(arguments.robots, EMBEDDING_DIM)
    exported, prepared = exported_actor(actor, arguments.threads)
    team, array = TensorDict({"embedding": embedding}), embedding.numpy()

    loop = DIPOLoop(actor.module.denoiser, actor.module.schedule)
    equal: dict[str, Callable[[], Any]] = {
        "plain port of DIPO's loop": lambda: loop(embedding),
        "diffusers DDPMScheduler": diffusers_loop(actor, embedding),
        OURS: lambda: actor(team.clone(False))["action"],
        EXPORTED: lambda: exported(array),
    }
    seconds = {EXPORTED: prepared}
    if arguments.compile:
        compiled = torch.compile(actor.module, mode="max-autotune")
        equal[COMPILED] = lambda: compiled(embedding)
        started = time.perf_counter()
        equal[COMPILED]()
        seconds[COMPILED] = time.perf_counter() - started
    others = {FLOOR: matrix_products(arguments), TORCHRL: torchrl_actor(arguments)}
    timings = alternate({**others, **equal}, arguments.repeats)
    differences = compare(equal, actor, exported, array)
    rows = [
        {
            "form": name,
            "median (ms)": 1e3 * timing.median,
            "quartiles (ms)": " to ".join(f"{1e3 * value:.2f}" for value in timing.quartiles),
            "x floor": ratio(timing, timings[FLOOR]),
            "x faster than torchrl": ratio(timings[TORCHRL], timing),
            "first call (ms)": 1e3 * timing.first,
            "made ready (s)": seconds.get(name, ""),
            "largest difference": differences.get(name, ""),
        }
        for name, timing in timings.items()
    ]
    notes = [
        f"One action of {arguments.robots} robots, K = {actor.module.schedule.num_steps}, denoiser "
        f"{STEP_DIM + ACTION_DIM + EMBEDDING_DIM}-{'-'.join([str(arguments.hidden)] * 3)}-{ACTION_DIM}, Mish, float32; "
        f"medians of {arguments.repeats} repetitions in alternation, ratios repetition by repetition. The largest "
        "difference is that of an action in [-1, 1] to our DiffusionActor's on the same latent and noise.",
        "torchrl's actor takes the step as one raw number and has a schedule of its own, without clamping: its "
        f"observation is padded to {STEP_DIM + EMBEDDING_DIM - 1} numbers so that its layers have the same shapes. Its "
        "actions are others. Made ready: export and load, or compilation; the first call comes after that. Our "
        "forms take the embedding's and the step's part of the first layer out of the chain: fewer products than the "
        "floor's.",
    ]
    report(arguments.out, "action", rows, notes, arguments.threads)
    return rows


def trained_actor(hidden: int, updates: int = 300) -> DiffusionActor:
    """An actor that has learned a little, so that its chains end between the bounds, where differences show."""
    denoiser = DenoisingMLP(ACTION_DIM, EMBEDDING_DIM, (hidden,) * 3, STEP_DIM)
    actor = DiffusionActor(denoiser, Bounded(-1, 1, (ACTION_DIM,)), ["embedding"], ["action"])
    optimizer = torch.optim.Adam(denoiser.parameters(), 1e-3)
    with torch.enable_grad():
        for _ in range(updates):
            embedding = torch.randn(256, EMBEDDING_DIM)
            error = actor.module.action_loss(0.8 * embedding[:, :ACTION_DIM].tanh(), embedding).mean()
            optimizer.zero_grad()
            error.backward()
            optimizer.step()
    return actor


def exported_actor(actor: DiffusionActor, threads: int) -> tuple[ExportedPolicy, float]:
    """The actor through an ONNX file, and the seconds that this takes."""
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        export_policy(actor, f"{folder}/actor.onnx", stochastic=True)
        policy = load_policy(f"{folder}/actor.onnx", threads=threads)
    return policy, time.perf_counter() - started


def diffusers_loop(actor: DiffusionActor, embedding: Tensor) -> Callable[[], Tensor]:
    """The usual loop around a scheduler of diffusers, with our schedule and our denoiser."""
    policy = actor.module
    scheduler = DDPMScheduler(
        policy.schedule.num_steps,
        trained_betas=policy.schedule.betas.numpy(),
        variance_type="fixed_small",
        clip_sample=True,
        clip_sample_range=1.0,
    )
    # in double precision, as ours; from float32 variances their actions are 5e-6 away
    scheduler.alphas_cumprod = torch.tensor([policy.schedule.signal(k) for k in range(100)], dtype=torch.float64)
    scheduler.set_timesteps(policy.schedule.num_steps)

    def sample() -> Tensor:
        action = torch.randn(len(embedding), ACTION_DIM)
        for step in scheduler.timesteps:
            action = scheduler.step(policy.denoiser(action, step, embedding), step, action).prev_sample
        return action

    return sample


def torchrl_actor(arguments: Arguments) -> Callable[[], Any]:
    """TorchRL's own diffusion actor with layers of the same shapes."""
    widths = [STEP_DIM + ACTION_DIM + EMBEDDING_DIM, *[arguments.hidden] * 3]
    layers = [layer for a, b in itertools.pairwise(widths) for layer in (nn.Linear(a, b), nn.Mish())]
    network = nn.Sequential(*layers, nn.Linear(widths[-1], ACTION_DIM))
    actor = TorchRLDiffusionActor(ACTION_DIM, score_network=network, num_steps=100)
    team = TensorDict({"observation": torch.randn(arguments.robots, widths[0] - ACTION_DIM - 1)})
    return lambda: actor(team.clone(False))


def matrix_products(arguments: Arguments) -> Callable[[], None]:
    """The four products of each step, without anything else."""
    widths = [STEP_DIM + ACTION_DIM + EMBEDDING_DIM, *[arguments.hidden] * 3, ACTION_DIM]
    weights = [torch.randn(a, b) for a, b in itertools.pairwise(widths)]
    inputs = [torch.randn(arguments.robots, width) for width in widths]
    outputs = [torch.empty_like(x) for x in inputs[1:]]

    def products() -> None:
        for _ in range(100):
            for x, weight, out in zip(inputs[:-1], weights, outputs, strict=True):
                torch.mm(x, weight, out=out)

    return products


class Replay(TorchFunctionMode):
    """Random numbers of torch come from a list, in order, however many are drawn at once."""

    def __init__(self, numbers: Tensor) -> None:
        super().__init__()
        self.numbers, self.used = numbers.flatten(), 0

    def __torch_function__(self, function, types, args=(), kwargs=None):
        """Take the numbers of ``randn`` and ``randn_like`` from the list."""
        value = function(*args, **(kwargs or {}))
        if function in (torch.randn, torch.randn_like):
            drawn = self.numbers[self.used : self.used + value.numel()]
            self.used += value.numel()
            return drawn.reshape(value.shape)
        return value


def compare(
    forms: dict[str, Callable[[], Any]], actor: DiffusionActor, exported: ExportedPolicy, embedding: np.ndarray
) -> dict[str, float]:
    """Largest difference of each form's action to our actor's, over several latents and noises.

    Raises:
        RuntimeError: if one is above 1e-5.
    """
    largest = dict.fromkeys(forms, 0.0)
    steps, robots = actor.module.schedule.num_steps, len(embedding)
    for _ in range(5):
        numbers = torch.randn(steps + 1, robots, ACTION_DIM)
        actions = {}
        for name, form in forms.items():
            if name == EXPORTED:
                actions[name] = exported(embedding, latent=numbers[0].numpy(), noise=numbers[1:steps].numpy())
            elif name != COMPILED:  # compiled code draws its numbers itself
                with Replay(numbers):
                    actions[name] = form().numpy()
        for name, action in actions.items():
            difference = np.abs(action - actions[OURS]).max()
            largest[name] = max(largest[name], float(difference))
    if not max(largest.values()) < 1e-5:
        raise RuntimeError(f"actions differ: {largest}")
    return {name: value for name, value in largest.items() if name != COMPILED}


if __name__ == "__main__":
    main(tyro.cli(Arguments))
