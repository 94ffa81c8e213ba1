"""The encoder as a module among TorchRL's: types, devices, keys, functional parameters, and shapes that do not fit."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.testing import get_default_devices

from redig.modules import GraphEncoder, radius_edges
from redig.modules.encoder import AGGREGATIONS

VARIANTS = [("linear", "sum"), *(("edgeconv", aggregation) for aggregation in AGGREGATIONS)]
variants = pytest.mark.parametrize(("kind", "aggregation"), VARIANTS)


def make(kind="edgeconv", aggregation="max", activation="relu", seed=0):
    torch.manual_seed(seed)
    return GraphEncoder(5, 12, 16, 2.0, kind, aggregation, activation).double()


def teams(n, seed, batch=(3,), spread=2.0):
    """Random states; about this wide a spread leaves some robots alone and some together."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.randn(*batch, n, 5, dtype=torch.float64, generator=generator)
    state[..., :2] *= spread
    return state


@variants
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_does_not_blur_positions(kind, aggregation, dtype):
    """In bfloat16, 500.3 m and 501.3 m are the same place; the network may round, the graph may not."""
    encoder, state = make(kind, aggregation).float(), teams(5, 0).float()
    state[..., :2] += 500.3
    position = state[..., :2].clone()
    state[..., :2] = 0.0
    expected, norms = encoder(state, position), encoder.message_norms(state, position)
    half = make(kind, aggregation).to(dtype)
    found = half(state, position)
    assert found.dtype == dtype
    torch.testing.assert_close(found.float(), expected, atol=0.15, rtol=0.05)
    torch.testing.assert_close(half.message_norms(state, position).float(), norms, atol=0.15, rtol=0.05)
    assert torch.equal(half.message_norms(state, position) > 0, norms > 0)
    sparse = half.forward_sparse(state[0], radius_edges(position[0], 2.0), position[0])
    torch.testing.assert_close(sparse.float(), expected[0], atol=0.15, rtol=0.05)


@variants
def test_autocast(kind, aggregation):
    encoder, state = make(kind, aggregation).float(), teams(5, 0).float()
    with torch.autocast("cpu", torch.bfloat16):
        found = encoder(state)
    torch.testing.assert_close(found.float(), encoder(state), atol=0.15, rtol=0.05)


@variants
def test_no_teams(kind, aggregation):
    encoder = make(kind, aggregation)
    assert encoder(teams(4, 0, batch=(0,))).shape == (0, 4, 12)
    assert encoder.message_norms(teams(4, 0, batch=(2, 0))).shape == (2, 0, 4, 4)


@variants
def test_state_dict_round_trip(kind, aggregation):
    first, second, state = make(kind, aggregation), make(kind, aggregation, seed=1), teams(4, 0)
    assert not torch.equal(first(state), second(state))
    second.load_state_dict(first.state_dict())
    assert torch.equal(first(state), second(state))


@pytest.mark.parametrize("device", get_default_devices())
def test_in_a_tensordict_with_keys_of_any_depth(device):
    encoder = make().to(device)
    module = TensorDictModule(encoder, [("a", "b", "c"), ("a", "position")], [("x", "y", "z")])
    state = teams(4, 0).to(device)
    data = TensorDict({"a": {"b": {"c": state}, "position": state[..., :2]}}, [3], device=device)
    before = data.clone()
    assert torch.equal(module(data)["x", "y", "z"], encoder(state))
    assert (data.exclude("x") == before).all()
    assert torch.equal(module(a_b_c=state, a_position=state[..., :2]), encoder(state))


@variants
def test_functional_parameters_and_vmap_over_them(kind, aggregation):
    encoders, state = [make(kind, aggregation, seed=seed) for seed in (0, 1)], teams(4, 0)
    params = torch.stack([TensorDict.from_module(encoder).data for encoder in encoders])
    module = make(kind, aggregation, seed=2)

    def call(params):
        with params.to_module(module):
            return module(state)

    found = torch.vmap(call)(params)
    torch.testing.assert_close(found, torch.stack([encoder(state) for encoder in encoders]))


@pytest.mark.parametrize(
    ("observation", "position", "message"),
    [
        ((5,), None, r"observation: got shape \[5\], expected \[\*B, n, 5\]"),
        (
            (2, 3, 5),
            (2, 4, 2),
            r"position: got shape \[2, 4, 2\], expected \[2, 3, 2\] .* observation's shape \[2, 3, 5\]",
        ),
        ((2, 3, 5), (3, 2), r"position: got shape \[3, 2\], expected \[2, 3, 2\]"),
        ((2, 3, 5), (2, 3, 3), r"position: got shape \[2, 3, 3\], expected \[2, 3, 2\]"),
    ],
)
def test_shapes_that_do_not_fit(observation, position, message):
    position = None if position is None else torch.zeros(position)
    for call in (make().float(), make().float().message_norms):
        with pytest.raises(ValueError, match=message):
            call(torch.zeros(observation), position)


def test_ranks_of_the_sparse_form():
    with pytest.raises(ValueError, match=r"got shapes \[2, 3, 5\] and \[2, 4\], expected \[N, 5\] and \[2, E\]"):
        make().forward_sparse(torch.zeros(2, 3, 5), torch.zeros(2, 4, dtype=torch.long))
    with pytest.raises(ValueError, match=r"got shapes \[3, 5\] and \[4, 2\], expected \[N, 5\] and \[2, E\]"):
        make().forward_sparse(torch.zeros(3, 5), torch.zeros(4, 2, dtype=torch.long))
