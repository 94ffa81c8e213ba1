"""The diffusion actor: a TensorDictModule that turns an embedding into an action by denoising."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.envs.utils import ExplorationType, exploration_type

from redig.modules.samplers import DDPM
from redig.modules.schedule import NoiseSchedule


class DiffusionPolicy(nn.Module):
    """The computation inside :class:`DiffusionActor`: sample an action, or score the denoiser on given actions.

    The chain runs in [-1, 1]; actions are scaled to the bounds of the action spec. See :class:`DiffusionActor`.
    """

    low: Tensor
    high: Tensor

    def __init__(
        self,
        denoiser: nn.Module,
        schedule: NoiseSchedule,
        sampler: DDPM,
        low: Tensor,
        high: Tensor,
        generator: torch.Generator | None,
    ) -> None:
        super().__init__()
        self.denoiser = denoiser
        self.schedule = schedule
        self.sampler = sampler
        self.generator = generator
        self.register_buffer("low", low.clone())
        self.register_buffer("high", high.clone())

    def normalize(self, action: Tensor) -> Tensor:
        """From the bounds of the spec to [-1, 1]."""
        return 2 * (action - self.low) / (self.high - self.low) - 1

    def denormalize(self, action: Tensor) -> Tensor:
        """From [-1, 1] to the bounds of the spec."""
        action = self.low + (action + 1) * (self.high - self.low) / 2
        return action.maximum(self.low).minimum(self.high)

    def forward(self, *embedding: Tensor) -> Tensor:
        """Sample actions ``[*B, A]`` for embeddings ``[*B, H]``; several embeddings are concatenated."""
        condition = torch.cat(embedding, -1) if len(embedding) > 1 else embedding[0]
        kind = exploration_type()
        deterministic = kind not in (ExplorationType.RANDOM, None)
        latent = condition.new_zeros(*condition.shape[:-1], self.low.shape[-1])
        if not deterministic:
            latent.normal_(generator=self.generator)

        def denoise(action: Tensor, step: int) -> Tensor:
            return self.denoiser(action, torch.tensor(step, device=action.device), condition)

        return self.denormalize(self.sampler(denoise, latent, self.schedule, self.generator, deterministic))

    def denoising_error(self, action: Tensor, *embedding: Tensor) -> Tensor:
        """Squared error of the predicted noise at a random step, Eq. 1 with Eq. 9: ``[*B]``, mean over A.

        Args:
            action: clean actions ``[*B, A]`` within the bounds.
            embedding: ``[*B, H]``.
        """
        condition = torch.cat(embedding, -1) if len(embedding) > 1 else embedding[0]
        clean = self.normalize(action)
        shape, device = clean.shape[:-1], clean.device
        step = torch.randint(self.schedule.num_steps, shape, device=device, generator=self.generator)
        noise = torch.empty_like(clean).normal_(generator=self.generator)
        predicted = self.denoiser(self.schedule.add_noise(clean, noise, step), step, condition)
        return (predicted - noise).square().mean(-1)


class DiffusionActor(TensorDictModule):
    """Diffusion policy psi (Sec. 3.2.1) as a TensorDictModule: embedding in, action out.

    ``set_exploration_type`` decides about randomness: with ``RANDOM`` (or none set) the chain starts from a random
    latent and adds the sampler's noise; otherwise it starts from zero and adds none, so the same embedding always gives
    the same action.

    Args:
        denoiser: module ``(noisy action [*B, A], step [*B], embedding [*B, H]) -> noise [*B, A]``, such as
            :class:`~redig.modules.denoiser.DenoisingMLP`.
        action_spec: bounded spec of the action; its last dimension is A and bounds must be the same for all robots.
        in_keys: keys of the embeddings, concatenated along the last dimension.
        out_keys: key of the action.
        schedule: default: cosine, K = 100.
        sampler: default: :class:`~redig.modules.samplers.DDPM` with all steps and full noise.
        generator: source of all randomness of this actor; default: torch's global one.

    Raises:
        ValueError: if the spec has no finite bounds, or the sampler asks for more steps than the schedule has.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from redig.modules import DenoisingMLP, DiffusionActor
        >>> spec = Bounded(-1, 1, (5, 2))
        >>> actor = DiffusionActor(DenoisingMLP(2, 64), spec, in_keys=["embedding"], out_keys=["action"])
        >>> actor(TensorDict({"embedding": torch.randn(8, 5, 64)}, [8]))["action"].shape
        torch.Size([8, 5, 2])
    """

    def __init__(
        self,
        denoiser: nn.Module,
        action_spec: TensorSpec,
        in_keys: Sequence[NestedKey] = (("agents", "embedding"),),
        out_keys: Sequence[NestedKey] = (("agents", "action"),),
        schedule: NoiseSchedule | None = None,
        sampler: DDPM | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        out_keys = list(out_keys)
        if isinstance(action_spec, Composite):
            action_spec = action_spec[out_keys[0]]
        low, high = _bounds(action_spec)
        schedule = schedule or NoiseSchedule()
        sampler = sampler or DDPM()
        sampler.timesteps(schedule)  # raises if they do not fit each other
        policy = DiffusionPolicy(denoiser, schedule, sampler, low, high, generator)
        super().__init__(policy, in_keys=list(in_keys), out_keys=out_keys)


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
