import pytest
import torch
from torch import nn

from redig.modules import QNetwork


@pytest.mark.parametrize("batch", [(), (5,), (3, 4, 5)])
def test_batch_shapes_agree_with_single_robots(batch):
    critic = QNetwork(6, 2, hidden=(16, 16))
    embedding, action = torch.randn(*batch, 6), torch.randn(*batch, 2)
    value = critic(embedding, action)
    assert value.shape == (*batch, 1)
    rows = zip(embedding.reshape(-1, 6), action.reshape(-1, 2), strict=True)
    torch.testing.assert_close(value.reshape(-1, 1), torch.stack([critic(*row) for row in rows]))


@pytest.mark.parametrize("layer_norm", [True, False])
def test_equals_the_layers_written_out(layer_norm):
    critic = QNetwork(3, 2, hidden=(8,), layer_norm=layer_norm, activation="relu").double()
    embedding, action = torch.randn(5, 3).double(), torch.randn(5, 2).double()
    hidden = torch.cat([embedding, action], -1) @ critic.net[0].weight.T + critic.net[0].bias
    if layer_norm:
        centred = hidden - hidden.mean(-1, keepdim=True)
        hidden = centred / (centred.square().mean(-1, keepdim=True) + 1e-5).sqrt()
    expected = hidden.clamp_min(0) @ critic.net[-1].weight.T + critic.net[-1].bias
    torch.testing.assert_close(critic(embedding, action), expected)


def test_layer_norm_bounds_values_of_actions_far_from_the_data():
    torch.manual_seed(0)
    far = 1e4 * torch.randn(100, 2)
    normed, plain = (QNetwork(3, 2, hidden=(32,), layer_norm=norm)(torch.zeros(100, 3), far) for norm in (True, False))
    assert normed.abs().max() < 10 < plain.abs().max()


def test_three_hidden_layers_of_256_by_default():
    layers = [layer for layer in QNetwork(64, 2).net if isinstance(layer, nn.Linear)]
    assert [layer.in_features for layer in layers] == [66, 256, 256, 256]
    assert layers[-1].out_features == 1


def test_gradient_reaches_inputs_and_all_weights():
    critic = QNetwork(6, 2, hidden=(16, 16))
    embedding, action = torch.randn(5, 6, requires_grad=True), torch.randn(5, 2, requires_grad=True)
    critic(embedding, action).square().sum().backward()
    for tensor in (embedding, action, *critic.parameters()):
        assert tensor.grad.abs().max() > 0


def test_unknown_activation():
    with pytest.raises(ValueError, match="activation: got 'gelu'"):
        QNetwork(6, 2, activation="gelu")


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_inputs_are_cast_to_the_networks_type(dtype):
    critic = QNetwork(6, 2, hidden=(16,)).to(dtype)
    embedding, action = torch.randn(5, 6), torch.randn(5, 2, requires_grad=True)
    value = critic(embedding, action)
    assert value.dtype == dtype
    torch.testing.assert_close(value, critic(embedding.to(dtype), action.to(dtype)))
    value.sum().backward()
    assert action.grad.dtype == torch.float32  # as refinement of actions needs it


@pytest.mark.parametrize(
    ("embedding", "action", "message"),
    [
        ((8, 5, 6), (8, 5, 3), r"action: got shape \[8, 5, 3\], expected \[\*B, 2\]"),
        ((8, 4, 6), (8, 5, 2), r"embedding: got shape \[8, 4, 6\], expected \[8, 5, 6\]"),
        ((8, 5, 7), (8, 5, 2), r"embedding: got shape \[8, 5, 7\], expected \[8, 5, 6\]"),
    ],
)
def test_shapes_that_do_not_fit(embedding, action, message):
    with pytest.raises(ValueError, match=message):
        QNetwork(6, 2)(torch.zeros(embedding), torch.zeros(action))
