"""The diffusion actor: a TensorDictModule that turns an embedding into an action by denoising."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence

import torch
from tensordict import TensorDictBase, unravel_key, unravel_key_list
from tensordict.nn import TensorDictModule, dispatch, set_skip_existing
from tensordict.utils import NestedKey
from torch import nn
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, TensorDictPrimer

from redig.modules.bounded import action_bounds
from redig.modules.diffusion import DiffusionPolicy
from redig.modules.samplers import DDPM, Sampler
from redig.modules.schedule import NoiseSchedule


class DiffusionActor(TensorDictModule):
    """Diffusion policy psi (Sec. 3.2.1) as a TensorDictModule: embedding in, action out.

    ``set_exploration_type`` decides about randomness: with ``RANDOM`` (or none set) the chain starts from a random
    latent and adds the sampler's noise; otherwise it starts from zero and adds none, so the same embedding always gives
    the same action. A latent that is read (``latent_key``) counts in both cases.

    Three ways to a smoother motion, all off by default: a sampler without noise (``noise_ratio=0``); ``latent_key``, a
    latent that stays the same for a robot during its episode; ``warm_start``, a chain that begins with the action of
    the step before, noised to an intermediate step. The last two keep something from step to step: append
    :meth:`make_tensordict_primer` to the environment.

    ``actor.to(torch.bfloat16)`` makes the network smaller; schedule, bounds, chain and action stay in float32.
    ``torch.compile`` traces the whole chain into one graph, but no ``torch.Generator``: leave ``generator`` unset for
    it.

    Args:
        denoiser: module ``(noisy action [*B, A], step [*B], embedding [*B, H]) -> noise [*B, A]``, such as
            :class:`~redig.modules.DenoisingMLP`; it casts its inputs to its own type where that is not float32.
        action_spec: bounded spec of the action of one environment, ``[*n, A]``, or the ``full_action_spec`` of a batch
            of them; the bounds must be the same for all robots.
        in_keys: keys of the embeddings, concatenated along the last dimension.
        out_keys: key of the action.
        schedule: default: cosine, K = 100.
        sampler: default: :class:`~redig.modules.DDPM` with all steps and full noise. ``actor(data, sampler=...)``
            takes another one for one call, :meth:`with_sampler` for good.
        generator: source of all randomness of this actor, on its device; default: torch's global one.
        latent_key: where to read the latent ``[*B, A]`` instead of drawing one.
        warm_start: step k at which to begin with the previous action noised to k; the steps of the sampler's chain
            above k are left out.
        previous_action_key: where a warm start reads the previous action, scaled to [-1, 1]; it is written to
            ``("next", previous_action_key)``. Default: ``previous_action`` beside the action.

    Raises:
        KeyError: if the spec or, when called, the data lack a key.
        ValueError: if the spec has no finite bounds, the sampler asks for more steps than the schedule has, there is
            not one action key, no step of the chain is at or below ``warm_start``, or, when called, shapes do not fit.

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
        previous_action_key: NestedKey | None = None,
    ) -> None:
        in_keys, out_keys = list(unravel_key_list(in_keys)), list(unravel_key_list(out_keys))
        if len(out_keys) != 1:
            raise ValueError(f"out_keys: got {out_keys}, must be one key, the action's")
        low, high, action_shape = action_bounds(action_spec, out_keys[0])
        schedule, sampler = schedule or NoiseSchedule(), sampler or DDPM()
        policy = DiffusionPolicy(denoiser, schedule, sampler, low, high, generator, latent_key is not None, warm_start)
        self.action_key, self.embedding_keys, self.latent_key = out_keys[0], list(in_keys), latent_key
        self.previous_action_key = None
        if latent_key is not None:
            in_keys.append(latent_key)
        if warm_start is not None:
            *group, _ = _path(self.action_key)
            self.previous_action_key = previous_action_key or unravel_key((*group, "previous_action"))
            in_keys.append(self.previous_action_key)
            out_keys.append(("next", *_path(self.previous_action_key)))
        super().__init__(policy, in_keys=in_keys, out_keys=out_keys)
        self.action_shape = action_shape

    @property
    def spec(self) -> Composite:
        """Spec of the action of one environment, on the actor's device.

        Examples:
            >>> from torchrl.data import Bounded
            >>> from redig.modules import DenoisingMLP
            >>> actor = DiffusionActor(DenoisingMLP(2, 64), Bounded(-1, 1, (5, 2)))
            >>> actor.spec["agents", "action"].shape
            torch.Size([5, 2])
        """
        return self.module.spec(self.action_key, self.action_shape)

    @dispatch(auto_batch_size=False)
    @set_skip_existing(None)
    def forward(self, tensordict: TensorDictBase, *args, **kwargs) -> TensorDictBase:
        """Write the action; ``sampler=...`` takes another sampler for this call."""
        self._check_inputs(tensordict)
        return super().forward(tensordict, *args, **kwargs)

    def _check_inputs(self, tensordict: TensorDictBase) -> None:
        kept = [key for key in (self.latent_key, self.previous_action_key) if key is not None]
        there = tensordict.keys(True, True)
        missing = [key for key in self.in_keys if key not in there]
        if missing:
            hint = "; append make_tensordict_primer() to the environment" if set(missing) & set(kept) else ""
            raise KeyError(f"input: no key {_names(missing)}; it has {_names(there)}{hint}")
        first, *others = self.embedding_keys
        batch = tensordict[first].shape[:-1]
        expected = {key: (*batch, tensordict[key].shape[-1]) for key in others}
        expected |= {key: (*batch, self.action_shape[-1]) for key in kept}
        for key, shape in expected.items():
            if tensordict[key].shape != shape:
                seen, beside = list(tensordict[key].shape), list(tensordict[first].shape)
                raise ValueError(
                    f"{key!r}: got shape {seen}, expected {list(shape)} beside {first!r} of shape {beside}"
                )

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
        self.module.first_step(sampler)  # raises if they do not fit each other
        actor = copy.copy(self)
        actor.__dict__ |= {name: value.copy() for name, value in vars(self).items() if isinstance(value, dict)}
        actor.module = copy.copy(self.module)  # shares the dicts of its parameters, buffers and modules
        actor.module.sampler = sampler
        return actor

    def make_tensordict_primer(
        self, action_shape: Sequence[int] | None = None, reset_key: NestedKey | None = None
    ) -> Compose:
        """A transform for the environment that keeps what ``latent_key`` and ``warm_start`` need from step to step.

        At each reset a robot gets a fresh latent, and as its previous action the middle of the bounds. Empty for an
        actor that keeps nothing, so that TorchRL's ``get_primers_from_module`` takes any policy.

        Args:
            action_shape: of the action of one environment, ``[*n, A]``, where the actor was built for a single robot
                and drives a team; default: that of the actor's spec.
            reset_key: which of the environment's reset flags counts, where it has several (PettingZoo: ``"_reset"``).

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
        shape = self.action_shape if action_shape is None else torch.Size(action_shape)
        primers = []
        if self.latent_key is not None:
            latent = self._kept(self.latent_key, shape)
            primers.append(TensorDictPrimer(latent, random=True, expand_specs=True, reset_key=reset_key))
        if self.previous_action_key is not None:
            previous = self._kept(self.previous_action_key, shape)
            primers.append(TensorDictPrimer(previous, expand_specs=True, reset_key=reset_key))
        return Compose(*primers)

    def _kept(self, key: NestedKey, shape: torch.Size) -> Composite:
        """Spec of something shaped like the action; as in the environment, its group has one entry a robot."""
        spec: TensorSpec = Unbounded(shape, device=self.module.low.device, dtype=self.module.low.dtype)
        *groups, name = _path(key)
        robots = shape[:-1] if groups[:1] == [_path(self.action_key)[0]] else ()
        for group in reversed(groups):
            spec, name = Composite({name: spec}, shape=robots), group
        return Composite({name: spec})


def _names(keys: Iterable[NestedKey]) -> str:
    return ", ".join(sorted(repr(key) for key in keys)) or "none"


def _path(key: NestedKey) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else tuple(key)
