"""Teams above ``sparse_above``: the same embeddings and gradients, along the edges only."""

import json
import math

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.data import Bounded

from redig.modules import DDPM, DenoisingMLP, DiffusionActor, GraphEncoder, QNetwork
from redig.modules.encoder import AGGREGATIONS
from redig.objectives import DIPOLoss
from redig.policy import PolicyConfig, build_policy, load_policy, save_policy

VARIANTS = [("linear", "sum"), *(("edgeconv", aggregation) for aggregation in AGGREGATIONS)]
variants = pytest.mark.parametrize(("kind", "aggregation"), VARIANTS)


def make(kind="edgeconv", aggregation="max", dtype=torch.float64, **options):
    """A sparse encoder and its dense twin."""
    torch.manual_seed(0)
    options = {"kind": kind, "aggregation": aggregation, **options}
    sparse, dense = (GraphEncoder(5, 12, 16, **options, sparse_above=above).to(dtype) for above in (0, None))
    dense.load_state_dict(sparse.state_dict())
    return sparse, dense


def teams(*batch, n, neighbours=4.0, dtype=torch.float64, width=5):
    """Random states of robots uniform in a square, ``neighbours`` within 2 m on average."""
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(*batch, n, width, dtype=dtype, generator=generator)
    side = math.sqrt(n * math.pi * 2.0**2 / neighbours)
    state[..., :2] = side * torch.rand(*batch, n, 2, dtype=dtype, generator=generator)
    return state


def gradients(encoder, state):
    """Of a function that weighs all outputs differently, in states and in parameters."""
    state = state.clone().requires_grad_()
    output = encoder(state)
    encoder.zero_grad()
    (output * torch.linspace(-1, 1, output.numel(), dtype=output.dtype).reshape(output.shape)).sum().backward()
    return [state.grad, *(parameter.grad.clone() for parameter in encoder.parameters())]


@variants
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
@pytest.mark.parametrize("activation", ["relu", "mish"])
def test_dense_equals_sparse_forward_and_backward(kind, aggregation, dtype, tolerance, activation):
    sparse, dense = make(kind, aggregation, dtype, activation=activation)
    for state in (teams(2, n=30, dtype=dtype), teams(3, 2, n=7, dtype=dtype), teams(n=1, dtype=dtype)):
        torch.testing.assert_close(sparse(state), dense(state), atol=tolerance, rtol=tolerance)
        torch.testing.assert_close(gradients(sparse, state), gradients(dense, state), atol=tolerance, rtol=tolerance)


@variants
def test_robots_at_one_place_and_at_the_radius(kind, aggregation):
    sparse, dense = make(kind, aggregation)
    state = teams(n=8)
    state[:, :2] = torch.tensor([0.0, 2.0, 4.0, 6.0], dtype=torch.float64).repeat(2)[:, None]
    state[:, 1] = 0.0
    state[4:6] = state[:2]  # equal in all: neighbours whose messages tie for the maximum
    torch.testing.assert_close(gradients(sparse, state), gradients(dense, state), atol=1e-10, rtol=0)
    assert all(gradient.isfinite().all() for gradient in gradients(sparse, state))


@variants
def test_nobody_in_range(kind, aggregation):
    sparse, dense = make(kind, aggregation)
    state = teams(2, n=20)
    state[..., 0] = 10.0 * torch.arange(20)
    alone = torch.stack([dense(robot[None])[0] for robot in state.flatten(0, 1)])
    torch.testing.assert_close(sparse(state).flatten(0, 1), alone, atol=1e-10, rtol=0)
    torch.testing.assert_close(gradients(sparse, state), gradients(dense, state), atol=1e-10, rtol=0)


@variants
def test_equivariant_under_permutations_above_the_switch(kind, aggregation):
    encoder, state = GraphEncoder(5, 12, 16, kind=kind, aggregation=aggregation).double(), teams(2, n=100)
    order = torch.randperm(100, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(encoder(state[:, order]), encoder(state)[:, order])


def test_the_switch(monkeypatch):
    searched = []
    monkeypatch.setattr(
        "redig.modules.encoder.radius_edges", lambda *args: searched.append(args) or torch.zeros(2, 0, dtype=torch.long)
    )
    for above, n, expected in ((8, 8, 0), (8, 9, 1), (None, 40, 0), (0, 1, 1)):
        searched.clear()
        GraphEncoder(5, sparse_above=above)(torch.zeros(2, n, 5))
        assert len(searched) == expected


@variants
def test_no_teams_no_batch_and_given_positions(kind, aggregation):
    sparse, dense = make(kind, aggregation)
    assert sparse(teams(2, 0, n=20)).shape == (2, 0, 20, 12)
    state = teams(n=20)
    assert sparse(state).shape == (20, 12)
    position = state[:, :2].flip(0)
    torch.testing.assert_close(sparse(state, position), dense(state, position), atol=1e-10, rtol=0)
    with pytest.raises(ValueError, match=r"position: got shape \[3, 2\], expected \[20, 2\]"):
        sparse(state, position[:3])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision(dtype):
    sparse, dense = make(dtype=torch.float32)
    state = teams(n=20, dtype=torch.float32)
    found = sparse.to(dtype)(state, state[:, :2] + 500.3)
    assert found.dtype == dtype
    torch.testing.assert_close(found.float(), dense(state, state[:, :2] + 500.3), atol=0.15, rtol=0.05)


def test_functional_parameters_and_vmap_over_them():
    (sparse, _), state = make(), teams(2, n=20)
    params = torch.stack([TensorDict.from_module(GraphEncoder(5, 12, 16).double()).data for _ in range(2)])

    def call(params):
        with params.to_module(sparse):
            return sparse(state)

    found = torch.vmap(call)(params)
    torch.testing.assert_close(found, torch.stack([call(one) for one in params]))
    assert not torch.allclose(found[0], found[1])


@pytest.mark.parametrize(("above", "full"), [(None, True), (16, False)])
def test_compile(above, full):
    """Dense is one graph at any size; along the edges the graph breaks and the results stay."""
    torch.compiler.reset()
    sparse, dense = make()
    encoder = GraphEncoder(5, 12, 16, sparse_above=above).double()
    encoder.load_state_dict(dense.state_dict())
    compiled = torch.compile(encoder, fullgraph=full, backend="eager")
    for state in (teams(2, n=20), teams(2, n=40)):
        torch.testing.assert_close(compiled(state), sparse(state), atol=1e-10, rtol=0)


def test_export_takes_the_dense_form_for_any_number_of_robots():
    encoder = GraphEncoder(5, 12, 16, sparse_above=16)
    robots = torch.export.Dim("robots", min=3, max=512)
    exported = torch.export.export(encoder, (teams(2, n=5, dtype=torch.float32),), dynamic_shapes=({1: robots},))
    for n in (3, 16, 100):
        state = teams(2, n=n, dtype=torch.float32)
        torch.testing.assert_close(exported.module()(state), encoder(state), atol=1e-5, rtol=0)


def test_policy_files_from_before_load(tmp_path):
    config, path = PolicyConfig(observation_dim=9, edge_features="position"), tmp_path / "policy.safetensors"
    save_policy(path, build_policy(config), config)
    header = dict(safe_open(path, framework="pt").metadata())
    since = {"edge_features", "activation", "sampler", "eta", "kind"}  # the first files say nothing of these
    fields = json.loads(header["policy"]).items()
    header["policy"] = json.dumps({name: value for name, value in fields if name not in since})
    save_file(load_file(path), path, header)
    policy = load_policy(path)
    encoder = policy[0].module
    assert set(encoder.state_dict()) == {
        f"{name}.{part}"
        for name in ("lift", "message_self", "message_mate", "message_edge", "message_out", "out")
        for part in ("weight", "bias")
        if (name, part) not in {("message_mate", "bias"), ("message_edge", "bias")}
    }
    state = teams(2, n=50, dtype=torch.float32, width=9)
    assert encoder.edge_features == "position"
    dense = GraphEncoder(9, edge_features="position", sparse_above=None)
    dense.load_state_dict(encoder.state_dict())
    torch.testing.assert_close(encoder(state), dense(state), atol=1e-5, rtol=1e-5)


def networks(width=5):
    encoder = TensorDictModule(GraphEncoder(width, 12, 16), ["observation"], ["embedding"])
    spec = Bounded(-1, 1, (2,))
    actor = DiffusionActor(DenoisingMLP(2, 12, (16,)), spec, ["embedding"], ["action"], sampler=DDPM(5))
    return encoder, actor


def test_a_policy_for_three_hundred():
    encoder, actor = networks()
    data = TensorDictSequential(encoder, actor)(TensorDict({"observation": teams(2, n=300).float()}, [2]))
    assert data["action"].shape == (2, 300, 2)
    assert data["action"].abs().max() <= 1


def test_dipo_loss_of_large_teams_equals_that_of_the_dense_form():
    torch.manual_seed(0)
    encoder, actor = networks()
    qvalue = TensorDictModule(QNetwork(12, 2, (16,)), ["embedding", "action"], ["state_action_value"])
    loss = DIPOLoss(encoder, actor, qvalue, refine_steps=2)
    loss.make_value_estimator(gamma=0.9)
    states = teams(4, n=100).float()
    flag = torch.zeros(2, 100, 1, dtype=torch.bool)
    following = {"observation": states[2:], "reward": torch.randn(2, 100, 1), "done": flag, "terminated": flag}
    data = TensorDict({"observation": states[:2], "action": torch.rand(2, 100, 2), "next": following}, [2])
    results = []
    for above in (16, None):
        loss.encoder_network.module.sparse_above = above
        torch.manual_seed(1)
        losses = loss(data.clone())
        loss.zero_grad()
        (losses["loss_qvalue"] + losses["loss_actor"]).backward()
        results.append([losses["loss_qvalue"], losses["loss_actor"]])
        results[-1] += [parameter.grad.clone() for parameter in loss.parameters() if parameter.grad is not None]
    torch.testing.assert_close(results[0], results[1], atol=1e-5, rtol=1e-5)
    assert len(results[0]) > 20
