"""The diffusion actor: a TensorDictModule that turns an embedding into an action by denoising."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, TensorDictPrimer
from torchrl.envs.utils import ExplorationType, exploration_type

from redig.modules.samplers import DDPM, Sampler
from redig.modules.schedule import NoiseSchedule, keep_precision


class DiffusionPolicy(nn.Module):
    """The computation inside :class:`DiffusionActor`: sample an action, or score the denoiser on given actions.

    The chain runs in [-1, 1] and in float32, whatever the type of the network; actions are scaled to the bounds of the
    action spec. See :class:`DiffusionActor`.

    Examples:
        >>> import torch
        >>> from redig.modules import DDPM, DenoisingMLP, NoiseSchedule
        >>> low, high = torch.zeros(2), torch.full((2,), 4.0)
        >>> policy = DiffusionPolicy(DenoisingMLP(2, 8), NoiseSchedule(10), DDPM(), low, high)
        >>> policy.normalize(torch.tensor([0.0, 4.0]))
        tensor([-1.,  1.])
    """

    low: Tensor
    high: Tensor

    def __init__(
        self,
        denoiser: nn.Module,
        schedule: NoiseSchedule,
        sampler: Sampler,
        low: Tensor,
        high: Tensor,
        generator: torch.Generator | None = None,
        latent: bool = False,
        warm_start: int | None = None,
    ) -> None:
        super().__init__()
        self.denoiser = denoiser
        self.schedule = schedule
        self.sampler = sampler
        self.generator = generator
        self.reads_latent, self.warm_start = latent, warm_start
        self.register_buffer("low", low.clone())
        self.register_buffer("high", high.clone())

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> DiffusionPolicy:
        return keep_precision(self, super()._apply, fn, recurse)

    def normalize(self, action: Tensor) -> Tensor:
        """From the bounds of the spec to [-1, 1]."""
        return 2 * (action - self.low) / (self.high - self.low) - 1

    def denormalize(self, action: Tensor) -> Tensor:
        """From [-1, 1] to the bounds of the spec."""
        action = self.low + (action + 1) * (self.high - self.low) / 2
        return action.maximum(self.low).minimum(self.high)

    def forward(self, *inputs: Tensor, sampler: Sampler | None = None) -> Tensor | tuple[Tensor, Tensor]:
        """Sample actions ``[*B, A]``.

        Args:
            inputs: embeddings ``[*B, H]`` (several are concatenated), then the latent ``[*B, A]`` where one is read,
                then the previous action ``[*B, A]`` in [-1, 1] with a warm start.
            sampler: in place of the actor's own, for this call.

        Returns:
            the action within the bounds; with a warm start also the same in [-1, 1], for the next step.
        """
        embedding, rest = inputs, ()
        count = int(self.reads_latent) + int(self.warm_start is not None)
        if count:
            embedding, rest = inputs[:-count], inputs[-count:]
        deterministic = exploration_type() not in (ExplorationType.RANDOM, None)
        denoise = self._conditioned(*embedding)
        shape = (*embedding[0].shape[:-1], self.low.shape[-1])
        latent = torch.zeros(shape, dtype=self.low.dtype, device=embedding[0].device)
        if self.reads_latent:
            latent = latent + rest[0]
        elif not deterministic:
            latent = torch.empty_like(latent).normal_(generator=self.generator)
        sampler, start = sampler or self.sampler, None
        if self.warm_start is not None:
            start = max(step for step in sampler.timesteps(self.schedule) if step <= self.warm_start)
            signal = self.schedule.signal(start)
            latent = signal**0.5 * rest[-1] + (1 - signal) ** 0.5 * latent
        action = sampler(denoise, latent, self.schedule, self.generator, deterministic, start)
        return self.denormalize(action) if self.warm_start is None else (self.denormalize(action), action)

    def denoising_error(self, action: Tensor, *embedding: Tensor) -> Tensor:
        """Squared error of the predicted noise at a random step, Eq. 1 with Eq. 9: ``[*B]``, mean over A.

        Args:
            action: clean actions ``[*B, A]`` within the bounds.
            embedding: ``[*B, H]``.
        """
        clean = self.normalize(action)
        shape, device = clean.shape[:-1], clean.device
        step = torch.randint(self.schedule.num_steps, shape, device=device, generator=self.generator)
        noise = torch.empty_like(clean).normal_(generator=self.generator)
        predicted = self._conditioned(*embedding)(self.schedule.add_noise(clean, noise, step), step)
        return (predicted - noise).square().mean(-1)

    def _conditioned(self, *embedding: Tensor) -> Callable[[Tensor, int | Tensor], Tensor]:
        """The denoiser given the embedding: run in the network's own type, from and to the chain's."""
        condition = torch.cat(embedding, -1) if len(embedding) > 1 else embedding[0]
        weight = next(self.denoiser.parameters(), condition) if isinstance(self.denoiser, nn.Module) else condition
        condition = condition.to(weight.dtype)

        def denoise(action: Tensor, step: int | Tensor) -> Tensor:
            step = step if isinstance(step, Tensor) else torch.tensor(step, device=action.device)
            return self.denoiser(action.to(weight.dtype), step, condition).to(action.dtype)

        return denoise


class DiffusionActor(TensorDictModule):
    """Diffusion policy psi (Sec. 3.2.1) as a TensorDictModule: embedding in, action out.

    ``set_exploration_type`` decides about randomness: with ``RANDOM`` (or none set) the chain starts from a random
    latent and adds the sampler's noise; otherwise it starts from zero and adds none, so the same embedding always gives
    the same action.

    Three ways to a smoother motion, all off by default: a sampler without noise (``noise_ratio=0``); ``latent_key``, a
    latent that stays the same for a robot during its episode; ``warm_start``, a chain that begins with the action of the
    step before, noised to an intermediate step. The last two keep something from step to step: append
    :meth:`make_tensordict_primer` to the environment.

    Args:
        denoiser: module ``(noisy action [*B, A], step [*B], embedding [*B, H]) -> noise [*B, A]``, such as
            :class:`~redig.modules.DenoisingMLP`.
        action_spec: bounded spec of the action of one environment, ``[*n, A]``, or the ``full_action_spec`` of a batch of
            them; the bounds must be the same for all robots.
        in_keys: keys of the embeddings, concatenated along the last dimension.
        out_keys: key of the action.
        schedule: default: cosine, K = 100.
        sampler: default: :class:`~redig.modules.DDPM` with all steps and full noise. ``actor(data, sampler=...)``
            takes another one for one call, :meth:`with_sampler` for good.
        generator: source of all randomness of this actor; default: torch's global one.
        latent_key: where to read the latent ``[*B, A]`` instead of drawing one.
        warm_start: step k at which to begin with the previous action noised to k; the steps of the sampler's chain
            above k are left out.
        previous_action_key: where the previous action is read, scaled to [-1, 1]; it is written to
            ``("next", previous_action_key)``.

    Raises:
        ValueError: if the spec has no finite bounds, the sampler asks for more steps than the schedule has, there is not
            one action key, or no step of the chain is at or below ``warm_start``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from redig.modules import DDIM, DenoisingMLP, DiffusionActor
        >>> spec = Bounded(-1, 1, (5, 2))
        >>> actor = DiffusionActor(DenoisingMLP(2, 64), spec, in_keys=["embedding"], out_keys=["action"])
        >>> team = TensorDict({"embedding": torch.randn(8, 5, 64)}, [8])
        >>> actor(team)["action"].shape
        torch.Size([8, 5, 2])
        >>> actor(team, sampler=DDIM(num_steps=5))["action"].abs().max() <= 1
        tensor(True)
    """

    module: DiffusionPolicy

    def __init__(
        self,
        denoiser: nn.Module,
        action_spec: TensorSpec,
        in_keys: Sequence[NestedKey] = (("agents", "embedding"),),
        out_keys: Sequence[NestedKey] = (("agents", "action"),),
        schedule: NoiseSchedule | None = None,
        sampler: Sampler | None = None,
        generator: torch.Generator | None = None,
        *,
        latent_key: NestedKey | None = None,
        warm_start: int | None = None,
        previous_action_key: NestedKey = ("agents", "previous_action"),
    ) -> None:
        in_keys, out_keys = list(in_keys), list(out_keys)
        if len(out_keys) != 1:
            raise ValueError(f"out_keys: got {out_keys}, must be one key, the action's")
        batch_dims = 0
        if isinstance(action_spec, Composite):
            batch_dims, action_spec = len(action_spec.shape), action_spec[out_keys[0]]
        low, high = _bounds(action_spec)
        schedule, sampler = schedule or NoiseSchedule(), sampler or DDPM()
        lowest = sampler.timesteps(schedule)[-1]  # raises if they do not fit each other
        if warm_start is not None and not lowest <= warm_start < schedule.num_steps:
            allowed = f"{lowest}, the lowest step of the chain, to {schedule.num_steps - 1}"
            raise ValueError(f"warm_start: got {warm_start}, must be from {allowed}")
        policy = DiffusionPolicy(denoiser, schedule, sampler, low, high, generator, latent_key is not None, warm_start)
        self.embedding_keys, self.latent_key = list(in_keys), latent_key
        self.previous_action_key = previous_action_key if warm_start is not None else None
        if latent_key is not None:
            in_keys.append(latent_key)
        if self.previous_action_key is not None:
            in_keys.append(self.previous_action_key)
            out_keys.append(_under_next(self.previous_action_key))
        super().__init__(policy, in_keys=in_keys, out_keys=out_keys)
        self.action_shape = action_spec.shape[batch_dims:]

    def with_sampler(self, sampler: Sampler) -> DiffusionActor:
        """The same actor (the same weights, not a copy) with another sampler.

        Examples:
            >>> from torchrl.data import Bounded
            >>> from redig.modules import DenoisingMLP, DPMSolver
            >>> actor = DiffusionActor(DenoisingMLP(2, 64), Bounded(-1, 1, (5, 2)))
            >>> fast = actor.with_sampler(DPMSolver(num_steps=5))
            >>> fast.module.denoiser is actor.module.denoiser
            True
        """
        sampler.timesteps(self.module.schedule)  # raises if they do not fit each other
        actor = copy.copy(self)
        actor._modules = dict(self._modules)
        actor.module = copy.copy(self.module)
        actor.module.sampler = sampler
        return actor

    def make_tensordict_primer(self) -> Compose:
        """A transform for the environment that keeps what ``latent_key`` and ``warm_start`` need from step to step.

        At each reset a robot gets a fresh latent, and as its previous action the middle of the bounds.

        Raises:
            ValueError: if the actor keeps nothing.

        Examples:
            >>> import torch
            >>> from torchrl.envs import GymEnv, TransformedEnv
            >>> from redig.modules import DenoisingMLP
            >>> env = GymEnv("Pendulum-v1")
            >>> actor = DiffusionActor(
            ...     DenoisingMLP(1, 3), env.action_spec, ["observation"], ["action"], latent_key="latent"
            ... )
            >>> env = TransformedEnv(env, actor.make_tensordict_primer())
            >>> latent = env.rollout(4, actor)["latent"]
            >>> torch.equal(latent[0], latent[-1])
            True
        """
        primers = []
        if self.latent_key is not None:
            primers.append(TensorDictPrimer(self._kept(self.latent_key), random=True, expand_specs=True))
        if self.previous_action_key is not None:
            primers.append(TensorDictPrimer(self._kept(self.previous_action_key), expand_specs=True))
        if not primers:
            raise ValueError("make_tensordict_primer: the actor keeps nothing; set latent_key or warm_start")
        return Compose(*primers)

    def _kept(self, key: NestedKey) -> Composite:
        """Spec of something shaped like the action; a nested key's groups have one entry a robot."""
        spec: TensorSpec = Unbounded(self.action_shape, device=self.module.low.device, dtype=self.module.low.dtype)
        *groups, name = (key,) if isinstance(key, str) else key
        for group in reversed(groups):
            spec, name = Composite({name: spec}, shape=self.action_shape[:-1]), group
        return Composite({name: spec})


def _under_next(key: NestedKey) -> NestedKey:
    return ("next", key) if isinstance(key, str) else ("next", *key)


def _bounds(spec: TensorSpec) -> tuple[Tensor, Tensor]:
    """Lower and upper bounds ``[A]`` of an action spec ``[*B, A]``."""
    space = getattr(spec, "space", None)
    low, high = getattr(space, "low", None), getattr(space, "high", None)
    if low is None or high is None or not torch.isfinite(high - low).all():
        raise ValueError(f"action_spec: got {type(spec).__name__} without finite bounds; use torchrl.data.Bounded")
    low, high = low.reshape(-1, low.shape[-1]), high.reshape(-1, high.shape[-1])
    if not ((low == low[0]).all() and (high == high[0]).all()):
        raise ValueError("action_spec: the bounds differ between robots; use one actor for each kind of robot")
    return low[0], high[0]
