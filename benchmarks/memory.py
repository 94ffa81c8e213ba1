"""The replay buffer on disk against the one in memory: bytes, resident memory, and the time of samples and updates.

Run ``python benchmarks/memory.py``. Each buffer is measured in a process of its own: it is filled with a million team
transitions of the keys that the recipe stores, then the recipe's loss learns from it, then a checkpoint is written.
"""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from harness import report
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

sys.path.append(str(Path(__file__).resolve().parents[1] / "recipes"))
from config import Config
from redig_wedge import ARRIVED, BASE_ACTION, make_loss, make_optimizers, policy_architecture, transitions

from redig.checkpoint import buffer_state, save_checkpoint
from redig.disk_storage import DiskStorage
from redig.envs.factory import make_env
from redig.objectives import MultiStep
from redig.policy import ACTION, OBSERVATION, build_policy

Kind = Literal["memory", "disk"]
MIB = 2**20


@dataclass
class Arguments:
    """Compare both kinds of buffer at the same size."""

    transitions: int = 1_000_000
    """Team transitions in the buffer."""
    batch: int = 256
    """Teams in a batch."""
    repeats: int = 50
    """Samples and updates; their medians are reported."""
    only: Kind | None = None
    """Measure this kind alone, in this process, and print the row as JSON."""
    folder: Path | None = None
    """Where a temporary folder for the buffer is made, and removed; default: the system's own place."""
    out: Path = Path("docs/results/speed")
    """Folder for the tables."""


def main(arguments: Arguments) -> list[dict[str, Any]]:
    """Measure and write ``memory.csv`` and ``memory.md``."""
    torch.set_num_threads(1)
    if arguments.only is not None:
        with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
            print(
                json.dumps(measure(arguments.only, arguments.transitions, arguments.batch, arguments.repeats, folder))
            )
        return []
    rows = [in_own_process(kind, arguments) for kind in ("memory", "disk")]
    notes = [
        f"{arguments.transitions:,} transitions of teams of five, batches of {arguments.batch} teams; medians of "
        f"{arguments.repeats}. An update is a step of the critics, of the actor and of the target networks.",
        "Peak resident memory is that of the whole life of the process, checkpoint and libraries included. Pages of "
        "the mapped files count as resident, but the system takes them back when memory is short; anonymous memory it "
        "can not. Samples come from files that the system still holds in memory, as where it has enough of it.",
    ]
    report(arguments.out, "memory", rows, notes, threads=1)
    return rows


def in_own_process(kind: Kind, arguments: Arguments) -> dict[str, Any]:
    """The row of one kind of buffer."""
    options = {name: getattr(arguments, name) for name in ("transitions", "batch", "repeats", "folder")}
    command = [sys.executable, __file__, "--only", kind]
    for name, value in options.items():
        command += [] if value is None else [f"--{name}", str(value)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def measure(kind: Kind, size: int, batch: int, repeats: int, folder: str | Path) -> dict[str, Any]:
    """Fill a buffer, learn from it, write a checkpoint."""
    folder, config = Path(folder), Config().resolve()
    storage = DiskStorage(size, folder / "buffer") if kind == "disk" else LazyTensorStorage(size)
    buffer = TensorDictReplayBuffer(storage=storage)
    started = time.perf_counter()
    fill(buffer, size, lived(config))
    filling = time.perf_counter() - started
    update = updater(config)
    row: dict[str, Any] = {"buffer": kind, "transitions": len(buffer), "fill (s)": filling}
    row["sample (ms)"] = 1e3 * median_seconds(lambda: buffer.sample(batch), repeats)
    row["update (ms)"] = 1e3 * median_seconds(lambda: update(buffer.sample(batch)), repeats)
    row |= {f"{name} after updates (MiB)": value for name, value in resident().items()}
    started = time.perf_counter()
    save_checkpoint(folder / "checkpoint.pt", {"buffer": buffer_state(buffer)})
    row["checkpoint (s)"] = time.perf_counter() - started
    row["checkpoint (MiB)"] = (folder / "checkpoint.pt").stat().st_size / MIB
    row["buffer on disk (MiB)"] = sum(512 * path.stat().st_blocks for path in folder.rglob("*.memmap")) / MIB
    row["peak resident (MiB)"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return row


def lived(config: Config, num_envs: int = 64) -> TensorDictBase:
    """Transitions as the recipe stores them, of teams that act at random."""
    env = make_env(num_envs, reward_scale=config.reward_scale, **config.scenario())
    act = TensorDictModule(lambda observation: torch.rand(*observation.shape[:-1], 2) * 2 - 1, [OBSERVATION], [ACTION])
    keep_base = TensorDictModule(torch.clone, in_keys=[ACTION], out_keys=[BASE_ACTION])
    keep = [OBSERVATION, ACTION, BASE_ACTION, ARRIVED]
    collector = Collector(
        env,
        TensorDictSequential(act, keep_base),
        frames_per_batch=num_envs * config.collect_steps,
        total_frames=-1,
        postproc=MultiStep(config.n_steps, config.gamma, keep=keep),
        auto_register_policy_transforms=False,
    )
    return transitions(next(iter(collector)))


def fill(buffer: ReplayBuffer, size: int, data: TensorDictBase) -> None:
    """Write the same transitions again and again until the buffer is full."""
    while len(buffer) < size:
        buffer.extend(data[: size - len(buffer)].clone())


def updater(config: Config) -> Callable[[TensorDictBase], None]:
    """A step of all networks, as in the recipe but for the clipping of gradients."""
    architecture = policy_architecture(config, observation_dim=9)
    loss = make_loss(config, architecture, build_policy(architecture))
    optimizers, target = make_optimizers(config, loss), SoftUpdate(loss, tau=config.tau)

    def update(batch: TensorDictBase) -> None:
        losses = loss(batch)
        (losses["loss_qvalue"] + losses["loss_actor"]).backward()
        for optimizer in optimizers:
            optimizer.step()
            optimizer.zero_grad()
        target.step()

    return update


def median_seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median time of a call."""
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)


def resident() -> dict[str, float]:
    """Resident memory of this process by kind (MiB), as far as the system tells."""
    path = Path("/proc/self/status")
    fields = dict(line.split(":", 1) for line in path.read_text().splitlines()) if path.exists() else {}
    names = {"RssAnon": "anonymous", "RssFile": "mapped files"}
    return {kind: int(fields[name].split()[0]) / 1024 for name, kind in names.items() if name in fields}


if __name__ == "__main__":
    main(tyro.cli(Arguments))
