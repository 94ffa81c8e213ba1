"""The graph encoder: what a robot knows of its team, h_i = phi(s_i, G), from neighbours within its radius."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch_geometric.utils import scatter

from redig.modules.denoiser import ACTIVATIONS, eager_on_cpu, rows_at_once
from redig.modules.neighbours import at_least_float32, radius_edges, within

KINDS = ("edgeconv", "linear")
EDGE_FEATURES = ("state", "position")
AGGREGATIONS = ("max", "sum", "mean")


class GraphEncoder(nn.Module):
    """Embedding of a robot and its neighbours, in the EdgeConv style (Wang et al., 2019) or exactly as printed.

    ``edgeconv`` (default): ``z = act(W^z s)``, messages ``m_ij = W^m act(W^i z_i + W^j (z_j - z_i) + W^e [e_ij,
    |p_j - p_i|])``, ``h_i = act(W^h [z_i, aggregate_j m_ij])``. The nonlinearity inside the message lets a robot tell
    one neighbour from another. The edge carries the difference of the robots' whole states, ``e_ij = s_j - s_i``, or of
    their positions only. With goals that stand in formation, the difference of ``goal - position`` is how far the two
    are from their places to each other; teams learn their formation in about half the updates when they hear it
    (``docs/results/ablations``).

    ``linear``: ``h_i = W^h z_i + sum_j W^h (z_j - z_i)`` with ``z = W^z s`` and no biases, as in Sec. 3.2; equal to
    ``W^h (I - L) z`` with the graph Laplacian ``L``. ``activation`` then acts on ``z`` and ``h`` (``None``: exactly as
    printed).

    Works for any number of robots; one without neighbours gets an aggregate of zero. Equivariant under permutations.
    States are cast to the type of the network; positions are not, so that bfloat16 weights do not blur distances.

    Small teams are computed densely, all pairs at once, in time and memory of order n² a team; larger ones along the
    edges of :func:`~redig.modules.radius_edges` only, in proportion to n while a robot's number of neighbours stays the
    same. Both give the same embeddings and gradients. The dense form is one graph for ``torch.compile(fullgraph=True)``
    and ``torch.export``; the edges depend on the data, so ``torch.compile`` breaks the graph there
    (``sparse_above=None`` avoids it), and ``torch.export`` takes the dense form for all sizes.

    Args:
        in_features: width of a robot's state (7 in the paper, 9 with the direction to the nearest obstacle).
        embedding_dim: width of ``h``.
        hidden: width of the messages.
        radius: communication range (m).
        kind: ``"edgeconv"`` or ``"linear"``.
        aggregation: ``"max"``, ``"sum"`` or ``"mean"`` over neighbours; the linear kind always sums.
        activation: name of the nonlinearity (Table 3: ReLU), or ``None`` with the linear kind.
        edge_features: ``"state"`` or ``"position"``, see above; the linear kind has no edges' features.
        sparse_above: teams of more robots than this are computed along their edges; ``None``: never. The default is
            where that starts to pay at about four neighbours a robot (``benchmarks/team_size.py``).

    Raises:
        ValueError: for an unknown kind, aggregation, activation or edge_features, a radius that is not positive, or a
            negative ``sparse_above``.

    Examples:
        >>> import torch
        >>> encoder = GraphEncoder(in_features=9)
        >>> encoder(torch.randn(32, 5, 9)).shape  # 32 teams of five robots
        torch.Size([32, 5, 64])
        >>> encoder(30 * torch.randn(1, 1000, 9)).shape  # a thousand: along the edges
        torch.Size([1, 1000, 64])
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
        edge_features: str = "state",
        sparse_above: int | None = 16,
    ) -> None:
        super().__init__()
        for name, value, allowed in (
            ("kind", kind, KINDS),
            ("aggregation", aggregation, AGGREGATIONS),
            ("activation", activation, (*ACTIVATIONS, None) if kind == "linear" else tuple(ACTIVATIONS)),
            ("edge_features", edge_features, EDGE_FEATURES),
        ):
            if value not in allowed:
                raise ValueError(f"{name}: got {value!r}, allowed are {', '.join(map(str, allowed))}")
        if not radius > 0:
            raise ValueError(f"radius: got {radius}, must be greater than 0 m")
        if sparse_above is not None and sparse_above < 0:
            raise ValueError(f"sparse_above: got {sparse_above}, must be at least 0 or None")
        self.in_features = in_features
        self.embedding_dim = embedding_dim
        self.radius = radius
        self.sparse_above = sparse_above
        self.kind = kind
        self.edge_features = edge_features
        self.aggregation = "sum" if kind == "linear" else aggregation
        if activation == "relu":
            self.act: nn.Module = nn.ReLU(inplace=True)  # what it acts on is never needed again
        else:
            self.act = ACTIVATIONS[activation]() if activation is not None else nn.Identity()
        edge = kind == "edgeconv"
        self.lift = nn.Linear(in_features, embedding_dim, bias=edge)  # W^z
        if edge:
            self.message_self = nn.Linear(embedding_dim, hidden)
            self.message_mate = nn.Linear(embedding_dim, hidden, bias=False)
            width = in_features if edge_features == "state" else 2
            self.message_edge = nn.Linear(width + 1, hidden, bias=False)  # W^e
            self.message_out = nn.Linear(hidden, embedding_dim)
            self.out = nn.Linear(2 * embedding_dim, embedding_dim)  # W^h
        else:
            self.out = nn.Linear(embedding_dim, embedding_dim, bias=False)  # W^h

    def forward(self, observation: Tensor, position: Tensor | None = None) -> Tensor:
        """Embed all robots of batched teams.

        Args:
            observation: ``[*B, n, F]``.
            position: ``[*B, n, 2]`` (m); by default the first two numbers of the observation, where the paper's state
                keeps them.

        Returns:
            embedding ``[*B, n, H]``.

        Raises:
            ValueError: if the shapes do not fit each other or the network.
        """
        z, carried, position = self._lift(observation, position)
        # asked in this order, an export sets no limit to the number of robots
        dense = torch.compiler.is_exporting() or self.sparse_above is None or z.shape[-2] <= self.sparse_above
        if not dense:
            rows, states, places = (x.flatten(0, -2) for x in (z, carried, position))
            return self._along_edges(rows, states, places, radius_edges(position, self.radius)).reshape(z.shape)
        teams = self._teams_at_once(z)
        if teams is None:
            return self._along_pairs(z, carried, position)
        pieces = zip(*(x.flatten(0, -3).split(teams) for x in (z, carried, position)), strict=True)
        return torch.cat([self._along_pairs(*piece) for piece in pieces]).reshape(z.shape)

    def _teams_at_once(self, z: Tensor) -> int | None:
        """How many teams of a large batch fit a cache with all their messages; None: take all at once."""
        if not eager_on_cpu(z):  # an export may not see the number of robots below
            return None
        n, width = z.shape[-2], self.embedding_dim if self.kind == "linear" else self.message_out.in_features
        return rows_at_once(z.flatten(-2), n * max(n - 1, 1) * width)

    def _along_pairs(self, z: Tensor, carried: Tensor, position: Tensor) -> Tensor:
        """Embeddings ``[*B, n, H]`` from messages between all pairs, those out of range left out."""
        messages, near = self._pairwise_messages(z, carried, position)
        near = near.unsqueeze(-1)
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
        """The same along given edges, for a graph that is not that of the radius, such as one with messages lost.

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
        return self._along_edges(*self._lift(observation, position), edge_index)

    def message_norms(self, observation: Tensor, position: Tensor | None = None) -> Tensor:
        """Importance of each message as in Fig. 6: ``[*B, n, n]``, the norm of what i hears from j; 0 out of range."""
        z, carried, position = self._lift(observation, position)
        messages, near = self._pairwise_messages(z, carried, position)
        norms = messages.norm(dim=-1) * near
        sender = _others(z.shape[-2], z.device).expand(norms.shape)
        return norms.new_zeros(*norms.shape[:-1], z.shape[-2]).scatter(-1, sender, norms)

    def _lift(self, observation: Tensor, position: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """The lifted state ``z``, what an edge carries the difference of, and the positions, one row a robot."""
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
        carried = observation if self.edge_features == "state" else position
        z = self.act(self.lift(observation.to(self.lift.weight.dtype)))
        return z, at_least_float32(carried), at_least_float32(position)

    def _node_terms(self, z: Tensor, carried: Tensor) -> tuple[Tensor, Tensor]:
        """What a message takes from the robot that hears it and from the one that sends it, computed once a robot."""
        if self.kind == "linear":
            sent = self.out(z)
            return -sent, sent
        # a difference of products instead of a product of differences, which would be one for each pair
        mate = self.message_mate(z) + nn.functional.linear(carried, self.message_edge.weight[:, :-1].to(carried.dtype))
        return self.message_self(z) - mate, mate

    def _message(self, mine: Tensor, mate: Tensor, offset: Tensor) -> Tensor:
        """Messages ``[..., H]`` from node terms and ``p_j - p_i`` (m)."""
        if self.kind == "linear":
            return mine + mate
        distance = offset.norm(dim=-1, keepdim=True).to(mine.dtype)
        # in place: with large batches, more time goes into fresh memory than into the sums
        hidden = (mine + mate).add_(distance * self.message_edge.weight[:, -1].to(mine.dtype))
        return self.message_out(self.act(hidden.to(self.message_out.weight.dtype)))

    def _pairwise_messages(self, z: Tensor, carried: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
        """What each robot would hear from each other one, ``[*B, n, n - 1, H]``, and whether it does."""
        n, (mine, mate) = z.shape[-2], self._node_terms(z, carried)
        others = _others(n, z.device)
        offset = _rows(position, others) - position.unsqueeze(-2)  # p_j - p_i
        near = within(offset, self.radius) if n > 1 else torch.zeros_like(offset[..., 0], dtype=torch.bool)
        return self._message(mine.unsqueeze(-2), _rows(mate, others), offset), near

    def _along_edges(self, z: Tensor, carried: Tensor, position: Tensor, edge_index: Tensor) -> Tensor:
        """Embeddings ``[N, H]`` from messages along the edges only."""
        mine, mate = self._node_terms(z, carried)
        sender, robot = edge_index
        offset = position.index_select(0, sender) - position.index_select(0, robot)
        messages = self._message(mine.index_select(0, robot), mate.index_select(0, sender), offset)
        return self._update(z, scatter(messages, robot, 0, len(z), self.aggregation))

    def _update(self, z: Tensor, aggregate: Tensor) -> Tensor:
        if self.kind == "linear":
            return self.act(self.out(z) + aggregate)
        return self.act(self.out(torch.cat([z, aggregate], -1)))


def _others(n: int, device: torch.device) -> Tensor:
    """Numbers of the other robots beside each, ``[n, n - 1]``, from the next one on; a team of one has itself there."""
    robot = torch.arange(n, device=device)
    return (robot.unsqueeze(-1) + robot[1:]) % n if n > 1 else robot.unsqueeze(-1)


def _rows(x: Tensor, index: Tensor) -> Tensor:
    """Rows ``[*B, n, m, W]`` of ``[*B, n, W]`` by their numbers ``[n, m]``."""
    return x.index_select(-2, index.flatten()).unflatten(-2, index.shape)
