"""The policy as one graph: ``torch.compile`` without breaks and ``torch.export``."""

import io

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.modules import DDIM, DDPM, DenoisingMLP, DiffusionActor, DPMSolver, GraphEncoder, NoiseSchedule

OBSERVATION, EMBEDDING, ACTION = ("agents", "observation"), ("agents", "embedding"), ("agents", "action")


@pytest.fixture(autouse=True)
def fresh_compiler():
    torch.compiler.reset()


def make(sampler, **options):
    torch.manual_seed(0)
    encoder = TensorDictModule(GraphEncoder(4, 6, 8, **options.pop("encoder", {})), [OBSERVATION], [EMBEDDING])
    spec, schedule = Bounded(-2, 1, (2,)), NoiseSchedule(20, "linear")  # an untrained actor does not reach the bounds
    actor = DiffusionActor(DenoisingMLP(2, 6, (16,)), spec, schedule=schedule, sampler=sampler, **options)
    return TensorDictSequential(encoder, actor)


def team(*batch, robots=5):
    return TensorDict({OBSERVATION: torch.randn(*batch, robots, 4)}, batch)


def deterministic():
    return set_exploration_type(ExplorationType.DETERMINISTIC)


@pytest.mark.parametrize("sampler", [DDPM(1), DDPM(), DDPM(5, 0.5, 3), DDIM(1), DDIM(5, 0.5), DPMSolver(5)])
def test_one_step_and_whole_chains_without_graph_breaks(sampler):
    policy, data = make(sampler), team(3)
    compiled = torch.compile(policy, fullgraph=True, backend="eager")
    for kind in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):  # the graph follows the exploration type
        with set_exploration_type(kind):
            torch.manual_seed(1)
            expected = policy(data.clone())
            torch.manual_seed(1)
            found = compiled(data.clone())
        torch.testing.assert_close(found[ACTION], expected[ACTION])


@pytest.mark.parametrize("kind", ["edgeconv", "linear"])
def test_backward_through_a_compiled_policy(kind):
    policy, data = make(DDIM(3), encoder={"kind": kind}), team(3)
    compiled = torch.compile(policy, fullgraph=True, backend="aot_eager")
    gradients = []
    for call in (policy, compiled):
        policy.zero_grad()
        with deterministic():
            call(data.clone())[ACTION].sum().backward()
        gradients.append([parameter.grad.clone() for parameter in policy.parameters()])
    torch.testing.assert_close(gradients[1], gradients[0])
    assert any(gradient.abs().max() > 0 for gradient in gradients[0])


def test_compiled_warm_start_and_latent():
    policy, data = make(DDIM(5), latent_key=("agents", "latent"), warm_start=11), team(3)
    data["agents", "latent"], data["agents", "previous_action"] = torch.randn(2, 3, 5, 2).clamp(-1, 1)
    compiled = torch.compile(policy, fullgraph=True, backend="eager")
    expected, found = policy(data.clone()), compiled(data.clone())
    for key in (ACTION, ("next", "agents", "previous_action")):
        torch.testing.assert_close(found[key], expected[key])


def test_compiled_action_loss():
    actor, embedding, action = make(DDIM(5))[-1], torch.randn(3, 5, 6), 2 * torch.rand(3, 5, 2) - 1
    compiled = torch.compile(actor.module.action_loss, fullgraph=True, backend="eager")
    torch.manual_seed(1)
    expected = actor.module.action_loss(action, embedding)
    torch.manual_seed(1)
    torch.testing.assert_close(compiled(action, embedding), expected)


def test_sampler_of_one_call_in_a_compiled_actor():
    actor, data = make(DDIM(5))[-1], TensorDict({EMBEDDING: torch.randn(3, 5, 6)}, [3])
    compiled = torch.compile(actor, fullgraph=True, backend="eager")
    with deterministic():
        for sampler in (DDIM(2), DPMSolver(3)):
            expected = actor(data.clone(), sampler=sampler)[ACTION]
            torch.testing.assert_close(compiled(data.clone(), sampler=sampler)[ACTION], expected)


@pytest.mark.parametrize("sampler", [DDPM(3), DDIM(3), DPMSolver(3)])
def test_export_with_any_number_of_teams(sampler):
    policy = make(sampler).select_out_keys(ACTION)
    teams = torch.export.Dim("teams", min=1, max=1024)
    file = io.BytesIO()
    with deterministic(), torch.no_grad():
        exported = torch.export.export(policy, (torch.randn(3, 5, 4),), dynamic_shapes=({0: teams},), strict=False)
        torch.export.save(exported, file)
        file.seek(0)
        loaded = torch.export.load(file).module()
        for batch in (1, 3, 11):
            observation = torch.randn(batch, 5, 4)
            expected = policy(agents_observation=observation)
            torch.testing.assert_close(loaded(observation), expected, atol=1e-5, rtol=0)
    assert not torch.equal(loaded(observation), loaded(observation + 1))  # outside the context it stays deterministic
    assert torch.equal(loaded(observation), loaded(observation))


def test_export_by_keyword():
    """As TorchRL's tutorial on export calls its policies."""
    policy, observation = make(DDIM(3)).select_out_keys(ACTION), torch.randn(3, 5, 4)
    with deterministic(), torch.no_grad():
        exported = torch.export.export(policy, args=(), kwargs={"agents_observation": observation}, strict=False)
        found = exported.module()(agents_observation=observation)
        torch.testing.assert_close(found, policy(agents_observation=observation), atol=1e-5, rtol=0)
