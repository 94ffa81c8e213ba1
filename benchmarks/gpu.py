"""Where there is a GPU: an action, an update and collection there, eager, compiled and as CUDA graphs.

Run ``python benchmarks/gpu.py``; without a CUDA device it says so and ends. A CUDA graph replays all kernels of a call
at once, so that launching them, which is most of the time of small networks, costs next to nothing.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from collection import measure as measure_collection
from harness import alternate, ratio, report
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate

sys.path.append(str(Path(__file__).resolve().parents[1] / "recipes"))
from config import Config
from redig_wedge import make_loss, make_optimizers, policy_architecture

from redig.objectives import DIPOLoss
from redig.policy import PolicyConfig, build_policy

PAPER = {100: 7.81, 60: 4.5}  # ms on an RTX 4090, for five robots
Device = torch.device | str


@dataclass
class Arguments:
    """Measure on the first CUDA device."""

    robots: int = 5
    """Robots of a team."""
    teams: int = 256
    """Teams in the batch of an update."""
    num_envs: tuple[int, ...] = (64, 256, 1024, 4096)
    """Teams simulated in parallel."""
    repeats: int = 10
    """Repetitions of everything."""
    compile: bool = True
    """Measure torch.compile, too; a chain of a hundred steps takes it minutes."""
    out: Path = Path("docs/results/speed")
    """Folder for the tables."""


def main(arguments: Arguments) -> None:
    """Measure and write ``gpu_action``, ``gpu_update`` and ``gpu_collection``, or say why not."""
    if not torch.cuda.is_available():
        print("gpu: skipped, torch finds no CUDA device")
        return
    torch.set_num_threads(1)
    device = torch.device("cuda", 0)
    notes = [f"{torch.cuda.get_device_name(device)}, CUDA {torch.version.cuda}."]
    with set_exploration_type(ExplorationType.RANDOM):
        rows = [
            row
            for steps in (100, 60)
            for encoder in (False, True)
            for row in action_rows(steps, encoder, arguments.robots, device, arguments.repeats, arguments.compile)
        ]
        report(arguments.out, "gpu_action", rows, [*notes, ACTION_NOTE], threads=1)
        rows = [
            row
            for steps in (5, 100)
            for row in update_rows(
                steps, arguments.teams, arguments.robots, device, arguments.repeats, arguments.compile
            )
        ]
        report(arguments.out, "gpu_update", rows, [*notes, UPDATE_NOTE], threads=1)
    rows = [
        {"device": where, **row}
        for num_envs in arguments.num_envs
        for where in ("cpu", "cuda")
        for row in measure_collection(num_envs, repeats=min(arguments.repeats, 3), device=where)
    ]
    report(arguments.out, "gpu_collection", rows, [*notes, "See collection.md for what the columns mean."], threads=1)


ACTION_NOTE = (
    "One action of a team, from numbers on the host to an action on the host, at a noise ratio of 1; 60 steps are the "
    "first 60 of 100. The denoiser has the layers 40-256-256-256-2. The paper's times are for a whole control step on "
    "an RTX 4090."
)
UPDATE_NOTE = (
    "Critics, refinement and diffusion loss of one batch, gradients, clipping, Adam and the target networks; three "
    "hidden layers of 256."
)


# --- one action


def action_rows(
    steps: int, encoder: bool, robots: int, device: Device, repeats: int, compiled: bool
) -> list[dict[str, Any]]:
    """One row for each way to run the same policy."""
    act = actor(steps, encoder, device)
    host = torch.randn(robots, 9 if encoder else 22)
    inputs = host.to(device)

    def from_host(call: Callable[[], Tensor]) -> Callable[[], Tensor]:
        def control() -> Tensor:
            inputs.copy_(host)
            return call().cpu()  # waits for the device

        return control

    forms: dict[str, Callable[[], Tensor]] = {"eager": lambda: act(inputs)}
    if torch.device(device).type == "cuda":
        forms["CUDA graph"] = graphed(lambda: act(inputs))
    if compiled:
        fast = torch.compile(act, mode="reduce-overhead")
        forms["torch.compile"] = lambda: fast(inputs)
    timings = alternate({name: from_host(call) for name, call in forms.items()}, repeats)
    return [
        {
            "steps": steps,
            "with encoder": encoder,
            "form": name,
            "ms": 1e3 * timing.median,
            "eager / this": ratio(timings["eager"], timing),
            "first call (s)": timing.first,
            "paper (ms)": PAPER[steps],
        }
        for name, timing in timings.items()
    ]


def actor(steps: int, encoder: bool, device: Device) -> Callable[[Tensor], Tensor]:
    """The policy without keys: from embeddings ``[n, 22]``, or observations ``[n, 9]``, to actions ``[n, 2]``."""
    policy = build_policy(PolicyConfig(observation_dim=9, embedding_dim=22, early_stop=steps)).to(device)
    embed, chain = policy[0].module, policy[1].module

    @torch.no_grad()
    def act(inputs: Tensor) -> Tensor:
        return chain(embed(inputs) if encoder else inputs)

    return act


# --- one update


def update_rows(
    steps: int, teams: int, robots: int, device: Device, repeats: int, compiled: bool
) -> list[dict[str, Any]]:
    """One row for each way to run the same update, each with networks of its own."""
    batch = batch_of(teams, robots, device)
    forms = {"eager": updater(steps, batch)}
    if torch.device(device).type == "cuda":
        forms["CUDA graph"] = graphed(updater(steps, batch))
    if compiled:
        forms["torch.compile"] = torch.compile(updater(steps, batch))
    if compiled and torch.device(device).type == "cuda":
        forms["torch.compile, CUDA graph"] = graphed(torch.compile(updater(steps, batch)))
    timings = alternate({name: waiting(call, device) for name, call in forms.items()}, repeats)
    return [
        {
            "steps": steps,
            "teams": teams,
            "form": name,
            "ms": 1e3 * timing.median,
            "eager / this": ratio(timings["eager"], timing),
            "first call (s)": timing.first,
        }
        for name, timing in timings.items()
    ]


def updater(steps: int, batch: TensorDictBase, hidden: int = 256) -> Callable[[], Tensor]:
    """A step of all networks on the batch, which stays where it is: new data are copied into it."""
    config, on_gpu = configuration(steps, hidden), batch.device.type == "cuda"
    loss = loss_of(config).to(batch.device)
    optimizers = [
        torch.optim.Adam(made.param_groups[0]["params"], config.actor_lr, fused=on_gpu, capturable=on_gpu)
        for made in make_optimizers(config, loss)
    ]
    target = SoftUpdate(loss, tau=config.tau)

    def update() -> Tensor:
        losses = loss(batch.copy())  # the loss adds keys; the tensors are shared
        total = losses["loss_qvalue"] + losses["loss_actor"]
        total.backward()
        for optimizer in optimizers:
            torch.nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], config.grad_norm)
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        target.step()
        return total.detach()

    return update


def configuration(steps: int, hidden: int) -> Config:
    """The recipe's options but for the width of its networks and the chain, which is as noisy as the paper's."""
    return Config(hidden=hidden, sampling_steps=steps, noise_ratio=1.0).resolve()


def loss_of(config: Config) -> DIPOLoss:
    """The recipe's loss around new networks."""
    architecture = policy_architecture(config, observation_dim=9)
    return make_loss(config, architecture, build_policy(architecture))


def batch_of(teams: int, robots: int, device: Device) -> TensorDictBase:
    """Random transitions with the keys of the recipe's loss."""
    observation, following = torch.randn(2, teams, robots, 9)
    action = torch.rand(teams, robots, 2) * 2 - 1
    terminated = torch.rand(teams, robots, 1) < 0.1
    agents = {"observation": observation, "action": action, "policy_action": action.clone()}
    agents["active"] = torch.rand(teams, robots, 1) < 0.9
    after = {"observation": following, "reward": torch.randn(teams, robots, 1)}
    after |= {"done": terminated, "terminated": terminated.clone()}
    data = {"agents": agents, "next": {"agents": after}, "demonstration": torch.rand(teams, 1) < 0.1}
    data["steps_to_next_obs"] = torch.full((teams, robots, 1), 5)
    return TensorDict(data, [teams], device="cpu").to(device)


# --- CUDA


def waiting(call: Callable[[], Tensor], device: Device) -> Callable[[], Tensor]:
    """The call, which returns when the device has finished."""

    def wait() -> Tensor:
        out = call()
        if torch.device(device).type == "cuda":
            torch.cuda.synchronize(device)
        return out

    return wait


def graphed(call: Callable[[], Tensor], warmup: int = 5) -> Callable[[], Tensor]:
    """The kernels of a call as a CUDA graph; a replay reads and writes the very tensors of the capture.

    Calls before the capture let libraries, optimisers and the compiler set themselves up, on a stream of their own as
    PyTorch asks for.
    """
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(warmup):
            call()
    torch.cuda.current_stream().wait_stream(stream)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        out = call()

    def replay() -> Tensor:
        graph.replay()
        return out

    return replay


if __name__ == "__main__":
    main(tyro.cli(Arguments))
