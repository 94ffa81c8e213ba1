"""Trained policies as ONNX files, for robots that have neither TorchRL nor torch: see :mod:`redig.deploy.runtime`."""

from __future__ import annotations

import json
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

from redig.deploy.runtime import FORMAT
from redig.files import replacing
from redig.modules import DenoisingMLP, DiffusionActor, GraphEncoder, Sampler
from redig.policy import PolicyConfig

try:
    import onnx_ir as ir

    from redig.deploy.chain import unroll
except ImportError as error:
    raise ImportError("redig.deploy.export needs ONNX: pip install 'redig[onnx]'") from error


def export_policy(
    policy: TensorDictSequential | DiffusionActor,
    path: str | Path,
    config: PolicyConfig | None = None,
    environment: dict[str, Any] | None = None,
    *,
    stochastic: bool = False,
    ego: bool = False,
    input_dim: int | None = None,
) -> None:
    """Write a policy as one ONNX file, observations in, actions out; an old file is replaced only by a complete one.

    The file has the encoder, the whole chain of the policy's sampler, clamps and bounds as operators of ONNX, in
    float32 and for any number of robots. Its actions are those of the policy up to rounding.

    Args:
        policy: a graph encoder and a :class:`~redig.modules.DiffusionActor`, as made by
            :func:`~redig.policy.build_policy`; or the actor alone, whose input is the embedding. A user's own encoder
            is exported as it is, from ``[B, n, F]`` to ``[B, n, H]``, if torch can export it.
        path: of the file, by custom ``*.onnx``.
        config: that made the policy, for those who read the file.
        environment: arguments of the scenario that it was trained in, likewise.
        stochastic: make the latent and the sampler's noise inputs; by default the latent is zero and there is no noise,
            as with ``ExplorationType.DETERMINISTIC``.
        ego: only the action of the first robot, for a robot that gives its own observation first and then those of
            the robots that it hears.
        input_dim: width of the input; default: what a GraphEncoder or, for the actor alone, a DenoisingMLP was made
            for.

    Raises:
        TypeError: if the policy is neither of the two.
        ValueError: if it reads several keys, a latent or a previous action, its sampler has a loop of its own, or the
            width of the input is unknown.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from redig.deploy import load_policy
        >>> from redig.policy import build_policy
        >>> config = PolicyConfig(observation_dim=9, sampling_steps=5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     export_policy(build_policy(config), f"{folder}/policy.onnx", config, {"formation": "line"})
        ...     robots = load_policy(f"{folder}/policy.onnx")
        >>> robots(torch.randn(5, 9).numpy()).shape, robots.environment
        ((5, 2), {'formation': 'line'})
    """
    encoder, actor = _split(policy)
    alone = isinstance(encoder, nn.Identity)
    if input_dim is None:
        input_dim = _width(actor.module.denoiser if alone else encoder)
    name = "embedding" if alone else "observation"
    model = unroll(encoder, actor.module, name, input_dim, stochastic, ego)
    header = {
        "policy": None if config is None else asdict(config),
        "environment": environment or {},
        "sampler": _description(actor.module.sampler),
    }
    model.producer_name = "redig"
    model.metadata_props.update({"format": FORMAT, **{key: json.dumps(value) for key, value in header.items()}})
    with replacing(path) as file:
        ir.save(model, file)


def _split(policy: TensorDictSequential | DiffusionActor) -> tuple[nn.Module, DiffusionActor]:
    """The module of the encoder, which is the identity for an actor alone, and the actor."""
    parts = list(policy) if isinstance(policy, TensorDictSequential) else [policy]
    actor = parts[-1]
    if not isinstance(actor, DiffusionActor) or len(parts) > 2 or not isinstance(parts[0], TensorDictModule):
        names = ", ".join(type(part).__name__ for part in parts)
        raise TypeError(f"policy: got {names}; expected an encoder and a DiffusionActor, or a DiffusionActor")
    if actor.latent_key is not None or actor.previous_action_key is not None:
        raise ValueError(
            "policy: it keeps a latent or its previous action, a file keeps nothing; build it without fixed_latent and "
            "warm_start, and give the exported policy its latent with stochastic=True"
        )
    for part in parts:
        if len(part.in_keys) != 1:
            raise ValueError(f"policy: {type(part).__name__} reads {part.in_keys}, must be one key")
    if len(parts) == 1:
        return nn.Identity(), actor
    if parts[0].out_keys[:1] != actor.in_keys:
        raise ValueError(f"policy: the actor reads {actor.in_keys}, the encoder writes {parts[0].out_keys}")
    return parts[0].module, actor


def _width(module: nn.Module) -> int:
    if isinstance(module, GraphEncoder):
        return module.in_features
    if isinstance(module, DenoisingMLP):
        return module.embedding_dim
    raise ValueError(f"input_dim: got None, which is only known for our own networks, not for {type(module).__name__}")


def _description(sampler: Sampler) -> dict[str, Any]:
    options = asdict(sampler) if is_dataclass(sampler) else {}
    return {"name": type(sampler).__name__, **options}
