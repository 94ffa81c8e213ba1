"""Networks of the PPO baselines: a decentralised Gaussian policy and a value on graph encoders (DGNN, AFOR).

DGNN follows Blumenkamp et al., "A Framework for Real-World Multi-Robot Systems Running Decentralized GNN-Based
Policies" (2022); AFOR is the same network with the spring-damper reward. They differ from ReDiG's networks in the head
only: a squashed Gaussian in place of the diffusion chain, V(h) in place of Q(h, a).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict.nn import (
    AddStateIndependentNormalScale,
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import TanhNormal

from redig.modules.denoiser import mlp


def gaussian_policy(
    encoder: TensorDictModule,
    embedding_dim: int,
    low: Tensor,
    high: Tensor,
    hidden: Sequence[int] = (128, 128),
    activation: str = "tanh",
    initial_std: float = 0.5,
    action_key: NestedKey = ("agents", "action"),
) -> ProbabilisticTensorDictSequential:
    """A decentralised policy: encoder, perceptron, Gaussian squashed to the bounds of the action.

    The standard deviation before squashing is a parameter, one for each number of the action, as usual with PPO.
    With ``ExplorationType.RANDOM`` (or none set) actions are sampled, otherwise the action is the squashed mean.

    Args:
        encoder: from the observation to one key, the embedding ``[*B, n, H]``.
        embedding_dim: H.
        low: lower bounds of the action ``[A]`` (m/s).
        high: upper bounds.
        hidden: widths of the hidden layers.
        activation: see :func:`~redig.modules.denoiser.mlp`.
        initial_std: standard deviation at first.
        action_key: where the action goes; ``loc``, ``scale`` and ``action_log_prob`` go beside it.

    Returns:
        module that writes ``action`` ``[*B, n, A]`` and ``action_log_prob`` ``[*B, n]``.

    Raises:
        ValueError: if ``initial_std`` is not positive, or for an unknown activation.

    Examples:
        >>> from tensordict import TensorDict
        >>> from redig.modules import GraphEncoder
        >>> encoder = TensorDictModule(GraphEncoder(9), [("agents", "observation")], [("agents", "embedding")])
        >>> policy = gaussian_policy(encoder, 64, -torch.ones(2), torch.ones(2))
        >>> team = policy(TensorDict({"agents": {"observation": torch.randn(8, 5, 9)}}, [8]))
        >>> team["agents", "action"].shape, team["agents", "action_log_prob"].shape
        (torch.Size([8, 5, 2]), torch.Size([8, 5]))
    """
    if not initial_std > 0:
        raise ValueError(f"initial_std: got {initial_std}, must be greater than 0")
    loc, scale, log_prob = (_beside(action_key, name) for name in ("loc", "scale", "action_log_prob"))
    head = mlp(embedding_dim, hidden, len(low), activation)
    _orthogonal(head, output_gain=0.01)
    std = AddStateIndependentNormalScale(len(low), scale_mapping="exp")
    nn.init.constant_(std.state_independent_scale, math.log(initial_std))
    return ProbabilisticTensorDictSequential(
        encoder,
        TensorDictModule(nn.Sequential(head, std), in_keys=encoder.out_keys, out_keys=[loc, scale]),
        ProbabilisticTensorDictModule(
            in_keys={"loc": loc, "scale": scale},
            out_keys=[action_key],
            distribution_class=TanhNormal,
            distribution_kwargs={"low": low, "high": high},
            default_interaction_type=InteractionType.RANDOM,
            return_log_prob=True,
            log_prob_key=log_prob,
        ),
    )


def state_value(
    encoder: TensorDictModule,
    embedding_dim: int,
    hidden: Sequence[int] = (128, 128),
    activation: str = "tanh",
    centralised: bool = False,
    value_key: NestedKey = ("agents", "state_value"),
) -> TensorDictSequential:
    """V(h_i) on an encoder of its own.

    Args:
        encoder: from the observation to one key, which must not be the policy's embedding.
        embedding_dim: H.
        hidden: widths of the hidden layers.
        activation: see :func:`~redig.modules.denoiser.mlp`.
        centralised: give each robot's value the mean embedding of the whole team too, in and out of range.
        value_key: where the value ``[*B, n, 1]`` goes.

    Examples:
        >>> from tensordict import TensorDict
        >>> from redig.modules import GraphEncoder
        >>> encoder = TensorDictModule(GraphEncoder(9), [("agents", "observation")], [("agents", "value_embedding")])
        >>> value = state_value(encoder, 64)
        >>> value(TensorDict({"agents": {"observation": torch.randn(8, 5, 9)}}, [8]))["agents", "state_value"].shape
        torch.Size([8, 5, 1])
    """
    head = mlp(embedding_dim * (1 + centralised), hidden, 1, activation)
    _orthogonal(head, output_gain=1.0)
    module = nn.Sequential(TeamMean(), head) if centralised else head
    return TensorDictSequential(encoder, TensorDictModule(module, in_keys=encoder.out_keys, out_keys=[value_key]))


class TeamMean(nn.Module):
    """Each robot's embedding beside the mean of its team's: ``[*B, n, H]`` to ``[*B, n, 2 H]``.

    Examples:
        >>> TeamMean()(torch.tensor([[1.0], [3.0]]))
        tensor([[1., 2.],
                [3., 2.]])
    """

    def forward(self, embedding: Tensor) -> Tensor:
        """See the class."""
        return torch.cat([embedding, embedding.mean(-2, keepdim=True).expand_as(embedding)], -1)


def _orthogonal(net: nn.Sequential, output_gain: float) -> None:
    """Initialise a perceptron as PPO likes it: orthogonal, gain sqrt(2), zero biases, a small last layer."""
    layers = [layer for layer in net if isinstance(layer, nn.Linear)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, output_gain if layer is layers[-1] else math.sqrt(2))
        nn.init.zeros_(layer.bias)


def _beside(key: NestedKey, name: str) -> NestedKey:
    return name if isinstance(key, str) else (*key[:-1], name)
