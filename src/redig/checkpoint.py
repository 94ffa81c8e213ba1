"""Checkpoints: a run can be killed at any moment and continues, bit for bit, from the last one."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from vmas.simulator.environment import Environment

from redig.disk_storage import DiskStorage
from redig.files import replacing


def save_checkpoint(path: str | Path, state: dict[str, Any]) -> None:
    """Write nested dictionaries of tensors, numbers and strings; the file is replaced only by a complete one.

    Args:
        path: of the file.
        state: what to save.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_checkpoint(f"{folder}/run/checkpoint.pt", {"updates": 3})  # makes the folder
        ...     load_checkpoint(f"{folder}/run/checkpoint.pt")
        {'updates': 3}
    """
    with replacing(path) as file:
        torch.save(state, file)


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read what :func:`save_checkpoint` wrote; nothing in the file is executed.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged, or holds something other than tensors, numbers and strings.

    Examples:
        >>> load_checkpoint("no/such/checkpoint.pt")
        Traceback (most recent call last):
        ...
        FileNotFoundError: checkpoint: no such file: no/such/checkpoint.pt
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"checkpoint: no such file: {path}")
    remedy = "start a new run, or restore the file from a copy"
    try:
        with zipfile.ZipFile(path) as archive:
            broken = archive.testzip()  # torch.load itself does not look at the check sums
        if broken is None:
            return torch.load(path, weights_only=True)
    except (zipfile.BadZipFile, EOFError, OSError, RuntimeError, pickle.UnpicklingError) as error:
        reason = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
        raise ValueError(f"checkpoint: {path} is damaged or not a checkpoint ({reason}); {remedy}") from error
    raise ValueError(f"checkpoint: {path} is damaged (check sum of {broken}); {remedy}")


def rng_state() -> dict[str, torch.Tensor]:
    """States of the generators that training draws from: torch's global one and VMAS's own.

    Examples:
        >>> sorted(rng_state())
        ['torch', 'vmas']
    """
    return {"torch": torch.get_rng_state(), "vmas": Environment.vmas_random_state[0].clone()}


def set_rng_state(state: dict[str, torch.Tensor]) -> None:
    """Restore what :func:`rng_state` returned.

    Examples:
        >>> state = rng_state()
        >>> drawn = torch.rand(3)
        >>> set_rng_state(state)
        >>> torch.equal(torch.rand(3), drawn)
        True
    """
    torch.set_rng_state(state["torch"])
    Environment.vmas_random_state[0] = state["vmas"].clone()


def collection_state(env: EnvBase, collector: Collector) -> dict[str, Any]:
    """Where a collection of experience stands: the simulated teams and the data that the collector carries over.

    Args:
        env: environment over a :class:`~redig.envs.FormationNavigation`.
        collector: the collector that steps it.

    Examples:
        >>> from redig.envs import make_env
        >>> env = make_env(2)
        >>> collector = Collector(env, frames_per_batch=8, total_frames=-1)
        >>> _ = next(iter(collector))
        >>> collection_state(env, collector)["scenario"]["position"].shape
        torch.Size([2, 5, 2])
    """
    carrier = collector._carrier.select(*env.state_keys, *env.observation_keys, *env.done_keys, "collector")
    return {
        "scenario": env.base_env.scenario.state_dict(),
        "carrier": flat(carrier),
        "traj_pool": collector._traj_pool.state_dict(),
    }


def set_collection_state(env: EnvBase, collector: Collector, state: dict[str, Any]) -> None:
    """Restore what :func:`collection_state` returned.

    Examples:
        >>> from redig.envs import make_env
        >>> env = make_env(2)
        >>> collector = Collector(env, frames_per_batch=8, total_frames=-1)
        >>> batches = iter(collector)
        >>> _ = next(batches)
        >>> state = collection_state(env, collector)
        >>> _ = next(batches)  # four steps further
        >>> set_collection_state(env, collector, state)
        >>> torch.equal(env.base_env.scenario.state_dict()["position"], state["scenario"]["position"])
        True
    """
    env.base_env.scenario.load_state_dict(state["scenario"])
    collector._carrier.update(unflat(state["carrier"], collector._carrier.batch_size))
    collector._traj_pool.load_state_dict(state["traj_pool"])


def buffer_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """The filled part of a buffer and its write cursor; of a :class:`~redig.disk_storage.DiskStorage` only its state.

    Examples:
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10))
        >>> _ = buffer.extend(TensorDict({"reward": torch.arange(3.0)}, [3]))
        >>> buffer_state(buffer)["data"]["reward"]
        tensor([0., 1., 2.])
    """
    if isinstance(buffer.storage, DiskStorage):
        return {"storage": buffer.storage.state_dict(), "writer": buffer.writer.state_dict()}
    if len(buffer) == 0:
        return {"size": 0}
    return {"size": len(buffer), "data": flat(buffer[:]), "writer": buffer.writer.state_dict()}


def set_buffer_state(buffer: ReplayBuffer, state: dict[str, Any]) -> None:
    """Restore what :func:`buffer_state` returned into an empty buffer.

    Examples:
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> full, empty = (TensorDictReplayBuffer(storage=LazyTensorStorage(10)) for _ in range(2))
        >>> _ = full.extend(TensorDict({"reward": torch.arange(3.0)}, [3]))
        >>> set_buffer_state(empty, buffer_state(full))
        >>> empty[:]["reward"]
        tensor([0., 1., 2.])
    """
    if isinstance(buffer.storage, DiskStorage):
        buffer.storage.load_state_dict(state["storage"])
        buffer.writer.load_state_dict(state["writer"])
    elif state["size"]:
        buffer.extend(unflat(state["data"], [state["size"]]))
        buffer.writer.load_state_dict(state["writer"])


def flat(data: TensorDict) -> dict[str, torch.Tensor]:
    """A TensorDict as a flat dictionary of tensors, which a file can hold without code.

    Examples:
        >>> flat(TensorDict({"agents": {"action": torch.zeros(1, 2)}}, [1]))
        {'agents/action': tensor([[0., 0.]])}
    """
    return {key: value.clone() for key, value in data.flatten_keys("/").items()}


def unflat(data: dict[str, torch.Tensor], batch_size: list[int] | torch.Size) -> TensorDict:
    """The inverse of :func:`flat`.

    Examples:
        >>> unflat({"agents/action": torch.zeros(1, 2)}, [1])["agents", "action"]
        tensor([[0., 0.]])
    """
    return TensorDict(data, batch_size).unflatten_keys("/")
