"""Policy files: what a trained team needs to drive, as safetensors with a JSON header; loading executes nothing."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.data import Bounded

from redig.files import replacing
from redig.modules import DDPM, DenoisingMLP, DiffusionActor, GraphEncoder, NoiseSchedule

FORMAT = "redig-policy-1"
OBSERVATION, EMBEDDING, ACTION = ("agents", "observation"), ("agents", "embedding"), ("agents", "action")


@dataclass(frozen=True)
class PolicyConfig:
    """The architecture of a policy: everything but its weights.

    Args:
        observation_dim: width of a robot's state.
        action_low, action_high: bounds of an action (m/s).
        embedding_dim, encoder_hidden, radius, encoder, aggregation, encoder_activation: see
            :class:`~redig.modules.GraphEncoder`.
        hidden, step_dim: see :class:`~redig.modules.DenoisingMLP`.
        diffusion_steps, schedule: see :class:`~redig.modules.NoiseSchedule`.
        sampling_steps, noise_ratio, early_stop: see :class:`~redig.modules.DDPM`.
    """

    observation_dim: int
    action_low: tuple[float, ...] = (-1.0, -1.0)
    action_high: tuple[float, ...] = (1.0, 1.0)
    embedding_dim: int = 64
    encoder_hidden: int = 128
    radius: float = 2.0
    encoder: str = "edgeconv"
    aggregation: str = "max"
    encoder_activation: str | None = "relu"
    hidden: tuple[int, ...] = (256, 256, 256)
    step_dim: int = 16
    diffusion_steps: int = 100
    schedule: str = "cosine"
    sampling_steps: int | None = None
    noise_ratio: float = 1.0
    early_stop: int | None = None


def build_encoder(config: PolicyConfig) -> TensorDictModule:
    """A graph encoder from robots' observations to their embeddings."""
    encoder = GraphEncoder(
        config.observation_dim,
        config.embedding_dim,
        config.encoder_hidden,
        config.radius,
        config.encoder,
        config.aggregation,
        config.encoder_activation,
    )
    return TensorDictModule(encoder, in_keys=[OBSERVATION], out_keys=[EMBEDDING])


def build_policy(config: PolicyConfig) -> TensorDictSequential:
    """A new policy with random weights: graph encoder, then diffusion actor.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> policy = build_policy(PolicyConfig(observation_dim=9, sampling_steps=5))
        >>> team = TensorDict({"agents": {"observation": torch.zeros(1, 5, 9)}}, [1])
        >>> policy(team)["agents", "action"].shape
        torch.Size([1, 5, 2])
    """
    low, high = torch.tensor(config.action_low), torch.tensor(config.action_high)
    actor = DiffusionActor(
        DenoisingMLP(len(low), config.embedding_dim, config.hidden, config.step_dim),
        Bounded(low, high, low.shape),
        in_keys=[EMBEDDING],
        out_keys=[ACTION],
        schedule=NoiseSchedule(config.diffusion_steps, config.schedule),
        sampler=DDPM(config.sampling_steps, config.noise_ratio, config.early_stop),
    )
    return TensorDictSequential(build_encoder(config), actor)


def save_policy(
    path: str | Path, policy: TensorDictSequential, config: PolicyConfig, environment: dict[str, Any] | None = None
) -> None:
    """Write a policy file; an existing one is replaced only by a complete one.

    Args:
        path: of the file, by custom ``*.safetensors``.
        policy: as made by :func:`build_policy`.
        config: that made it.
        environment: arguments of the scenario that it was trained in, for those who evaluate it.
    """
    header = {"format": FORMAT, "policy": json.dumps(asdict(config)), "environment": json.dumps(environment or {})}
    weights = {key: value.detach().cpu().contiguous() for key, value in policy.state_dict().items()}
    with replacing(path) as file:
        file.write_bytes(save(weights, header))


def read_header(path: str | Path) -> tuple[PolicyConfig, dict[str, Any]]:
    """The architecture of a policy file and the arguments of the scenario that it was trained in.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a policy file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"policy: no such file: {path}")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
    except SafetensorError as error:
        raise ValueError(f"policy: {path} is not a safetensors file, or is damaged ({error})") from error
    if header.get("format") != FORMAT:
        raise ValueError(f"policy: {path} has format {header.get('format')!r}, expected {FORMAT!r}")
    try:
        policy, environment = json.loads(header["policy"]), json.loads(header["environment"])
        fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in policy.items()}
        return PolicyConfig(**fields), environment
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"policy: the header of {path} is damaged, or of another version ({error})") from error


def load_policy(path: str | Path, observation_dim: int | None = None) -> TensorDictSequential:
    """A ready policy from its file: reads ``("agents", "observation")``, writes ``("agents", "action")``.

    Args:
        path: of the file.
        observation_dim: width of the observations that it will be given, to be checked at once.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a policy file, is damaged, or was trained on another observation width.
    """
    config, _ = read_header(path)
    if observation_dim is not None and observation_dim != config.observation_dim:
        raise ValueError(
            f"policy: {path} was trained on observations of {config.observation_dim} numbers a robot, the environment "
            f"gives {observation_dim}; build the environment with the same observe_direction"
        )
    policy = build_policy(config)
    try:
        policy.load_state_dict(load_file(path))
    except RuntimeError as error:
        raise ValueError(f"policy: the weights in {path} do not fit its header ({error})") from error
    return policy.eval()
