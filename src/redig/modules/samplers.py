"""Samplers: from noise back to an action, with the weights of one denoiser and any number of steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from redig.modules.schedule import NoiseSchedule

Denoise = Callable[[Tensor, int], Tensor]
"""Noise prediction ``eps(a^k [*B, A], k) -> [*B, A]``, already conditioned on the embedding."""


@dataclass(frozen=True)
class DDPM:
    """Ancestral sampling with the exact posterior (Eq. 7) and ``a^0`` clamped to the action range at each step.

    Args:
        num_steps: steps that are taken, spread evenly over the schedule; ``None`` takes all of them.
        noise_ratio: scale of the noise that is added at each step (Table 3: 1.0); 0 follows the posterior mean.
        early_stop: stop after this many of the steps and return the current estimate of ``a^0`` (F.7: 60 of 100).

    Raises:
        ValueError: if a number of steps is not positive or more than there are, or ``noise_ratio`` is negative.

    Examples:
        >>> import torch
        >>> from redig.modules import NoiseSchedule
        >>> toward = lambda action, step: torch.zeros_like(action)  # a denoiser that sees no noise anywhere
        >>> DDPM(num_steps=5)(toward, torch.ones(3, 2), NoiseSchedule(100)).shape
        torch.Size([3, 2])
    """

    num_steps: int | None = None
    noise_ratio: float = 1.0
    early_stop: int | None = None

    def __post_init__(self) -> None:
        for name in ("num_steps", "early_stop"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name}: got {value}, must be at least 1")
        if self.noise_ratio < 0:
            raise ValueError(f"noise_ratio: got {self.noise_ratio}, must be at least 0")

    def timesteps(self, schedule: NoiseSchedule) -> list[int]:
        """Steps of the chain, noisiest first."""
        total = schedule.num_steps
        count = self.num_steps or total
        if count > total:
            raise ValueError(f"num_steps: the sampler asks for {count} steps, the schedule has {total}")
        return [math.ceil(total * (i + 1) / count) - 1 for i in reversed(range(count))]

    def __call__(
        self,
        denoise: Denoise,
        latent: Tensor,
        schedule: NoiseSchedule,
        generator: torch.Generator | None = None,
        deterministic: bool = False,
    ) -> Tensor:
        """Run the chain.

        Args:
            denoise: noise prediction.
            latent: ``a^K``, ``[*B, A]``.
            schedule: the schedule that the denoiser was trained with.
            generator: source of the noise.
            deterministic: add no noise, whatever ``noise_ratio`` says.

        Returns:
            action ``[*B, A]`` in [-1, 1].
        """
        steps = self.timesteps(schedule)
        last = len(steps) - 1 if self.early_stop is None else min(self.early_stop, len(steps)) - 1
        action = latent
        for i, step in enumerate(steps[: last + 1]):
            alpha = schedule.alphas_cumprod[step]
            clean = (action - (1 - alpha).sqrt() * denoise(action, step)) / alpha.sqrt()
            clean = clean.clamp(-1, 1)
            if i == last:
                return clean
            c0, ck, sigma = schedule.posterior(step, steps[i + 1])
            action = c0 * clean + ck * action
            if self.noise_ratio > 0 and not deterministic:
                noise = torch.empty_like(action).normal_(generator=generator)
                action = action + self.noise_ratio * sigma * noise
        return action
