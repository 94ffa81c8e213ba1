"""Checkpoints: a run can be killed at any moment and continues, bit for bit, from the last one."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from vmas.simulator.environment import Environment

from redig.files import replacing


def save_checkpoint(path: str | Path, state: dict[str, Any]) -> None:
    """Write nested dictionaries of tensors, numbers and strings; the file is replaced only by a complete one.

    Args:
        path: of the file.
        state: what to save.
    """
    with replacing(path) as file:
        torch.save(state, file)


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read what :func:`save_checkpoint` wrote; nothing in the file is executed.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged, or holds something other than tensors, numbers and strings.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"checkpoint: no such file: {path}")
    try:
        return torch.load(path, weights_only=True)
    except (RuntimeError, EOFError, OSError, pickle.UnpicklingError) as error:
        raise ValueError(
            f"checkpoint: {path} is damaged or not a checkpoint ({str(error).splitlines()[0]}); "
            "start a new run, or restore the file from a copy"
        ) from error


def rng_state() -> dict[str, torch.Tensor]:
    """States of the generators that training draws from: torch's global one and VMAS's own."""
    return {"torch": torch.get_rng_state(), "vmas": Environment.vmas_random_state[0].clone()}


def set_rng_state(state: dict[str, torch.Tensor]) -> None:
    """Restore what :func:`rng_state` returned."""
    torch.set_rng_state(state["torch"])
    Environment.vmas_random_state[0] = state["vmas"].clone()


def collection_state(env: EnvBase, collector: Collector) -> dict[str, Any]:
    """Where a collection of experience stands: the simulated teams and the data that the collector carries over.

    Args:
        env: environment over a :class:`~redig.envs.FormationNavigation`.
        collector: the collector that steps it.
    """
    carrier = collector._carrier.select(*env.state_keys, *env.observation_keys, *env.done_keys, "collector")
    return {"scenario": env.base_env.scenario.state_dict(), "carrier": flat(carrier)}


def set_collection_state(env: EnvBase, collector: Collector, state: dict[str, Any]) -> None:
    """Restore what :func:`collection_state` returned."""
    env.base_env.scenario.load_state_dict(state["scenario"])
    collector._carrier.update(unflat(state["carrier"], collector._carrier.batch_size))


def buffer_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """The filled part of a buffer and its write cursor."""
    if len(buffer) == 0:
        return {"size": 0}
    return {"size": len(buffer), "data": flat(buffer[:]), "writer": buffer.writer.state_dict()}


def set_buffer_state(buffer: ReplayBuffer, state: dict[str, Any]) -> None:
    """Restore what :func:`buffer_state` returned into an empty buffer."""
    if state["size"]:
        buffer.extend(unflat(state["data"], [state["size"]]))
        buffer.writer.load_state_dict(state["writer"])


def flat(data: TensorDict) -> dict[str, torch.Tensor]:
    """A TensorDict as a flat dictionary of tensors, which a file can hold without code."""
    return {key: value.clone() for key, value in data.flatten_keys("/").items()}


def unflat(data: dict[str, torch.Tensor], batch_size: list[int] | torch.Size) -> TensorDict:
    """The inverse of :func:`flat`."""
    return TensorDict(data, batch_size).unflatten_keys("/")
