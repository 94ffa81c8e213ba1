import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.modules import GraphEncoder, radius_edges
from redig.modules.encoder import AGGREGATIONS, EDGE_FEATURES

VARIANTS = [("linear", "sum"), *(("edgeconv", aggregation) for aggregation in AGGREGATIONS)]
variants = pytest.mark.parametrize(("kind", "aggregation"), VARIANTS)
sizes, seeds = st.integers(1, 8), st.integers(0, 2**31)


def make(kind="edgeconv", aggregation="max", activation="relu", seed=0, edge_features="state"):
    torch.manual_seed(seed)
    return GraphEncoder(5, 12, 16, 2.0, kind, aggregation, activation, edge_features).double()


def teams(n, seed, batch=(3,), spread=2.0):
    """Random states; about this wide a spread leaves some robots alone and some together."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.randn(*batch, n, 5, dtype=torch.float64, generator=generator)
    state[..., :2] *= spread
    return state


def plain_loop(encoder, state):
    """The formulas of the docstring for one team, robot by robot: embeddings and norms of messages."""
    act = torch.relu if isinstance(encoder.act, torch.nn.ReLU) else (lambda x: x)
    z = [act(encoder.lift.weight @ s + (0 if encoder.lift.bias is None else encoder.lift.bias)) for s in state]
    n, rows = len(state), []
    norms = torch.zeros(n, n, dtype=torch.float64)
    for i in range(n):
        messages = []
        for j in range(n):
            distance = math.dist(state[i, :2].tolist(), state[j, :2].tolist())
            if i == j or distance > encoder.radius:
                continue
            if encoder.kind == "linear":
                message = encoder.out.weight @ (z[j] - z[i])
            else:
                width = 2 if encoder.edge_features == "position" else 5
                edge = torch.cat([(state[j] - state[i])[:width], torch.tensor([distance], dtype=torch.float64)])
                hidden = encoder.message_self.weight @ z[i] + encoder.message_self.bias
                hidden = hidden + encoder.message_mate.weight @ (z[j] - z[i]) + encoder.message_edge.weight @ edge
                message = encoder.message_out.weight @ act(hidden) + encoder.message_out.bias
            messages.append(message)
            norms[i, j] = message.square().sum().sqrt()
        stacked = torch.stack(messages) if messages else torch.zeros(1, encoder.embedding_dim, dtype=torch.float64)
        aggregate = {"max": stacked.amax(0), "sum": stacked.sum(0), "mean": stacked.mean(0)}[encoder.aggregation]
        if encoder.kind == "linear":
            rows.append(act(encoder.out.weight @ z[i] + aggregate))
        else:
            rows.append(act(encoder.out.weight @ torch.cat([z[i], aggregate]) + encoder.out.bias))
    return torch.stack(rows), norms


@variants
@settings(deadline=None)
@given(n=sizes, seed=seeds, edges=st.sampled_from(EDGE_FEATURES))
def test_embeddings_and_message_norms_equal_a_plain_loop(kind, aggregation, n, seed, edges):
    encoder, state = make(kind, aggregation, edge_features=edges), teams(n, seed)
    embedding, norms = encoder(state), encoder.message_norms(state)
    for b in range(3):
        expected, expected_norms = plain_loop(encoder, state[b])
        torch.testing.assert_close(embedding[b], expected, atol=1e-8, rtol=1e-6)
        torch.testing.assert_close(norms[b], expected_norms, atol=1e-8, rtol=1e-6)


@variants
@settings(deadline=None)
@given(n=sizes, seed=seeds, edges=st.sampled_from(EDGE_FEATURES))
def test_dense_equals_sparse(kind, aggregation, n, seed, edges):
    encoder, state = make(kind, aggregation, edge_features=edges), teams(n, seed)
    sparse = encoder.forward_sparse(state.flatten(0, 1), radius_edges(state[..., :2], 2.0))
    torch.testing.assert_close(encoder(state).flatten(0, 1), sparse, atol=1e-10, rtol=0)


@variants
def test_dense_equals_sparse_with_one_way_edges(kind, aggregation):
    encoder, state = make(kind, aggregation), teams(2, 0, batch=(), spread=0.1)
    alone = encoder(state[:1])
    heard = encoder.forward_sparse(state, torch.tensor([[0], [1]]))  # from robot 0 to robot 1
    torch.testing.assert_close(heard[0], alone[0])
    torch.testing.assert_close(heard[1], encoder(state)[1])


@variants
@settings(deadline=None)
@given(n=sizes, seed=seeds)
def test_equivariant_under_permutations(kind, aggregation, n, seed):
    encoder, state = make(kind, aggregation), teams(n, seed)
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    torch.testing.assert_close(encoder(state[:, order]), encoder(state)[:, order])
    norms = encoder.message_norms(state)
    torch.testing.assert_close(encoder.message_norms(state[:, order]), norms[:, order][:, :, order])


@settings(deadline=None)
@given(n=sizes, seed=seeds)
def test_linear_kind_is_the_graph_laplacian(n, seed):
    encoder, state = make("linear", activation=None), teams(n, seed, batch=())
    distance = (state[:, None, :2] - state[None, :, :2]).square().sum(-1).sqrt()
    adjacency = ((distance <= 2.0) & (torch.arange(n)[:, None] != torch.arange(n))).double()
    laplacian = torch.diag(adjacency.sum(-1)) - adjacency
    lifted = state @ encoder.lift.weight.T
    expected = (torch.eye(n, dtype=torch.float64) - laplacian) @ lifted @ encoder.out.weight.T
    torch.testing.assert_close(encoder(state), expected)


@variants
def test_robots_beyond_the_radius_have_no_influence(kind, aggregation):
    encoder, state = make(kind, aggregation), teams(3, 0, batch=())
    state[:, :2] = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.5, 0.0]])  # 0 hears 1; 1 hears both; 2 hears 1
    changed = state.clone()
    changed[2, 2:] += 10
    before, after = encoder(state), encoder(changed)
    assert torch.equal(before[0], after[0])
    assert not torch.allclose(before[1], after[1])
    gone = changed.clone()
    gone[2, :2] = 100.0
    torch.testing.assert_close(encoder(gone)[:2], encoder(state[:2]))


@variants
def test_isolated_robot_equals_a_team_of_one(kind, aggregation):
    encoder, state = make(kind, aggregation), teams(4, 0, batch=())
    state[3, :2] = 1000.0
    torch.testing.assert_close(encoder(state)[3], encoder(state[3:])[0])
    assert encoder.message_norms(state)[3].max() == 0
    assert encoder.message_norms(state)[:, 3].max() == 0


@pytest.mark.parametrize("aggregation", AGGREGATIONS)
def test_only_edgeconv_tells_neighbours_apart(aggregation):
    """Errata, row 5: the sum of linear messages sees the neighbours' total, never one neighbour."""
    unequal, equal = torch.zeros(2, 3, 5, dtype=torch.float64)
    unequal[1:, 0] = torch.tensor([0.3, 1.9])
    equal[1:, 0] = 1.1
    linear = make("linear", activation=None)
    torch.testing.assert_close(linear(unequal)[0], linear(equal)[0])
    edgeconv = make("edgeconv", aggregation)
    assert (edgeconv(unequal)[0] - edgeconv(equal)[0]).abs().max() > 1e-3


@variants
def test_position_is_taken_from_the_observation_unless_given(kind, aggregation):
    encoder, state = make(kind, aggregation), teams(5, 0)
    position = state[..., :2]
    torch.testing.assert_close(encoder(state, position), encoder(state))
    torch.testing.assert_close(encoder(state, position + 7), encoder(state))  # only differences of positions count
    assert not torch.allclose(encoder(state, 100 * position), encoder(state))
    norms = encoder.message_norms(state, 100 * position)
    assert norms.max() == 0
    nothing = torch.zeros(2, 0, dtype=torch.long)
    torch.testing.assert_close(
        encoder.forward_sparse(state[0], nothing, 100 * position[0]), encoder(state, 100 * position)[0]
    )


@variants
@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_batch_shapes(kind, aggregation, batch):
    encoder, state = make(kind, aggregation), teams(4, 0, batch)
    assert encoder(state).shape == (*batch, 4, 12)
    assert encoder.message_norms(state).shape == (*batch, 4, 4)
    expected = torch.stack([encoder(team) for team in state.reshape(-1, 4, 5)])
    torch.testing.assert_close(encoder(state).reshape(-1, 4, 12), expected)


@variants
def test_gradient_reaches_all_weights_and_stays_finite(kind, aggregation):
    encoder, state = make(kind, aggregation), teams(4, 0)
    state[0, 1] = state[0, 0]  # two robots at one place: the distance has no gradient there
    state.requires_grad_()
    encoder(state).square().sum().backward()
    assert state.grad.isfinite().all()
    for parameter in encoder.parameters():
        assert parameter.grad.isfinite().all()
        assert parameter.grad.abs().max() > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "gat"}, "kind: got 'gat', allowed are edgeconv, linear"),
        ({"aggregation": "min"}, "aggregation: got 'min', allowed are max, sum, mean"),
        ({"activation": "gelu"}, "activation: got 'gelu'"),
        ({"activation": None}, "activation: got None"),
        ({"edge_features": "goal"}, "edge_features: got 'goal', allowed are state, position"),
        ({"radius": 0.0}, "radius: got 0.0, must be greater than 0 m"),
        ({"radius": math.nan}, "radius: got nan"),
        ({"sparse_above": -1}, "sparse_above: got -1, must be at least 0 or None"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        GraphEncoder(5, **arguments)


@variants
def test_wrong_observation_width(kind, aggregation):
    encoder = make(kind, aggregation)
    for call in (
        encoder,
        encoder.message_norms,
        lambda x: encoder.forward_sparse(x[0], torch.zeros(2, 0, dtype=torch.long)),
    ):
        with pytest.raises(ValueError, match=r"observation: got shape \[.*3, 7\], expected \[\*B, n, 5\]"):
            call(torch.zeros(2, 3, 7, dtype=torch.float64))


@variants
@pytest.mark.parametrize(("n", "batch", "pieces"), [(5, (150, 20), True), (1, (30_000, 2), True), (5, (2, 3), False)])
def test_a_large_batch_of_teams_taken_in_pieces_has_the_same_embeddings(kind, aggregation, n, batch, pieces):
    encoder = make(kind, aggregation).float()
    state = teams(n, 0, batch).float()
    with torch.no_grad():
        assert (encoder._teams_at_once(encoder.lift(state)) is not None) == pieces
        found = encoder(state)
    torch.testing.assert_close(found, encoder(state).detach(), atol=1e-5, rtol=0)  # with gradients it takes all at once
