"""The critic Q(h_i, a_i): the value of one robot's action, given its team embedding."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from redig.modules.denoiser import check_shapes, mlp, weight_dtype


class QNetwork(nn.Module):
    """Q(h, a) of Sec. 3.2.2 as a perceptron.

    Args:
        embedding_dim: width of the embedding h.
        action_dim: A.
        hidden: widths of the hidden layers (the paper: 3 of 256).
        layer_norm: LayerNorm after each hidden layer; it keeps the critic from overrating actions outside the data
            (Ball et al., 2023).
        activation: see :func:`~redig.modules.denoiser.mlp`.

    Examples:
        >>> import torch
        >>> QNetwork(64, 2)(torch.zeros(8, 5, 64), torch.zeros(8, 5, 2)).shape
        torch.Size([8, 5, 1])
    """

    def __init__(
        self,
        embedding_dim: int,
        action_dim: int,
        hidden: Sequence[int] = (256, 256, 256),
        layer_norm: bool = True,
        activation: str = "mish",
    ) -> None:
        super().__init__()
        self.embedding_dim, self.action_dim = embedding_dim, action_dim
        self.net = mlp(embedding_dim + action_dim, hidden, 1, activation, layer_norm)

    def forward(self, embedding: Tensor, action: Tensor) -> Tensor:
        """Value ``[*B, 1]`` of actions ``[*B, A]`` given embeddings ``[*B, H]``, both cast to the network's type.

        Raises:
            ValueError: if the shapes do not fit each other or the network.
        """
        check_shapes(action, self.action_dim, embedding, self.embedding_dim)
        dtype = weight_dtype(self.net)
        return self.net(torch.cat([embedding.to(dtype), action.to(dtype)], -1))
