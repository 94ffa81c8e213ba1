"""The sampling loop as the authors of DIPO wrote it, ported plainly: what a policy costs without any of our care.

After ``agent/diffusion.py`` and ``agent/model.py`` of https://github.com/BellmanTimeHut/DIPO: coefficients are buffers
that each step gathers from, the step is embedded anew each time, action, step and state are concatenated, and noise is
drawn at the last step too, to be multiplied by zero. Their small perceptron behind the step's embedding is left out, so
that the network is the same as ours.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from redig.modules import DenoisingMLP, NoiseSchedule


class StepEmbedding(nn.Module):
    """Sinusoidal embedding of the step ``[N]``: ``[N, dim]``."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.dim = dim

    def forward(self, step: Tensor) -> Tensor:
        """Sines, then cosines."""
        half = self.dim // 2
        frequency = torch.exp(torch.arange(half, device=step.device) * -(math.log(10_000) / (half - 1)))
        angle = step[:, None] * frequency[None, :]
        return torch.cat([angle.sin(), angle.cos()], -1)


class PlainNetwork(nn.Module):
    """The layers of a :class:`~redig.modules.DenoisingMLP`, asked plainly."""

    def __init__(self, denoiser: DenoisingMLP) -> None:
        super().__init__()
        self.time = StepEmbedding(denoiser.step_dim)
        self.layers = denoiser.net

    def forward(self, action: Tensor, step: Tensor, state: Tensor) -> Tensor:
        """Predicted noise ``[N, A]``."""
        return self.layers(torch.cat([action, self.time(step), state], -1))


class DIPOLoop(nn.Module):
    """Ancestral sampling with gathered coefficients."""

    clean_of_action: Tensor
    clean_of_noise: Tensor
    mean_of_clean: Tensor
    mean_of_action: Tensor
    log_variance: Tensor

    def __init__(self, denoiser: DenoisingMLP, schedule: NoiseSchedule) -> None:
        super().__init__()
        self.network, self.num_steps, self.action_dim = PlainNetwork(denoiser), schedule.num_steps, denoiser.action_dim
        kept = torch.tensor([schedule.signal(k) for k in range(-1, self.num_steps)], dtype=torch.float64)
        before, after = kept[:-1], kept[1:]
        beta = 1 - after / before
        variance = beta * (1 - before) / (1 - after)
        self.register_buffer("clean_of_action", (1 / after).sqrt().float())
        self.register_buffer("clean_of_noise", (1 / after - 1).sqrt().float())
        self.register_buffer("mean_of_clean", (beta * before.sqrt() / (1 - after)).float())
        self.register_buffer("mean_of_action", ((1 - before) * (after / before).sqrt() / (1 - after)).float())
        self.register_buffer("log_variance", variance.clamp_min(1e-20).log().float())

    @torch.no_grad()
    def forward(self, state: Tensor) -> Tensor:
        """Actions ``[N, A]`` in [-1, 1] for states ``[N, H]``."""
        action = torch.randn(len(state), self.action_dim)
        for k in reversed(range(self.num_steps)):
            action = self.denoised_once(action, torch.full((len(state),), k, dtype=torch.long), state)
        return action.clamp(-1, 1)

    def denoised_once(self, action: Tensor, step: Tensor, state: Tensor) -> Tensor:
        """A sample of the posterior one step lower."""
        noise = self.network(action, step, state)
        clean = gathered(self.clean_of_action, step) * action - gathered(self.clean_of_noise, step) * noise
        clean = clean.clamp(-1, 1)
        mean = gathered(self.mean_of_clean, step) * clean + gathered(self.mean_of_action, step) * action
        log_variance = gathered(self.log_variance, step)
        fresh = torch.randn_like(action)
        not_last = (1 - (step == 0).float()).reshape(-1, 1)
        return mean + not_last * (0.5 * log_variance).exp() * fresh


def gathered(coefficients: Tensor, step: Tensor) -> Tensor:
    """A coefficient for each row: ``[N, 1]``."""
    return coefficients.gather(-1, step).reshape(-1, 1)
