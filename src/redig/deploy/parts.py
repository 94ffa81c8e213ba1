"""The two parts of a policy that are translated to ONNX: what comes before the chain, and one step of the denoiser."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from redig.modules import DenoisingMLP, GraphEncoder
from redig.modules.denoiser import sinusoidal_embedding


class TeamEncoder(nn.Module):
    """:class:`~redig.modules.GraphEncoder` in operations that ONNX has, for any team size, its weights shared.

    Args:
        encoder: whose layers it uses.
        ego: embed only the first robot of each team, from its own state and the messages that it hears.

    Examples:
        >>> encoder, teams = GraphEncoder(in_features=9), torch.randn(8, 5, 9)
        >>> torch.allclose(TeamEncoder(encoder)(teams), encoder(teams), atol=1e-5)
        True
        >>> torch.allclose(TeamEncoder(encoder, ego=True)(teams), encoder(teams)[:, :1], atol=1e-5)
        True
    """

    def __init__(self, encoder: GraphEncoder, ego: bool = False) -> None:
        super().__init__()
        self.encoder, self.ego = encoder, ego

    def forward(self, observation: Tensor) -> Tensor:
        """Embeddings ``[B, n, H]``, or ``[B, 1, H]`` of the first robots, from observations ``[B, n, F]``."""
        encoder = self.encoder
        z, position = encoder.act(encoder.lift(observation)), observation[..., :2]
        number = torch.arange(observation.shape[-2], device=observation.device)
        listening = slice(None, 1) if self.ego else slice(None)
        offset = position.unsqueeze(-3) - position[:, listening].unsqueeze(-2)  # [B, i, j, 2] = p_j - p_i
        distance = offset.square().sum(-1, keepdim=True).sqrt()
        oneself = number[listening].unsqueeze(-1) == number
        near = (distance <= encoder.radius) & ~oneself.unsqueeze(-1)
        carried = observation if encoder.edge_features == "state" else position
        messages = self._messages(z, carried, distance, listening)
        if encoder.aggregation == "max":
            heard = torch.where(near, messages, torch.finfo(messages.dtype).min).amax(-2)
            heard = torch.where(near.any(-2), heard, 0.0)
        else:
            heard = torch.where(near, messages, 0.0).sum(-2)
            if encoder.aggregation == "mean":
                heard = heard / near.sum(-2).clamp_min(1)
        if encoder.kind == "linear":
            return encoder.act(encoder.out(z[:, listening]) + heard)
        return encoder.act(encoder.out(torch.cat([z[:, listening], heard], -1)))

    def _messages(self, z: Tensor, carried: Tensor, distance: Tensor, listening: slice) -> Tensor:
        """What each listening robot would hear from each robot of its team: ``[B, i, j, H]``."""
        encoder = self.encoder
        if encoder.kind == "linear":
            sent = encoder.out(z)
            return sent.unsqueeze(-3) - sent[:, listening].unsqueeze(-2)
        edge = encoder.message_edge.weight
        mate = encoder.message_mate(z) + carried @ edge[:, :-1].T
        mine = encoder.message_self(z[:, listening]) - mate[:, listening]
        hidden = mine.unsqueeze(-2) + mate.unsqueeze(-3) + distance * edge[:, -1]
        return encoder.message_out(encoder.act(hidden))


class Condition(nn.Module):
    """What the chain is given, one row a robot: the embedding, or the denoiser's first layer of it.

    Args:
        encoder: from observations ``[B, n, F]`` to embeddings ``[B, n, H]``, or ``nn.Identity()``.
        denoiser: as made by :func:`denoiser_step`.
        ego: keep the first robot of each team only.

    Examples:
        >>> step = denoiser_step(DenoisingMLP(action_dim=2, embedding_dim=64))
        >>> Condition(nn.Identity(), step)(torch.zeros(8, 5, 64)).shape
        torch.Size([40, 256])
    """

    def __init__(self, encoder: nn.Module, denoiser: MLPStep | AnyStep, ego: bool = False) -> None:
        super().__init__()
        self.encoder = TeamEncoder(encoder, ego) if isinstance(encoder, GraphEncoder) else encoder
        self.denoiser: MLPStep | AnyStep = denoiser
        self.ego = ego

    def forward(self, observation: Tensor) -> Tensor:
        """Rows ``[B n, C]`` for observations ``[B, n, F]``; ``[B, C]`` of the first robots."""
        embedding = self.encoder(observation)
        if self.ego:
            embedding = embedding[:, :1]
        return self.denoiser.condition(embedding.flatten(0, -2))


class MLPStep(nn.Module):
    """A :class:`~redig.modules.DenoisingMLP` whose first layer takes the embedding's and the step's part ready-made.

    Args:
        denoiser: whose layers it uses.

    Examples:
        >>> denoiser, embedding, action = DenoisingMLP(2, 64), torch.randn(5, 64), torch.randn(5, 2)
        >>> step = MLPStep(denoiser)
        >>> noise = step(action, step.times([99])[0], step.condition(embedding))
        >>> torch.allclose(noise, denoiser(action, torch.tensor(99), embedding), atol=1e-6)
        True
    """

    def __init__(self, denoiser: DenoisingMLP) -> None:
        super().__init__()
        first, *rest = denoiser.net
        assert isinstance(first, nn.Linear)
        widths = [denoiser.action_dim, denoiser.step_dim, denoiser.embedding_dim]
        self.of_action, self.of_time, self.of_embedding = (
            nn.Parameter(weight.clone()) for weight in first.weight.split(widths, 1)
        )
        self.bias = first.bias
        self.rest = nn.Sequential(*rest)

    def condition(self, embedding: Tensor) -> Tensor:
        """Part of the first layer ``[N, C]`` that the embeddings ``[N, H]`` make."""
        return nn.functional.linear(embedding, self.of_embedding, self.bias)

    def times(self, steps: Sequence[int]) -> Tensor:
        """Parts of the first layer ``[S, C]`` that the steps make."""
        width = self.of_time.shape[1]
        return nn.functional.linear(sinusoidal_embedding(torch.tensor(steps).float(), width), self.of_time)

    def forward(self, action: Tensor, time: Tensor, condition: Tensor) -> Tensor:
        """Noise ``[N, A]`` in actions ``[N, A]``."""
        return self.rest(nn.functional.linear(action, self.of_action, time) + condition)


class AnyStep(nn.Module):
    """Any other denoiser ``(action, step, embedding) -> noise``, asked at each step as it is.

    Examples:
        >>> step = AnyStep(DenoisingMLP(2, 64))
        >>> step(torch.zeros(5, 2), step.times([99])[0], step.condition(torch.zeros(5, 64))).shape
        torch.Size([5, 2])
    """

    def __init__(self, denoiser: nn.Module) -> None:
        super().__init__()
        self.denoiser = denoiser

    def condition(self, embedding: Tensor) -> Tensor:
        """The embedding."""
        return embedding

    def times(self, steps: Sequence[int]) -> Tensor:
        """The steps ``[S]``."""
        return torch.tensor(steps)

    def forward(self, action: Tensor, time: Tensor, condition: Tensor) -> Tensor:
        """Noise ``[N, A]`` in actions ``[N, A]``."""
        return self.denoiser(action, time, condition)


def denoiser_step(denoiser: nn.Module) -> MLPStep | AnyStep:
    """One step of a denoiser, in the fastest form that is known for it.

    Examples:
        >>> type(denoiser_step(DenoisingMLP(2, 64))).__name__
        'MLPStep'
    """
    return MLPStep(denoiser) if type(denoiser) is DenoisingMLP else AnyStep(denoiser)
