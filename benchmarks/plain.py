"""One update of ReDiG written plainly, as printed: the baseline of ``update.py`` and the oracle of its test.

Nothing here is from this library: no precomputed terms, no strided chains, one network after the other, one
concatenation a call.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn


class PlainUpdate:
    """Critic loss with a target policy sampled by the whole chain, refinement, and diffusion loss.

    Args:
        encoder, critic_encoder: ``observation [B, n, F] -> embedding [B, n, H]``, of the actor and of the critics.
        denoiser: ``(noisy action, step, embedding) -> noise``.
        critics: ``(embedding, action) -> value [B, n, 1]``, twice.
        targets: the four of them again, in the same order, as target networks.
        alphas_cumprod: of the noise schedule ``[K]``.
        gamma: discount of the transition, ``gamma ** n`` for n-step returns.
        step_size, max_norm: of the refinement.
    """

    def __init__(
        self,
        encoder: nn.Module,
        critic_encoder: nn.Module,
        denoiser: nn.Module,
        critics: list[nn.Module],
        targets: tuple[nn.Module, nn.Module, nn.Module, list[nn.Module]],
        alphas_cumprod: Tensor,
        gamma: float,
        step_size: float,
        max_norm: float,
    ) -> None:
        self.encoder, self.critic_encoder, self.denoiser, self.critics = encoder, critic_encoder, denoiser, critics
        self.targets, self.alphas, self.gamma = targets, alphas_cumprod, gamma
        self.step_size, self.max_norm = step_size, max_norm

    def sample(self, denoiser: nn.Module, embedding: Tensor) -> Tensor:
        """The whole reverse chain with the posterior mean (Eq. 7), step by step."""
        action = torch.randn(*embedding.shape[:-1], 2)
        for k in reversed(range(len(self.alphas))):
            alpha = self.alphas[k]
            noise = denoiser(action, torch.full(action.shape[:-1], k), embedding)
            clean = ((action - (1 - alpha).sqrt() * noise) / alpha.sqrt()).clamp(-1, 1)
            if k == 0:
                return clean
            before = self.alphas[k - 1]
            ratio = alpha / before
            c0, ck = before.sqrt() * (1 - ratio) / (1 - alpha), ratio.sqrt() * (1 - before) / (1 - alpha)
            action = c0 * clean + ck * action
        raise AssertionError("a schedule has at least one step")

    def critic_loss(self, state: Tensor, action: Tensor, reward: Tensor, following: Tensor, ended: Tensor) -> Tensor:
        """Eq. 2 with twin target critics."""
        encoder, critic_encoder, denoiser, critics = self.targets
        with torch.no_grad():
            next_action = self.sample(denoiser, encoder(following))
            embedding = critic_encoder(following)
            next_value = torch.minimum(critics[0](embedding, next_action), critics[1](embedding, next_action))
            target = reward + self.gamma * next_value * (1 - ended)
        embedding = self.critic_encoder(state)
        return sum((critic(embedding, action) - target).square().mean() for critic in self.critics)

    def refine(self, state: Tensor, action: Tensor) -> Tensor:
        """One step along the gradient of min(Q1, Q2)."""
        with torch.no_grad():
            embedding = self.critic_encoder(state)
        candidate = action.clone().requires_grad_()
        value = torch.minimum(self.critics[0](embedding, candidate), self.critics[1](embedding, candidate))
        shift = self.step_size * torch.autograd.grad(value.sum(), candidate)[0]
        norm = shift.norm(dim=-1, keepdim=True)
        return (action + shift * (self.max_norm / norm.clamp_min(self.max_norm))).clamp(-1, 1).detach()

    def actor_loss(self, state: Tensor, action: Tensor) -> Tensor:
        """Eq. 1 with Eq. 9 on refined actions."""
        refined = self.refine(state, action)
        step = torch.randint(len(self.alphas), refined.shape[:-1])
        noise = torch.randn_like(refined)
        alpha = self.alphas[step].unsqueeze(-1)
        noisy = alpha.sqrt() * refined + (1 - alpha).sqrt() * noise
        return (self.denoiser(noisy, step, self.encoder(state)) - noise).square().mean()


class PlainDenoiser(nn.Module):
    """The denoising perceptron: concatenate, then layer after layer."""

    def __init__(self, hidden: int, embedding_dim: int = 64, step_dim: int = 16, activation: type[nn.Module] = nn.Mish):
        super().__init__()
        widths = [2 + step_dim + embedding_dim, hidden, hidden, hidden]
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Linear(before, after), activation()]
        self.net = nn.Sequential(*layers, nn.Linear(hidden, 2))
        self.step_dim = step_dim

    def forward(self, action: Tensor, step: Tensor, embedding: Tensor) -> Tensor:
        """Noise in an action."""
        half = self.step_dim // 2
        frequency = torch.exp(-math.log(10_000) * torch.arange(half) / (half - 1))
        angle = step.unsqueeze(-1) * frequency
        return self.net(torch.cat([action, angle.sin(), angle.cos(), embedding], -1))


class PlainEncoder(nn.Module):
    """EdgeConv over all pairs of a team, the features of each pair concatenated."""

    def __init__(self, in_features: int = 9, embedding_dim: int = 64, hidden: int = 128, radius: float = 2.0) -> None:
        super().__init__()
        self.lift = nn.Linear(in_features, embedding_dim)
        self.message_in = nn.Linear(2 * embedding_dim + in_features + 1, hidden)
        self.message_out = nn.Linear(hidden, embedding_dim)
        self.out = nn.Linear(2 * embedding_dim, embedding_dim)
        self.radius = radius

    def forward(self, state: Tensor) -> Tensor:
        """Embeddings ``[B, n, H]`` of states ``[B, n, F]``."""
        n = state.shape[-2]
        z = torch.relu(self.lift(state))
        mine = z.unsqueeze(-2).expand(*z.shape[:-1], n, z.shape[-1])
        theirs = z.unsqueeze(-3).expand_as(mine)
        offset = state.unsqueeze(-3) - state.unsqueeze(-2)
        distance = offset[..., :2].norm(dim=-1, keepdim=True)
        pair = torch.cat([mine, theirs - mine, offset, distance], -1)
        message = self.message_out(torch.relu(self.message_in(pair)))
        near = (distance <= self.radius) & ~torch.eye(n, dtype=torch.bool).unsqueeze(-1)
        aggregate = message.masked_fill(~near, -torch.inf).amax(-2)
        aggregate = torch.where(near.any(-2), aggregate, 0)
        return torch.relu(self.out(torch.cat([z, aggregate], -1)))


class PlainCritic(nn.Module):
    """Q of one robot, with LayerNorm."""

    def __init__(self, hidden: int, embedding_dim: int = 64) -> None:
        super().__init__()
        widths = [embedding_dim + 2, hidden, hidden, hidden]
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Linear(before, after), nn.LayerNorm(after), nn.ReLU()]
        self.net = nn.Sequential(*layers, nn.Linear(hidden, 1))

    def forward(self, embedding: Tensor, action: Tensor) -> Tensor:
        """Value ``[B, n, 1]``."""
        return self.net(torch.cat([embedding, action], -1))
