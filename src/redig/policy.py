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
from redig.modules import (
    DDIM,
    DDPM,
    DenoisingMLP,
    DiffusionActor,
    DPMSolver,
    GaussianActor,
    GraphEncoder,
    NoiseSchedule,
    Sampler,
)
from redig.modules.denoiser import mlp

FORMAT = "redig-policy-1"
OBSERVATION, EMBEDDING, ACTION = ("agents", "observation"), ("agents", "embedding"), ("agents", "action")
LATENT = ("agents", "latent")
SAMPLERS = ("ddpm", "ddim", "dpmsolver")
KINDS = ("diffusion", "gaussian", "deterministic", "ppo")


@dataclass(frozen=True)
class PolicyConfig:
    """The architecture of a policy: everything but its weights.

    Args:
        observation_dim: width of a robot's state.
        action_low, action_high: bounds of an action (m/s).
        embedding_dim, encoder_hidden, radius, encoder, aggregation, encoder_activation, edge_features: see
            :class:`~redig.modules.GraphEncoder`.
        hidden, step_dim, activation: see :class:`~redig.modules.DenoisingMLP`.
        diffusion_steps, schedule: see :class:`~redig.modules.NoiseSchedule`.
        sampling_steps, noise_ratio, early_stop, sampler, eta: see :func:`build_sampler`.
        kind: ``"diffusion"``; ``"gaussian"`` or ``"deterministic"`` for a :class:`~redig.modules.GaussianActor` of the
            same width; ``"ppo"`` for the policy of the PPO baselines, see :func:`~redig.baselines.gaussian_policy`.
            Only the first needs what concerns steps, schedule and sampler.

    Examples:
        >>> config = PolicyConfig(observation_dim=9, sampling_steps=5)
        >>> config.diffusion_steps, config.radius  # trained with 100 steps, sampled with 5; robots hear 2 m far
        (100, 2.0)
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
    edge_features: str = "state"
    hidden: tuple[int, ...] = (256, 256, 256)
    step_dim: int = 16
    activation: str = "mish"
    diffusion_steps: int = 100
    schedule: str = "cosine"
    sampling_steps: int | None = None
    noise_ratio: float = 1.0
    early_stop: int | None = None
    sampler: str = "ddpm"
    eta: float = 0.0
    kind: str = "diffusion"


def build_sampler(
    name: str,
    num_steps: int | None = None,
    noise_ratio: float = 1.0,
    early_stop: int | None = None,
    eta: float = 0.0,
) -> Sampler:
    """A sampler by its name: ``"ddpm"``, ``"ddim"`` or ``"dpmsolver"``.

    Args:
        name: which sampler.
        num_steps: steps of the chain.
        noise_ratio: of :class:`~redig.modules.DDPM`.
        early_stop: of DDPM.
        eta: of :class:`~redig.modules.DDIM`.

    Raises:
        ValueError: for an unknown name, or options outside their range.

    Examples:
        >>> build_sampler("ddim", num_steps=5)
        DDIM(num_steps=5, eta=0.0)
    """
    if name not in SAMPLERS:
        raise ValueError(f"sampler: got {name!r}, allowed are {', '.join(SAMPLERS)}")
    if name == "ddpm":
        return DDPM(num_steps, noise_ratio, early_stop)
    return DDIM(num_steps, eta) if name == "ddim" else DPMSolver(num_steps)


def build_encoder(config: PolicyConfig) -> TensorDictModule:
    """A graph encoder from robots' observations to their embeddings.

    Examples:
        >>> from tensordict import TensorDict
        >>> encoder = build_encoder(PolicyConfig(observation_dim=9, embedding_dim=32))
        >>> encoder(TensorDict({"agents": {"observation": torch.zeros(1, 5, 9)}}, [1]))["agents", "embedding"].shape
        torch.Size([1, 5, 32])
    """
    encoder = GraphEncoder(
        config.observation_dim,
        config.embedding_dim,
        config.encoder_hidden,
        config.radius,
        config.encoder,
        config.aggregation,
        config.encoder_activation,
        config.edge_features,
    )
    return TensorDictModule(encoder, in_keys=[OBSERVATION], out_keys=[EMBEDDING])


def build_policy(
    config: PolicyConfig, *, fixed_latent: bool = False, warm_start: int | None = None
) -> TensorDictSequential:
    """A new policy with random weights: graph encoder, then diffusion actor, or one without diffusion.

    Args:
        config: the architecture.
        fixed_latent: read each robot's latent from ``("agents", "latent")`` instead of drawing one at each step.
        warm_start: step at which the chain begins with the action before, see :class:`~redig.modules.DiffusionActor`.
            For either, append the actor's ``make_tensordict_primer()`` to the environment.

    Raises:
        ValueError: for an unknown kind, or an option of the diffusion chain given to another kind.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> policy = build_policy(PolicyConfig(observation_dim=9, sampling_steps=5))
        >>> team = TensorDict({"agents": {"observation": torch.zeros(1, 5, 9)}}, [1])
        >>> policy(team)["agents", "action"].shape
        torch.Size([1, 5, 2])
    """
    if config.kind not in KINDS:
        raise ValueError(f"kind: got {config.kind!r}, allowed are {', '.join(KINDS)}")
    low, high = torch.tensor(config.action_low), torch.tensor(config.action_high)
    if config.kind != "diffusion" and (fixed_latent or warm_start is not None):
        raise ValueError(f"fixed_latent, warm_start: a {config.kind} policy has no chain; leave them out")
    encoder, spec = build_encoder(config), Bounded(low, high, low.shape)
    if config.kind == "ppo":
        from redig.baselines import gaussian_policy  # here, as a robot with a diffusion policy needs no baseline

        return gaussian_policy(encoder, config.embedding_dim, low, high, config.hidden, config.activation)
    if config.kind != "diffusion":
        stochastic = config.kind == "gaussian"
        net = mlp(config.embedding_dim, config.hidden, len(low) * (1 + stochastic), config.activation)
        return TensorDictSequential(encoder, GaussianActor(net, spec, [EMBEDDING], [ACTION], stochastic))
    actor = DiffusionActor(
        DenoisingMLP(len(low), config.embedding_dim, config.hidden, config.step_dim, config.activation),
        spec,
        in_keys=[EMBEDDING],
        out_keys=[ACTION],
        schedule=NoiseSchedule(config.diffusion_steps, config.schedule),
        sampler=build_sampler(config.sampler, config.sampling_steps, config.noise_ratio, config.early_stop, config.eta),
        latent_key=LATENT if fixed_latent else None,
        warm_start=warm_start,
    )
    return TensorDictSequential(encoder, actor)


def save_policy(
    path: str | Path, policy: TensorDictSequential, config: PolicyConfig, environment: dict[str, Any] | None = None
) -> None:
    """Write a policy file; an existing one is replaced only by a complete one.

    Args:
        path: of the file, by custom ``*.safetensors``.
        policy: as made by :func:`build_policy`.
        config: that made it.
        environment: arguments of the scenario that it was trained in, for those who evaluate it.

    Examples:
        >>> import tempfile
        >>> config = PolicyConfig(observation_dim=9)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_policy(f"{folder}/policy.safetensors", build_policy(config), config, {"formation": "line"})
        ...     found, environment = read_header(f"{folder}/policy.safetensors")
        >>> found == config, environment
        (True, {'formation': 'line'})
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

    Examples:
        >>> read_header("no/such/policy.safetensors")
        Traceback (most recent call last):
        ...
        FileNotFoundError: policy: no such file: no/such/policy.safetensors
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
        return PolicyConfig(**{"edge_features": "position", **fields}), environment  # the first policies had no choice
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"policy: the header of {path} is damaged, or of another version ({error})") from error


def load_policy(
    path: str | Path,
    observation_dim: int | None = None,
    *,
    sampler: Sampler | None = None,
    fixed_latent: bool = False,
    warm_start: int | None = None,
) -> TensorDictSequential:
    """A ready policy from its file: reads ``("agents", "observation")``, writes ``("agents", "action")``.

    Args:
        path: of the file.
        observation_dim: width of the observations that it will be given, to be checked at once.
        sampler: in place of the one that it was trained with.
        fixed_latent: see :func:`build_policy`.
        warm_start: see :func:`build_policy`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a policy file, is damaged, or was trained on another observation width.

    Examples:
        >>> import tempfile
        >>> from tensordict import TensorDict
        >>> from torchrl.envs.utils import ExplorationType, set_exploration_type
        >>> config = PolicyConfig(observation_dim=9, sampling_steps=5)
        >>> policy = build_policy(config)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_policy(f"{folder}/policy.safetensors", policy, config)
        ...     loaded = load_policy(f"{folder}/policy.safetensors", observation_dim=9)
        >>> team = TensorDict({"agents": {"observation": torch.randn(1, 5, 9)}}, [1])
        >>> with set_exploration_type(ExplorationType.DETERMINISTIC):
        ...     torch.equal(loaded(team.clone())["agents", "action"], policy(team.clone())["agents", "action"])
        True
    """
    config, _ = read_header(path)
    if observation_dim is not None and observation_dim != config.observation_dim:
        raise ValueError(
            f"policy: {path} was trained on observations of {config.observation_dim} numbers a robot, the environment "
            f"gives {observation_dim}; build the environment with the same observe_direction"
        )
    policy = build_policy(config, fixed_latent=fixed_latent, warm_start=warm_start)
    if sampler is not None:
        if config.kind != "diffusion":
            raise ValueError(f"sampler: {path} holds a {config.kind} policy, which has none; leave it out")
        policy = TensorDictSequential(policy[0], policy[1].with_sampler(sampler))
    try:
        policy.load_state_dict(load_file(path))
    except RuntimeError as error:
        raise ValueError(f"policy: the weights in {path} do not fit its header ({error})") from error
    return policy.eval()
