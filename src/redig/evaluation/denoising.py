"""From noise to action: every state of a policy's denoising chain (Fig. 3)."""

from __future__ import annotations

import torch
from torch import Tensor

from redig.modules import DiffusionActor, Sampler


@torch.no_grad()
def denoising_path(
    actor: DiffusionActor, embedding: Tensor, latent: Tensor, sampler: Sampler | None = None
) -> tuple[list[int], Tensor]:
    """Every state of the chain that turns latents into actions.

    Args:
        actor: the diffusion actor; its ``generator`` is the source of the sampler's noise.
        embedding: ``[*B, H]``, as the actor's encoder gives it.
        latent: ``[*B, A]``, standard normal noise.
        sampler: in place of the actor's own.

    Returns:
        The S steps of the states, counted as in the paper, so the first is the noisiest, and the last, 0, the action;
        and the states ``[S, *B, A]`` (m/s), in the scale of the action's bounds; before the last they may leave them.

    Examples:
        >>> import torch
        >>> from torchrl.data import Bounded
        >>> from redig.modules import DDIM, DenoisingMLP
        >>> actor = DiffusionActor(DenoisingMLP(2, 8), Bounded(-1, 1, (5, 2)))
        >>> steps, velocity = denoising_path(actor, torch.randn(5, 8), torch.randn(5, 2), DDIM(num_steps=4))
        >>> steps, velocity.shape
        ([100, 75, 50, 25, 0], torch.Size([5, 5, 2]))
    """
    policy = actor.module
    steps: list[int] = []
    states: list[Tensor] = []

    def denoise(action: Tensor, step: int) -> Tensor:
        steps.append(step + 1)  # the paper counts from 1
        states.append(action)
        return policy.denoiser(action, torch.tensor(step, device=action.device), embedding).to(action.dtype)

    states.append((sampler or policy.sampler)(denoise, latent, policy.schedule, policy.generator))
    middle, half = (policy.high + policy.low) / 2, (policy.high - policy.low) / 2
    return [*steps, 0], middle + half * torch.stack(states)
