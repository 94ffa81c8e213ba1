"""The graph encoder: what a robot knows of its team, h_i = phi(s_i, G), from neighbours within its radius."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch_geometric.nn import MessagePassing

from redig.modules.denoiser import ACTIVATIONS

KINDS = ("edgeconv", "linear")
AGGREGATIONS = ("max", "sum", "mean")


def radius_adjacency(position: Tensor, radius: float) -> Tensor:
    """Which robots hear each other, without self-loops: ``[*B, n, 2]`` (m) to a boolean ``[*B, n, n]``.

    Distances are taken in float32 or better.

    Raises:
        ValueError: if ``position`` has another rank.

    Examples:
        >>> import torch
        >>> radius_adjacency(torch.tensor([[0.0, 0.0], [1.0, 0.0], [9.0, 0.0]]), 2.0).sum().item()
        2
    """
    if position.ndim < 2:
        raise ValueError(f"position: got shape {list(position.shape)}, expected [*B, n, 2]")
    position = _at_least_float32(position)
    # the matrix product that cdist prefers for many points loses digits far from the origin
    near = torch.cdist(position, position, compute_mode="donot_use_mm_for_euclid_dist") <= radius
    return near & ~torch.eye(position.shape[-2], dtype=torch.bool, device=position.device)


def _at_least_float32(position: Tensor) -> Tensor:
    return position.to(torch.promote_types(position.dtype, torch.float32))


class _EdgeMessages(MessagePassing):
    """Messages along ``edge_index`` (PyG's convention: from ``edge_index[0]`` to ``edge_index[1]``), aggregated."""

    def __init__(self, encoder: GraphEncoder) -> None:
        super().__init__(aggr=encoder.aggregation)
        self.message_of = encoder.message

    def forward(self, z: Tensor, position: Tensor, edge_index: Tensor) -> Tensor:
        """Aggregate the messages that arrive at each robot: ``[N, H]``."""
        return self.propagate(edge_index, z=z, position=position, size=(z.shape[0], z.shape[0]))

    def message(self, z_i: Tensor, z_j: Tensor, position_i: Tensor, position_j: Tensor) -> Tensor:
        """Message from j to i."""
        return self.message_of(
            z_i,
            z_j,
            position_j - position_i,
        )


class GraphEncoder(nn.Module):
    """Embedding of a robot and its neighbours, in the EdgeConv style (Wang et al., 2019) or exactly as printed.

    ``edgeconv`` (default): ``z = act(W^z s)``, messages ``m_ij = W^m act(W^i z_i + W^j (z_j - z_i) + W^e [p_j - p_i,
    |p_j - p_i|])``, ``h_i = act(W^h [z_i, aggregate_j m_ij])``. The nonlinearity inside the message lets a robot tell
    one neighbour from another.

    ``linear``: ``h_i = W^h z_i + sum_j W^h (z_j - z_i)`` with ``z = W^z s`` and no biases, as in Sec. 3.2; equal to
    ``W^h (I - L) z`` with the graph Laplacian ``L``. ``activation`` then acts on ``z`` and ``h`` (``None``: exactly as
    printed).

    Works for any number of robots; one without neighbours gets an aggregate of zero. Equivariant under permutations.
    States are cast to the type of the network; positions are not, so that bfloat16 weights do not blur distances.

    Args:
        in_features: width of a robot's state (7 in the paper, 9 with the direction to the nearest obstacle).
        embedding_dim: width of ``h``.
        hidden: width of the messages.
        radius: communication range (m).
        kind: ``"edgeconv"`` or ``"linear"``.
        aggregation: ``"max"``, ``"sum"`` or ``"mean"`` over neighbours; the linear kind always sums.
        activation: name of the nonlinearity (Table 3: ReLU), or ``None`` with the linear kind.

    Raises:
        ValueError: for an unknown kind, aggregation or activation, or a radius that is not positive.

    Examples:
        >>> import torch
        >>> encoder = GraphEncoder(in_features=9)
        >>> encoder(torch.randn(32, 5, 9)).shape  # 32 teams of five robots
        torch.Size([32, 5, 64])
    """

    def __init__(
        self,
        in_features: int,
        embedding_dim: int = 64,
        hidden: int = 128,
        radius: float = 2.0,
        kind: str = "edgeconv",
        aggregation: str = "max",
        activation: str | None = "relu",
    ) -> None:
        super().__init__()
        for name, value, allowed in (
            ("kind", kind, KINDS),
            ("aggregation", aggregation, AGGREGATIONS),
            ("activation", activation, (*ACTIVATIONS, None) if kind == "linear" else tuple(ACTIVATIONS)),
        ):
            if value not in allowed:
                raise ValueError(f"{name}: got {value!r}, allowed are {', '.join(map(str, allowed))}")
        if not radius > 0:
            raise ValueError(f"radius: got {radius}, must be greater than 0 m")
        self.in_features = in_features
        self.embedding_dim = embedding_dim
        self.radius = radius
        self.kind = kind
        self.aggregation = "sum" if kind == "linear" else aggregation
        self.act = ACTIVATIONS[activation]() if activation is not None else nn.Identity()
        edge = kind == "edgeconv"
        self.lift = nn.Linear(in_features, embedding_dim, bias=edge)  # W^z
        if edge:
            self.message_self = nn.Linear(embedding_dim, hidden)
            self.message_mate = nn.Linear(embedding_dim, hidden, bias=False)
            self.message_edge = nn.Linear(3, hidden, bias=False)
            self.message_out = nn.Linear(hidden, embedding_dim)
            self.out = nn.Linear(2 * embedding_dim, embedding_dim)  # W^h
        else:
            self.out = nn.Linear(embedding_dim, embedding_dim, bias=False)  # W^h

    def message(self, z_i: Tensor, z_j: Tensor, offset: Tensor) -> Tensor:
        """Message from neighbour j to robot i: ``[..., H]`` from their states and ``p_j - p_i`` (m)."""
        if self.kind == "linear":
            return self.out(z_j - z_i)
        edge = torch.cat([offset, offset.norm(dim=-1, keepdim=True)], -1).to(z_i.dtype)
        return self.message_out(
            self.act(self.message_self(z_i) + self.message_mate(z_j - z_i) + self.message_edge(edge))
        )

    def forward(self, observation: Tensor, position: Tensor | None = None) -> Tensor:
        """Embed all robots of batched teams; the fast form, all pairs at once.

        Args:
            observation: ``[*B, n, F]``.
            position: ``[*B, n, 2]`` (m); by default the first two numbers of the observation, where the paper's state
                keeps them.

        Returns:
            embedding ``[*B, n, H]``.

        Raises:
            ValueError: if the shapes do not fit each other or the network.
        """
        z, position = self._lift(observation, position)
        messages = self._pairwise_messages(z, position)
        near = radius_adjacency(position, self.radius).unsqueeze(-1)
        if self.aggregation == "max":
            lowest = torch.finfo(messages.dtype).min
            aggregate = messages.masked_fill(~near, lowest).amax(-2)
            aggregate = aggregate.masked_fill(~near.any(-2), 0)
        else:
            aggregate = (messages * near).sum(-2)
            if self.aggregation == "mean":
                aggregate = aggregate / near.sum(-2).clamp_min(1)
        return self._update(z, aggregate)

    def forward_sparse(self, observation: Tensor, edge_index: Tensor, position: Tensor | None = None) -> Tensor:
        """The same through PyG message passing; better for large teams with few neighbours each.

        Args:
            observation: ``[N, F]``, all robots of all teams.
            edge_index: ``[2, E]``, from neighbour to robot, e.g. of a ``torch_geometric.data.Batch``.
            position: ``[N, 2]`` (m), see :meth:`forward`.

        Returns:
            embedding ``[N, H]``.

        Raises:
            ValueError: if the shapes do not fit each other or the network.
        """
        if observation.ndim != 2 or edge_index.ndim != 2 or len(edge_index) != 2:
            seen = f"{list(observation.shape)} and {list(edge_index.shape)}"
            raise ValueError(f"observation, edge_index: got shapes {seen}, expected [N, {self.in_features}] and [2, E]")
        z, position = self._lift(observation, position)
        return self._update(z, _EdgeMessages(self)(z, position, edge_index))

    def message_norms(self, observation: Tensor, position: Tensor | None = None) -> Tensor:
        """Importance of each message as in Fig. 6: ``[*B, n, n]``, the norm of what i hears from j; 0 out of range."""
        z, position = self._lift(observation, position)
        return self._pairwise_messages(z, position).norm(dim=-1) * radius_adjacency(position, self.radius)

    def _lift(self, observation: Tensor, position: Tensor | None) -> tuple[Tensor, Tensor]:
        if observation.ndim < 2 or observation.shape[-1] != self.in_features:
            raise ValueError(
                f"observation: got shape {list(observation.shape)}, expected [*B, n, {self.in_features}]; "
                f"the encoder was built for {self.in_features} numbers a robot"
            )
        position = observation[..., :2] if position is None else position
        expected = [*observation.shape[:-1], 2]
        if list(position.shape) != expected:
            raise ValueError(
                f"position: got shape {list(position.shape)}, expected {expected} to go with the observation's shape "
                f"{list(observation.shape)}"
            )
        return self.act(self.lift(observation.to(self.lift.weight.dtype))), _at_least_float32(position)

    def _pairwise_messages(self, z: Tensor, position: Tensor) -> Tensor:
        """All messages ``[*B, n, n, H]``; the node terms of the first layer are computed once a robot, not a pair."""
        offset = position.unsqueeze(-3) - position.unsqueeze(-2)  # [*B, i, j, 2] = p_j - p_i
        if self.kind == "linear":
            sent = self.out(z)
            return sent.unsqueeze(-3) - sent.unsqueeze(-2)
        mate = self.message_mate(z)
        mine = self.message_self(z) - mate
        edge = torch.cat([offset, offset.norm(dim=-1, keepdim=True)], -1).to(z.dtype)
        pre = mine.unsqueeze(-2) + mate.unsqueeze(-3) + self.message_edge(edge)
        return self.message_out(self.act(pre))

    def _update(self, z: Tensor, aggregate: Tensor) -> Tensor:
        if self.kind == "linear":
            return self.act(self.out(z) + aggregate)
        return self.act(self.out(torch.cat([z, aggregate], -1)))
