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
class Sampler:
    """The chain that all samplers share: estimate the clean action, clamp it to [-1, 1], go to the next lower step.

    A sampler of one's own gives :meth:`coefficients`.

    Args:
        num_steps: steps that are taken, spread evenly over the schedule; ``None`` takes all of them.

    Raises:
        ValueError: if a number of steps is not positive or more than there are.

    Examples:
        >>> import torch
        >>> from redig.modules import NoiseSchedule
        >>> class Renoise(Sampler):  # noises the estimate afresh at every step, as consistency models do
        ...     def coefficients(self, schedule, step, previous, older, deterministic):
        ...         signal = schedule.signal(previous)
        ...         return signal**0.5, 0.0, 0.0, (1 - signal) ** 0.5
        >>> toward = lambda action, step: torch.zeros_like(action)  # a denoiser that sees no noise anywhere
        >>> Renoise(num_steps=3)(toward, torch.ones(4, 2), NoiseSchedule(100)).shape
        torch.Size([4, 2])
    """

    num_steps: int | None = None

    def __post_init__(self) -> None:
        self._check_count("num_steps")

    def _check_count(self, name: str) -> None:
        value = getattr(self, name)
        if value is not None and value < 1:
            raise ValueError(f"{name}: got {value}, must be at least 1")

    def timesteps(self, schedule: NoiseSchedule) -> list[int]:
        """Steps of the chain, noisiest first."""
        total = schedule.num_steps
        count = self.num_steps or total
        if count > total:
            raise ValueError(f"num_steps: the sampler asks for {count} steps, the schedule has {total}")
        return [math.ceil(total * (i + 1) / count) - 1 for i in reversed(range(count))]

    def coefficients(
        self, schedule: NoiseSchedule, step: int, previous: int, older: int | None, deterministic: bool
    ) -> tuple[float, float, float, float]:
        """One transition from ``step`` to ``previous``, the next lower step of the chain.

        Args:
            schedule: the noise schedule.
            step: where the chain is.
            previous: where it goes.
            older: the step before ``step`` in the chain, ``None`` at its start.
            deterministic: whether noise is unwanted.

        Returns:
            four factors, in this order of the estimate of ``a^0`` at this step, of ``a^step``, of the estimate of
            ``a^0`` at the step before, and of fresh noise.
        """
        raise NotImplementedError

    def __call__(
        self,
        denoise: Denoise,
        latent: Tensor,
        schedule: NoiseSchedule,
        generator: torch.Generator | None = None,
        deterministic: bool = False,
        start: int | None = None,
    ) -> Tensor:
        """Run the chain.

        Args:
            denoise: noise prediction.
            latent: ``a^K``, ``[*B, A]``; or ``a^start``.
            schedule: the schedule that the denoiser was trained with.
            generator: source of the noise.
            deterministic: add no noise, whatever the sampler's options say.
            start: take only the steps of the chain up to this one (warm start).

        Returns:
            action ``[*B, A]`` in [-1, 1].

        Raises:
            ValueError: if no step of the chain is at or below ``start``, or the latent's type cannot hold the smallest
                coefficient of the schedule (float16 with a long schedule).
        """
        steps = self.timesteps(schedule)
        if start is not None:
            steps = [step for step in steps if step <= start]
            if not steps:
                raise ValueError(f"start: got {start}, the chain's lowest step is {self.timesteps(schedule)[-1]}")
        smallest = math.sqrt(schedule.signal(steps[0]))
        if smallest < torch.finfo(latent.dtype).tiny:
            raise ValueError(
                f"latent: {latent.dtype} cannot hold sqrt(alphas_cumprod[{steps[0]}]) = {smallest:.1e} of the "
                "schedule; run the chain in float32 (DiffusionActor does, whatever the type of its network)"
            )
        action, older_clean, older = latent, latent, None
        for i, step in enumerate(steps):
            signal = schedule.signal(step)
            clean = torch.add(action / math.sqrt(signal), denoise(action, step), alpha=-math.sqrt(1 / signal - 1))
            clean = clean.clamp(-1, 1)
            if i + 1 == len(steps):
                break
            c0, ck, c_older, sigma = self.coefficients(schedule, step, steps[i + 1], older, deterministic)
            action = torch.add(ck * action, clean, alpha=c0)
            if c_older:
                action = torch.add(action, older_clean, alpha=c_older)
            if sigma > 0 and not deterministic:
                noise = torch.randn(action.shape, dtype=action.dtype, device=action.device, generator=generator)
                action = torch.add(action, noise, alpha=sigma)
            older_clean, older = clean, step
        return clean


@dataclass(frozen=True)
class DDPM(Sampler):
    """Ancestral sampling with the exact posterior (Eq. 7; Ho et al., 2020).

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

    noise_ratio: float = 1.0
    early_stop: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_count("early_stop")
        if not self.noise_ratio >= 0:
            raise ValueError(f"noise_ratio: got {self.noise_ratio}, must be at least 0")

    def timesteps(self, schedule: NoiseSchedule) -> list[int]:
        """Steps of the chain until it stops, noisiest first."""
        return super().timesteps(schedule)[: self.early_stop]

    def coefficients(
        self, schedule: NoiseSchedule, step: int, previous: int, older: int | None, deterministic: bool
    ) -> tuple[float, float, float, float]:
        """Mean and noise of the posterior, see :meth:`Sampler.coefficients`."""
        c0, ck, sigma = schedule.posterior(step, previous)
        return c0, ck, 0.0, self.noise_ratio * sigma


@dataclass(frozen=True)
class DDIM(Sampler):
    """Denoising diffusion implicit models (Song et al., 2021), good with fewer steps than DDPM.

    The predicted noise is taken anew from the clamped estimate of ``a^0``, so that clamping does not leave the path.

    Args:
        num_steps: steps that are taken, spread evenly over the schedule; ``None`` takes all of them.
        eta: noise, from 0 (none: the action is a function of the latent) to 1 (as much as DDPM).

    Raises:
        ValueError: if a number of steps is not positive or more than there are, or ``eta`` is not in [0, 1].

    Examples:
        >>> import torch
        >>> from redig.modules import NoiseSchedule
        >>> schedule = NoiseSchedule(100)
        >>> def point(action, step):  # the exact noise of data that is 0.5 everywhere
        ...     return (action - 0.5 * schedule.signal(step) ** 0.5) / (1 - schedule.signal(step)) ** 0.5
        >>> DDIM(num_steps=4)(point, torch.randn(1, 2), schedule)
        tensor([[0.5000, 0.5000]])
    """

    eta: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.eta <= 1:
            raise ValueError(f"eta: got {self.eta}, must be in [0, 1]")

    def coefficients(
        self, schedule: NoiseSchedule, step: int, previous: int, older: int | None, deterministic: bool
    ) -> tuple[float, float, float, float]:
        """Eq. 12 of the DDIM paper, see :meth:`Sampler.coefficients`; without noise where it is unwanted."""
        sigma = 0.0 if deterministic else self.eta * schedule.posterior(step, previous)[2]
        signal, signal_previous = schedule.signal(step), schedule.signal(previous)
        ck = math.sqrt(max(1 - signal_previous - sigma**2, 0.0) / (1 - signal))
        return math.sqrt(signal_previous) - ck * math.sqrt(signal), ck, 0.0, sigma


@dataclass(frozen=True)
class DPMSolver(Sampler):
    """DPM-Solver++(2M) (Lu et al., 2022): second-order multistep solver of the probability-flow ODE, without noise.

    Its first and last steps are of first order, as the paper recommends for few steps.

    Args:
        num_steps: steps that are taken, spread evenly over the schedule; ``None`` takes all of them.

    Raises:
        ValueError: if the number of steps is not positive or more than there are.

    Examples:
        >>> import torch
        >>> from redig.modules import NoiseSchedule
        >>> toward = lambda action, step: torch.zeros_like(action)
        >>> DPMSolver(num_steps=5)(toward, torch.ones(3, 2), NoiseSchedule(100)).shape
        torch.Size([3, 2])
    """

    def coefficients(
        self, schedule: NoiseSchedule, step: int, previous: int, older: int | None, deterministic: bool
    ) -> tuple[float, float, float, float]:
        """Eq. 4.1 of the DPM-Solver++ paper in half log-SNR, see :meth:`Sampler.coefficients`."""
        signal, signal_previous = schedule.signal(step), schedule.signal(previous)
        h = _half_log_snr(signal_previous) - _half_log_snr(signal)
        gain = -math.sqrt(signal_previous) * math.expm1(-h)
        ck = math.sqrt((1 - signal_previous) / (1 - signal))
        if older is None:
            return gain, ck, 0.0, 0.0
        ratio = (_half_log_snr(signal) - _half_log_snr(schedule.signal(older))) / h
        return gain * (1 + 0.5 / ratio), ck, -gain * 0.5 / ratio, 0.0


def _half_log_snr(signal: float) -> float:
    return 0.5 * math.log(signal / (1 - signal))
