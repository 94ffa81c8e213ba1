from dataclasses import replace

import numpy as np
import onnx
import onnx_ir
import onnxruntime
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig import deploy
from redig.deploy import export_policy
from redig.deploy.chain import _translate
from redig.envs import make_env
from redig.evaluation import evaluate
from redig.modules import DDIM, DDPM, DenoisingMLP, DiffusionActor, DPMSolver, NoiseSchedule, Sampler
from redig.policy import ACTION, OBSERVATION, PolicyConfig, build_policy, load_policy, read_header

SHIPPED = "recipes/policies/wedge.safetensors"
# with random weights, chains of the linear schedule end between the bounds; those of the others, mostly at them
SMALL = PolicyConfig(
    9,
    (-0.5, 0.0),
    (2.0, 0.1),
    embedding_dim=6,
    encoder_hidden=6,
    hidden=(8, 4),
    diffusion_steps=10,
    schedule="linear",
    sampling_steps=4,
)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Export a policy and load it."""

    def through_a_file(policy, seed=None, **options):
        path = tmp_path_factory.mktemp("exported") / "policy.onnx"
        export_policy(policy, path, **options)
        return deploy.load_policy(path, seed=seed)

    return through_a_file


class Renoise(Sampler):
    """A sampler of a user's own: noises the estimate afresh at every step."""

    def coefficients(self, schedule, step, previous, older, deterministic):
        signal = schedule.signal(previous)
        return signal**0.5, 0.0, 0.0, (1 - signal) ** 0.5


def actor_with(sampler, **options):
    torch.manual_seed(0)
    spec = Bounded(torch.tensor([-0.5, 0.0]), torch.tensor([2.0, 0.1]), (2,))
    denoiser = options.pop("denoiser", None) or DenoisingMLP(2, 6, (8, 8))
    return DiffusionActor(denoiser, spec, ["embedding"], ["action"], NoiseSchedule(20, "linear"), sampler, **options)


def act(policy, observation, kind=ExplorationType.DETERMINISTIC):
    observation = torch.as_tensor(observation)
    with torch.no_grad(), set_exploration_type(kind):
        return policy(TensorDict({"agents": {"observation": observation}}, observation.shape[:-2]))[ACTION].numpy()


def assert_equal(actions, expected):
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    low, high = np.array(SMALL.action_low), np.array(SMALL.action_high)
    assert (
        (expected > low + 1e-4) & (expected < high - 1e-4)
    ).mean() > 0.3  # not all at the bounds, where all is equal


def teams(n, batch=3, width=9, scale=1.5, seed=0):
    """Teams of which some are close together and some out of each other's range."""
    generator = np.random.default_rng(seed)
    observation = generator.standard_normal((batch, n, width)).astype(np.float32)
    observation[..., :2] *= scale
    return observation


@pytest.mark.parametrize("sampler", [DDPM(7, noise_ratio=0), DDIM(5, eta=1.0), DPMSolver(6)], ids=str)
def test_deterministic_actions_equal_the_actors(sampler, exported):
    actor = actor_with(sampler)
    embedding = torch.randn(4, 3, 6)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = actor(TensorDict({"embedding": embedding}))["action"].numpy()
    policy = exported(actor)
    assert not policy.stochastic
    assert_equal(policy(embedding.numpy()), expected)


@pytest.mark.parametrize(
    "sampler", [DDPM(), DDPM(None, 0.5, 3), DDIM(5, eta=1.0), DPMSolver(6), Renoise(4)], ids=lambda s: repr(s)
)
def test_stochastic_actions_equal_the_actors_on_the_same_latent_and_noise(sampler, exported, monkeypatch):
    actor, draw, drawn = actor_with(sampler), torch.randn, []
    embedding = torch.randn(4, 3, 6)
    monkeypatch.setattr(torch, "randn", lambda *shape, **options: drawn.append(draw(*shape, **options)) or drawn[-1])
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        expected = actor(TensorDict({"embedding": embedding}))["action"].numpy()
    monkeypatch.undo()
    latent, *noise = drawn
    noise = torch.cat([part.reshape(-1, 4, 3, 2) for part in noise]).numpy() if noise else None
    policy = exported(actor, stochastic=True)
    assert_equal(policy(embedding.numpy(), latent=latent.numpy(), noise=noise), expected)


def test_sampling_follows_the_distribution_of_the_actor(exported):
    actor = actor_with(DDPM(5))
    embedding = torch.randn(1, 6).expand(4000, 1, 6)
    with torch.no_grad():
        ours = actor(TensorDict({"embedding": embedding}))["action"].numpy()
    theirs = exported(actor, seed=0, stochastic=True)(embedding.numpy())
    for moment in (np.mean, np.std):
        np.testing.assert_allclose(moment(theirs, 0), moment(ours, 0), atol=5 * ours.std() / 4000**0.5)


@pytest.mark.parametrize(
    "ego, changes",
    [
        (False, {"aggregation": "max"}),
        (False, {"aggregation": "sum", "activation": "silu"}),
        (False, {"aggregation": "mean", "encoder_activation": "tanh", "activation": "relu"}),
        (False, {"encoder": "linear", "encoder_activation": None, "observation_dim": 7, "radius": 1.0}),
        (True, {"aggregation": "max", "encoder_activation": "silu"}),
        (True, {"aggregation": "mean"}),
        (True, {"encoder": "linear", "encoder_activation": "mish", "activation": "tanh"}),
    ],
)
def test_encoders_for_any_team_size(ego, changes, exported):
    torch.manual_seed(1)
    config = replace(SMALL, **changes)
    policy = build_policy(config)
    robots = exported(policy, ego=ego)
    assert robots.ego is ego
    for n in range(1, 9):
        for scale in (0.1, 1.5, 1000.0):  # all hear each other; some do; none does
            observation = teams(n, width=config.observation_dim, scale=scale, seed=n)
            expected = act(policy, observation)
            assert_equal(robots(observation), expected[:, 0] if ego else expected)


@pytest.fixture(scope="module")
def small(exported):
    torch.manual_seed(2)
    policy = build_policy(SMALL)
    return policy, exported(policy), exported(policy, ego=True)


coordinates = st.floats(-4, 4, width=32).map(lambda x: round(x, 2) + 0.001)


@settings(deadline=None, max_examples=50)
@given(st.data(), st.integers(1, 8))
def test_any_observation(small, data, n):
    policy, team, ego = small
    observation = data.draw(arrays(np.float32, (n, 9), elements=coordinates))
    offset = observation[:, None, :2].astype(float) - observation[:, :2]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    observation[:, :2] *= 1 if np.abs(distance - 2.0).min() > 1e-4 else 0.5  # at the radius itself, rounding decides
    expected = act(policy, observation)
    np.testing.assert_allclose(team(observation), expected, atol=1e-5)
    np.testing.assert_allclose(ego(observation), expected[0], atol=1e-5)


def test_batches_of_teams(small):
    policy, team, ego = small
    observation = teams(5, batch=6).reshape(2, 3, 5, 9)
    expected = act(policy, observation)
    np.testing.assert_allclose(team(observation), expected, atol=1e-5)
    np.testing.assert_allclose(ego(observation), expected[..., 0, :], atol=1e-5)
    np.testing.assert_allclose(team(observation[0, 0].astype(np.float64).tolist()), expected[0, 0], atol=1e-5)


def test_a_robot_out_of_range_makes_no_difference(small):
    *_, ego = small
    observation = teams(3, batch=1)[0]
    observation[:, :2] = [[0, 0], [1, 0], [100, 0]]
    np.testing.assert_allclose(ego(observation), ego(observation[:2]), atol=1e-6)
    assert np.abs(ego(observation) - ego(observation[[0, 2]])).max() > 1e-5  # but the one within range does


@pytest.mark.parametrize("ego", [False, True])
def test_networks_of_a_users_own(ego, exported):
    class MeanOfTheTeam(nn.Module):
        def forward(self, observation):
            return (observation - observation.mean(-2, keepdim=True)).tanh()

    class Shifted(nn.Module):
        def __init__(self):
            super().__init__()
            self.net = nn.Linear(4, 2)

        def forward(self, action, step, embedding):
            return self.net((embedding + action.sum(-1, keepdim=True)).sin() + 0.1 * step)

    encoder = TensorDictModule(MeanOfTheTeam(), [OBSERVATION], ["embedding"])
    policy = TensorDictSequential(encoder, actor_with(DDPM(5), denoiser=Shifted()))
    robots = exported(policy, input_dim=4, ego=ego)
    for n in (2, 5):
        observation = teams(n, width=4)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            expected = policy(TensorDict({"agents": {"observation": torch.from_numpy(observation)}}))["action"].numpy()
        np.testing.assert_allclose(robots(observation), expected[:, 0] if ego else expected, atol=1e-5)


def test_mish_with_one_exponential():
    x = torch.cat([torch.linspace(-100, 100, 20_001), torch.tensor([-1e30, 1e30])])
    model = onnx_ir.to_proto(_translate(nn.Mish(), {"x": x}, "y", [None]))
    assert "Exp" in {node.op_type for node in model.graph.node}
    (y,) = onnxruntime.InferenceSession(model.SerializeToString()).run(None, {"x": x.numpy()})
    np.testing.assert_allclose(y, nn.functional.mish(x.double()).numpy(), rtol=1e-5, atol=1e-37)


def test_files_are_valid_onnx_of_standard_operators_without_traces_of_the_source(tmp_path):
    export_policy(build_policy(SMALL), tmp_path / "policy.onnx", stochastic=True)
    model = onnx.load(tmp_path / "policy.onnx")
    onnx.checker.check_model(model, full_check=True)
    assert {node.domain for node in model.graph.node} == {""}
    assert [opset.domain for opset in model.opset_import] == [""] and not model.functions
    assert not any(node.doc_string or node.metadata_props for node in model.graph.node)
    weights = [np.prod(tensor.dims) for tensor in model.graph.initializer]
    assert sum(weights) < 1.3 * sum(parameter.numel() for parameter in build_policy(SMALL).parameters())  # one copy


def test_the_policy_is_left_as_it_was(tmp_path):
    policy = build_policy(SMALL).to(torch.bfloat16).train()
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    export_policy(policy, tmp_path / "policy.onnx")
    assert policy.training and all(module.training for module in policy.modules())
    for name, value in policy.state_dict().items():
        assert value.dtype == before[name].dtype and torch.equal(value, before[name]), name


def test_a_team_driven_by_the_exported_policy_arrives(exported):
    module, (_, scenario) = load_policy(SHIPPED), read_header(SHIPPED)
    robots, difference = exported(module), []

    def drive(observation):
        action = robots(observation.numpy())
        difference.append(np.abs(action - act(module, observation)).max())
        return torch.from_numpy(action)

    metrics = evaluate(TensorDictModule(drive, [OBSERVATION], [ACTION]), make_env(4, **scenario), seed=7)
    assert metrics["team_success_rate"] == 1
    assert len(difference) > 50 and max(difference) < 1e-5


class OwnLoop(DDPM):
    def __call__(self, *arguments, **options):
        raise NotImplementedError


def test_what_cannot_be_exported(tmp_path):
    def refused(policy, **options):
        export_policy(policy, tmp_path / "policy.onnx", **options)

    encoder, actor = build_policy(SMALL)
    with pytest.raises(TypeError, match="got TensorDictModule; expected an encoder and a DiffusionActor"):
        refused(encoder)
    with pytest.raises(TypeError, match="got TensorDictModule, TensorDictModule, DiffusionActor"):
        refused(TensorDictSequential(encoder, encoder, actor))
    for keeping in ({"fixed_latent": True}, {"warm_start": 5}):
        with pytest.raises(ValueError, match="keeps a latent or its previous action"):
            refused(build_policy(SMALL, **keeping))
    with pytest.raises(ValueError, match="reads .*one.*two.*, must be one key"):
        refused(DiffusionActor(DenoisingMLP(2, 6), Bounded(-1, 1, (2,)), ["one", "two"], ["action"]))
    with pytest.raises(ValueError, match=r"the actor reads \['embedding'\], the encoder writes"):
        refused(TensorDictSequential(encoder, actor_with(DDPM())))
    with pytest.raises(ValueError, match="input_dim: got None, .* not for Linear"):
        refused(TensorDictSequential(TensorDictModule(nn.Linear(3, 6), ["state"], ["embedding"]), actor_with(DDPM())))
    with pytest.raises(ValueError, match="OwnLoop.* has a loop of its own"):
        refused(actor_with(OwnLoop(3)))
    assert list(tmp_path.iterdir()) == []
