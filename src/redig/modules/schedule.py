"""Noise schedules: how much of an action is left after k steps of noise, and the exact way back."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

SCHEDULES = ("cosine", "linear", "vp")


class NoiseSchedule(nn.Module):
    """Variances of the forward process (Sec. 3.2.1) and the posterior of Eq. 7.

    Steps are counted from 0: step ``k`` of the code is step ``k + 1`` of the paper, and ``alphas_cumprod[k]`` is the
    paper's alpha with a superscript. The paper's ``lambda^k (a^k - alpha^k eps)`` is not the mean of Eq. 7; the exact
    posterior is used instead (``docs/paper.md``).

    Args:
        num_steps: K, number of diffusion steps.
        kind: ``"cosine"`` (Nichol and Dhariwal, 2021), ``"linear"`` (Ho et al., 2020; betas 1e-4 to 0.02, which leave
            some signal at the last step unless K is about 1,000) or ``"vp"`` (variance preserving, as in DIPO).

    Raises:
        ValueError: for an unknown kind or fewer than one step.

    Examples:
        >>> schedule = NoiseSchedule(100, "cosine")
        >>> schedule.alphas_cumprod[-1].item() < 1e-3  # almost nothing of the action is left: no prior mismatch
        True
        >>> round(NoiseSchedule(100, "linear").alphas_cumprod[-1].item(), 2)
        0.36
    """

    betas: Tensor
    alphas_cumprod: Tensor

    def __init__(self, num_steps: int = 100, kind: str = "cosine") -> None:
        super().__init__()
        if num_steps < 1:
            raise ValueError(f"num_steps: got {num_steps}, must be at least 1")
        if kind not in SCHEDULES:
            raise ValueError(f"schedule: got {kind!r}, allowed are {', '.join(SCHEDULES)}")
        self.num_steps = num_steps
        self.kind = kind
        step = torch.arange(num_steps, dtype=torch.float64)
        if kind == "cosine":
            time = torch.arange(num_steps + 1, dtype=torch.float64) / num_steps
            signal = torch.cos((time + 0.008) / 1.008 * math.pi / 2).square()
            betas = (1 - signal[1:] / signal[:-1]).clamp_max(0.999)
        elif kind == "linear":
            betas = torch.linspace(1e-4, 0.02, num_steps, dtype=torch.float64)
        else:
            low, high = 0.1, 10.0
            betas = 1 - torch.exp(-low / num_steps - (high - low) * (2 * step + 1) / (2 * num_steps**2))
        self.register_buffer("betas", betas.float())
        self.register_buffer("alphas_cumprod", (1 - betas).cumprod(0).float())

    def add_noise(self, action: Tensor, noise: Tensor, step: Tensor) -> Tensor:
        """Forward process, Eq. 9: ``sqrt(alpha) a0 + sqrt(1 - alpha) eps``.

        Args:
            action: clean action ``[*B, A]``.
            noise: ``[*B, A]``.
            step: ``[*B]``, integers in ``[0, num_steps)``.

        Returns:
            noisy action ``[*B, A]``.
        """
        alpha = self.alphas_cumprod[step].unsqueeze(-1)
        return alpha.sqrt() * action + (1 - alpha).sqrt() * noise

    def posterior(self, step: int, previous: int) -> tuple[float, float, float]:
        """Coefficients of q(a^previous | a^step, a^0), Eq. 7 for neighbours and its generalisation for strided chains.

        Args:
            step: current step, in ``[0, num_steps)``.
            previous: an earlier step, or -1 for the clean action.

        Returns:
            ``(c0, ck, sigma)`` with mean ``c0 a^0 + ck a^step`` and standard deviation ``sigma``.

        Raises:
            ValueError: if ``-1 <= previous < step < num_steps`` does not hold.
        """
        if not -1 <= previous < step < self.num_steps:
            raise ValueError(f"step, previous: got {step}, {previous}, need -1 <= previous < step < {self.num_steps}")
        alpha = self.alphas_cumprod[step].item()
        alpha_previous = 1.0 if previous < 0 else self.alphas_cumprod[previous].item()
        ratio = alpha / alpha_previous
        c0 = math.sqrt(alpha_previous) * (1 - ratio) / (1 - alpha)
        ck = math.sqrt(ratio) * (1 - alpha_previous) / (1 - alpha)
        sigma = math.sqrt((1 - ratio) * (1 - alpha_previous) / (1 - alpha))
        return c0, ck, sigma
