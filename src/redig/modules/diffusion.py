"""The computation inside the diffusion actor: sample actions by denoising, and score the denoiser on given ones."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from redig.modules.bounded import BoundedPolicy
from redig.modules.samplers import Denoise, Sampler
from redig.modules.schedule import NoiseSchedule


class DiffusionPolicy(BoundedPolicy):
    """Tensors in, tensors out; :class:`~redig.modules.DiffusionActor` gives it its keys and explains the options.

    The chain runs in [-1, 1] and in float32 or better, whatever the type of the network; actions are scaled to the
    bounds of the action spec.

    Args:
        denoiser: module ``(noisy action [*B, A], step [*B], embedding [*B, H]) -> noise [*B, A]``. The action comes in
            the chain's type: a network in another one casts its inputs itself, as DenoisingMLP does. Chains go through
            its method ``prepare`` if it has one, see :meth:`~redig.modules.DenoisingMLP.prepare`.
        schedule: noise schedule that the denoiser is trained with.
        sampler: how the chain goes back.
        low, high: bounds of the action ``[A]``.
        generator: source of all randomness; default: torch's global one.
        latent: whether the latent is an input.
        warm_start: step at which the chain begins with the previous action, which is an input then.

    Raises:
        ValueError: if sampler, schedule and ``warm_start`` do not fit each other.

    Examples:
        >>> import torch
        >>> from redig.modules import DDPM, DenoisingMLP, NoiseSchedule
        >>> low, high = torch.zeros(2), torch.full((2,), 4.0)
        >>> policy = DiffusionPolicy(DenoisingMLP(2, 8), NoiseSchedule(10), DDPM(), low, high)
        >>> policy(torch.randn(5, 8)).shape
        torch.Size([5, 2])
        >>> policy.normalize(torch.tensor([0.0, 4.0]))
        tensor([-1.,  1.])
    """

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
        super().__init__(low, high)
        self.denoiser = denoiser
        self.schedule = schedule
        self.sampler = sampler
        self.generator = generator
        self.reads_latent, self.warm_start = latent, warm_start
        self.first_step(sampler)  # raises if they do not fit each other

    def first_step(self, sampler: Sampler) -> int:
        """Where the chain of a sampler begins: at its noisiest step, with a warm start at the noisiest up to that one.

        Raises:
            ValueError: if the sampler has more steps than the schedule, or none at or below ``warm_start``.
        """
        steps = sampler.timesteps(self.schedule)
        if self.warm_start is None:
            return steps[0]
        if not steps[-1] <= self.warm_start < self.schedule.num_steps:
            allowed = f"{steps[-1]}, the lowest step of {sampler}, to {self.schedule.num_steps - 1}"
            raise ValueError(f"warm_start: got {self.warm_start}, must be from {allowed}")
        return next(step for step in steps if step <= self.warm_start)

    def forward(self, *inputs: Tensor, sampler: Sampler | None = None) -> Tensor | tuple[Tensor, Tensor]:
        """Sample actions ``[*B, A]``.

        Args:
            inputs: embeddings ``[*B, H]`` (several are concatenated), then the latent ``[*B, A]`` where one is read,
                then the previous action ``[*B, A]`` in [-1, 1] with a warm start.
            sampler: in place of the policy's own, for this call.

        Returns:
            the action within the bounds; with a warm start also the same in [-1, 1], for the next step.
        """
        count = len(inputs) - int(self.reads_latent) - int(self.warm_start is not None)
        embedding, kept = inputs[:count], inputs[count:]
        deterministic = exploration_type() not in (ExplorationType.RANDOM, None)
        shape, device = (*embedding[0].shape[:-1], self.low.shape[-1]), embedding[0].device
        dtype = torch.promote_types(self.low.dtype, torch.float32)
        if self.reads_latent:
            latent = kept[0].to(dtype)
        elif deterministic:
            latent = torch.zeros(shape, dtype=dtype, device=device)
        else:
            latent = torch.randn(shape, dtype=dtype, device=device, generator=self.generator)
        sampler = sampler or self.sampler
        start = self.first_step(sampler)
        if self.warm_start is not None:
            signal = self.schedule.signal(start)
            latent = signal**0.5 * kept[-1] + (1 - signal) ** 0.5 * latent
        steps = [step for step in sampler.timesteps(self.schedule) if step <= start]
        denoise = self._conditioned(steps, *embedding)
        action = sampler(denoise, latent, self.schedule, self.generator, deterministic, start)
        return self.denormalize(action) if self.warm_start is None else (self.denormalize(action), action)

    def action_loss(self, action: Tensor, *embedding: Tensor) -> Tensor:
        """Squared error of the predicted noise at a random step, Eq. 1 with Eq. 9: ``[*B]``, mean over A.

        Args:
            action: clean actions ``[*B, A]`` within the bounds.
            embedding: ``[*B, H]``; several are concatenated.

        Raises:
            ValueError: if the shapes do not fit each other.
        """
        self.check_action(action, *embedding)
        clean = self.normalize(action)
        shape, device = clean.shape[:-1], clean.device
        step = torch.randint(self.schedule.num_steps, shape, device=device, generator=self.generator)
        noise = torch.randn(clean.shape, dtype=clean.dtype, device=device, generator=self.generator)
        condition = torch.cat(embedding, -1) if len(embedding) > 1 else embedding[0]
        predicted = self.denoiser(self.schedule.add_noise(clean, noise, step), step, condition).to(clean.dtype)
        return (predicted - noise).square().mean(-1)

    def _conditioned(self, steps: list[int], *embedding: Tensor) -> Denoise:
        """The denoiser given the embedding, back in the chain's type."""
        condition = torch.cat(embedding, -1) if len(embedding) > 1 else embedding[0]
        prepare: Callable[[Tensor, list[int]], Denoise] | None = getattr(self.denoiser, "prepare", None)
        if prepare is not None:
            prepared = prepare(condition, steps)
            return lambda action, step: prepared(action, step).to(action.dtype)

        def denoise(action: Tensor, step: int) -> Tensor:
            return self.denoiser(action, torch.full((), step, device=action.device), condition).to(action.dtype)

        return denoise
