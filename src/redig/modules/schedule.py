"""Noise schedules: how much of an action is left after k steps of noise, and the exact way back."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor, nn

SCHEDULES = ("cosine", "linear", "vp")
ModuleT = TypeVar("ModuleT", bound=nn.Module)


class NoiseSchedule(nn.Module):
    """Variances of the forward process (Sec. 3.2.1) and the posterior of Eq. 7.

    Steps are counted from 0: step ``k`` of the code is step ``k + 1`` of the paper, and ``alphas_cumprod[k]`` is the
    paper's alpha with a superscript. The paper's ``lambda^k (a^k - alpha^k eps)`` is not the mean of Eq. 7; the exact
    posterior is used instead (``docs/paper.md``).

    The variances stay in float32 or better when the module around them is moved to half precision, where the smallest
    would underflow; chains take them as Python numbers.

    Args:
        num_steps: K, number of diffusion steps.
        kind: ``"cosine"`` (Nichol and Dhariwal, 2021), ``"linear"`` (Ho et al., 2020; betas 1e-4 to 0.02, which leave
            some signal at the last step unless K is about 1,000) or ``"vp"`` (variance preserving, as in DIPO).

    Raises:
        ValueError: for an unknown kind, fewer than one step, or a state dict of another schedule.

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
        alphas_cumprod = (1 - betas).cumprod(0)
        self._signal: tuple[float, ...] = (*alphas_cumprod.tolist(), 1.0)  # the last stands for the clean action, -1
        self.register_buffer("betas", betas.float())
        self.register_buffer("alphas_cumprod", alphas_cumprod.float())

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> NoiseSchedule:
        return keep_precision(self, super()._apply, fn, recurse)

    def _load_from_state_dict(self, state_dict, prefix, *args) -> None:
        loaded = state_dict.get(f"{prefix}alphas_cumprod", self.alphas_cumprod).double().cpu()
        expected = torch.tensor(self._signal[:-1], dtype=torch.float64)
        if loaded.shape != expected.shape or not torch.allclose(loaded, expected, rtol=1e-2, atol=1e-12):
            raise ValueError(
                f"schedule: the weights are of another schedule than {self.kind!r} of {self.num_steps} steps, or were "
                "saved in float16"
            )
        super()._load_from_state_dict(state_dict, prefix, *args)

    def signal(self, step: int) -> float:
        """``alphas_cumprod[step]`` as a Python number in double precision; 1 for the clean action, step -1.

        Raises:
            ValueError: if ``-1 <= step < num_steps`` does not hold.
        """
        if not -1 <= step < self.num_steps:
            raise ValueError(f"step: got {step}, need -1 <= step < {self.num_steps}")
        return self._signal[step]

    def add_noise(self, action: Tensor, noise: Tensor, step: Tensor) -> Tensor:
        """Forward process, Eq. 9: ``sqrt(alpha) a0 + sqrt(1 - alpha) eps``.

        Args:
            action: clean action ``[*B, A]``.
            noise: ``[*B, A]``.
            step: ``[*B]``, integers in ``[0, num_steps)``.

        Returns:
            noisy action ``[*B, A]``, in float32 or better.

        Raises:
            ValueError: if the shapes do not fit each other.
        """
        if noise.shape != action.shape or step.shape != action.shape[:-1]:
            raise ValueError(
                f"step: got shape {list(step.shape)} for actions {list(action.shape)} and noise {list(noise.shape)}, "
                f"expected {list(action.shape[:-1])} and noise like the actions"
            )
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
        alpha, alpha_previous = self.signal(step), self.signal(previous)
        ratio = alpha / alpha_previous
        c0 = math.sqrt(alpha_previous) * (1 - ratio) / (1 - alpha)
        ck = math.sqrt(ratio) * (1 - alpha_previous) / (1 - alpha)
        sigma = math.sqrt((1 - ratio) * (1 - alpha_previous) / (1 - alpha))
        return c0, ck, sigma


def keep_precision(module: ModuleT, apply: Callable, fn: Callable[[Tensor], Tensor], recurse: bool) -> ModuleT:
    """``nn.Module._apply`` that moves the module's own buffers to another device, but never below float32.

    Examples:
        >>> NoiseSchedule(1000).to(torch.bfloat16).alphas_cumprod.dtype  # its _apply is this one
        torch.float32
    """
    before = dict(module._buffers)
    apply(fn, recurse)
    for name, buffer in before.items():
        moved = module._buffers[name]
        if buffer is not None and moved is not None and moved.dtype in (torch.float16, torch.bfloat16):
            module._buffers[name] = buffer.to(moved.device)
    return module
