import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from redig.modules import DenoisingMLP
from redig.modules.denoiser import mlp, quick_mish_, quick_mish_pays, rows_at_once, sinusoidal_embedding


@settings(deadline=None)
@given(st.floats(0, 1000), st.integers(1, 16))
def test_sinusoidal_embedding_in_closed_form(step, half):
    angles = [step * 10_000 ** (-i / max(half - 1, 1)) for i in range(half)]
    expected = [math.sin(angle) for angle in angles] + [math.cos(angle) for angle in angles]
    found = sinusoidal_embedding(torch.tensor(step, dtype=torch.float64), 2 * half)
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64), atol=2e-4, rtol=0)


def test_sinusoidal_embedding_tells_the_steps_apart():
    embedded = sinusoidal_embedding(torch.arange(100.0), 16)
    assert embedded.shape == (100, 16)
    assert (torch.cdist(embedded, embedded) + torch.eye(100)).min() > 0.05


@pytest.mark.parametrize("batch", [(), (5,), (3, 4, 5)])
def test_batch_shapes_agree_with_single_robots(batch):
    torch.manual_seed(0)
    denoiser = DenoisingMLP(2, 6, hidden=(16, 16), step_dim=4)
    action, step, embedding = torch.randn(*batch, 2), torch.randint(100, batch), torch.randn(*batch, 6)
    noise = denoiser(action, step, embedding)
    assert noise.shape == action.shape
    rows = zip(action.reshape(-1, 2), step.reshape(-1), embedding.reshape(-1, 6), strict=True)
    expected = torch.stack([denoiser(*row) for row in rows])
    torch.testing.assert_close(noise.reshape(-1, 2), expected)


def test_scalar_step_counts_for_all_robots():
    denoiser = DenoisingMLP(2, 6, hidden=(16,))
    action, embedding = torch.randn(3, 5, 2), torch.randn(3, 5, 6)
    everywhere = denoiser(action, torch.full((3, 5), 7), embedding)
    torch.testing.assert_close(denoiser(action, torch.tensor(7), embedding), everywhere)


def test_equals_the_layers_written_out():
    denoiser = DenoisingMLP(2, 3, hidden=(8,), step_dim=4).double()
    action, embedding = torch.randn(5, 2).double(), torch.randn(5, 3).double()
    time = sinusoidal_embedding(torch.tensor(9.0, dtype=torch.float64), 4).expand(5, 4)
    first, _, second = denoiser.net
    hidden = torch.cat([action, time, embedding], -1) @ first.weight.T + first.bias
    hidden = hidden * torch.tanh(torch.log1p(torch.exp(hidden)))  # Mish
    torch.testing.assert_close(denoiser(action, torch.tensor(9), embedding), hidden @ second.weight.T + second.bias)


def test_gradient_reaches_inputs_and_all_weights():
    denoiser = DenoisingMLP(2, 6, hidden=(16, 16))
    action, embedding = torch.randn(5, 2, requires_grad=True), torch.randn(5, 6, requires_grad=True)
    denoiser(action, torch.arange(5), embedding).square().sum().backward()
    for tensor in (action, embedding, *denoiser.parameters()):
        assert tensor.grad.abs().max() > 0


def test_mlp_layers():
    def kinds(net):
        return [type(layer) for layer in net]

    assert kinds(mlp(3, (), 2)) == [nn.Linear]
    assert kinds(mlp(3, (4, 5), 2, "relu")) == [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU, nn.Linear]
    normed = mlp(3, (4, 5), 2, "tanh", layer_norm=True)
    assert kinds(normed) == [nn.Linear, nn.LayerNorm, nn.Tanh, nn.Linear, nn.LayerNorm, nn.Tanh, nn.Linear]
    assert [(layer.in_features, layer.out_features) for layer in normed if isinstance(layer, nn.Linear)] == [
        (3, 4),
        (4, 5),
        (5, 2),
    ]


@pytest.mark.parametrize("step_dim", [0, 1, 3])
def test_bad_step_dim(step_dim):
    with pytest.raises(ValueError, match=f"step_dim: got {step_dim}, must be even"):
        DenoisingMLP(2, 6, step_dim=step_dim)


def test_unknown_activation():
    with pytest.raises(ValueError, match="activation: got 'gelu', allowed are mish, relu, silu, tanh"):
        DenoisingMLP(2, 6, activation="gelu")


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_inputs_are_cast_to_the_networks_type(dtype):
    denoiser = DenoisingMLP(2, 6, hidden=(16,))
    action, step, embedding = torch.randn(5, 2), torch.tensor([0, 500, 501, 998, 999]), torch.randn(5, 6)
    expected = denoiser(action, step, embedding)
    found = denoiser.to(dtype)(action, step, embedding)
    assert found.dtype == dtype
    torch.testing.assert_close(found.float(), expected, atol=0.02, rtol=0.02)


def test_half_precision_tells_high_steps_apart():
    """bfloat16 itself counts 998 and 999 as one; their embeddings must differ."""
    denoiser = DenoisingMLP(2, 6, hidden=(16,)).bfloat16()
    action, embedding = torch.zeros(2, 2), torch.zeros(2, 6)
    first, second = denoiser(action, torch.tensor([998, 999]), embedding)
    assert not torch.equal(first, second)


@pytest.mark.parametrize(
    ("action", "step", "embedding", "message"),
    [
        ((8, 5, 3), (8, 5), (8, 5, 6), r"action: got shape \[8, 5, 3\], expected \[\*B, 2\]"),
        ((8, 5, 2), (8, 5), (8, 4, 6), r"embedding: got shape \[8, 4, 6\], expected \[8, 5, 6\]"),
        ((8, 5, 2), (8,), (8, 5, 6), r"step: got shape \[8\], expected \[8, 5\], one for each action, or a scalar"),
        ((8, 5, 2), (8, 5, 1), (8, 5, 6), r"step: got shape \[8, 5, 1\], expected \[8, 5\]"),
    ],
)
def test_shapes_that_do_not_fit(action, step, embedding, message):
    with pytest.raises(ValueError, match=message):
        DenoisingMLP(2, 6)(torch.zeros(action), torch.zeros(step), torch.zeros(embedding))


@settings(deadline=None, max_examples=30)
@given(
    st.lists(st.integers(0, 999), min_size=1, max_size=6, unique=True),
    st.sampled_from([(), (3,), (2, 5)]),
    st.sampled_from(["mish", "silu", "relu", "tanh"]),
    st.integers(0, 10),
)
def test_a_prepared_chain_has_the_values_and_gradients_of_single_calls(steps, batch, activation, seed):
    torch.manual_seed(seed)
    denoiser = DenoisingMLP(2, 6, hidden=(16, 8), step_dim=4, activation=activation).double()
    embedding = torch.randn(*batch, 6, dtype=torch.float64, requires_grad=True)
    prepared = denoiser.prepare(embedding, steps)
    for step in steps:
        action = torch.randn(*batch, 2, dtype=torch.float64, requires_grad=True)
        found, expected = prepared(action, step), denoiser(action, torch.tensor(step), embedding)
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
        inputs = [action, embedding, *denoiser.parameters()]
        gradients = [torch.autograd.grad(out.sum(), inputs, retain_graph=True) for out in (found, expected)]
        torch.testing.assert_close(*gradients, atol=1e-6, rtol=0)


def test_a_prepared_chain_of_another_type():
    denoiser = DenoisingMLP(2, 6, hidden=(16,)).to(torch.bfloat16)
    action, embedding = torch.randn(3, 2), torch.randn(3, 6)
    found = denoiser.prepare(embedding, [7])(action, 7)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found, denoiser(action, torch.tensor(7), embedding), atol=0.05, rtol=0)


def test_a_prepared_chain_checks_the_embedding():
    with pytest.raises(ValueError, match=r"embedding: got shape \[3, 5\], expected \[3, 6\]"):
        DenoisingMLP(2, 6).prepare(torch.zeros(3, 5), [1])


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10), st.floats(0.1, 100))
def test_quick_mish_is_mish(seed, scale):
    x = scale * torch.randn(4096, generator=torch.Generator().manual_seed(seed))
    expected = nn.functional.mish(x.double()).float()
    torch.testing.assert_close(quick_mish_(x.clone()), expected, atol=1e-6, rtol=1e-6)


def test_a_large_batch_without_gradients_has_the_same_values():
    torch.manual_seed(0)
    denoiser, action, embedding = DenoisingMLP(2, 6, (64, 64)), torch.randn(300, 2), torch.randn(300, 6)
    expected = denoiser(action, torch.tensor(3), embedding)
    with torch.no_grad():
        assert quick_mish_pays(torch.zeros(300, 64))
        found = denoiser.prepare(embedding, [3])(action, 3)
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("activation", ["mish", "relu"])
def test_a_batch_taken_in_pieces_has_the_same_values(activation):
    torch.manual_seed(0)
    denoiser = DenoisingMLP(2, 6, (128, 64), activation=activation)
    action, embedding = torch.randn(1001, 5, 2), torch.randn(1001, 5, 6)
    with torch.no_grad():
        assert rows_at_once(torch.zeros(1001, 5, 2), 128) == 2048  # 5005 rows: two whole pieces and a rest
        found = denoiser.prepare(embedding, [3])(action, 3)
        torch.testing.assert_close(found, denoiser(action, torch.tensor(3), embedding), atol=1e-6, rtol=0)
