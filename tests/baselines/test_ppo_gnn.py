import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.distributions import AffineTransform, Independent, Normal, TanhTransform, TransformedDistribution
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.baselines import gaussian_policy, state_value
from redig.modules import GraphEncoder
from redig.policy import PolicyConfig, build_policy, load_policy, save_policy

OBSERVATION, ACTION, LOG_PROB = ("agents", "observation"), ("agents", "action"), ("agents", "action_log_prob")
LOW, HIGH = torch.tensor([-1.0, -0.5]), torch.tensor([1.0, 2.0])


def encoder(out="embedding"):
    return TensorDictModule(GraphEncoder(9), [OBSERVATION], [("agents", out)])


def policy(**options):
    module = gaussian_policy(encoder(), 64, LOW, HIGH, **options)
    torch.nn.init.normal_(module[1].module[0][-1].weight)  # far from the near zero mean that it starts with
    return module


def team(observation):
    return TensorDict({"agents": {"observation": observation}}, observation.shape[:-2])


@settings(max_examples=15, deadline=None)
@given(n=st.integers(1, 9), batch=st.lists(st.integers(1, 3), max_size=2), seed=st.integers(0, 1000))
def test_shapes_and_permutation_equivariance_for_any_team(n, batch, seed):
    torch.manual_seed(seed)
    observation, order = torch.randn(*batch, n, 9), torch.randperm(n)
    for module, key, width in (
        (policy(), ACTION, 2),
        (state_value(encoder("other"), 64), ("agents", "state_value"), 1),
        (state_value(encoder("other"), 64, centralised=True), ("agents", "state_value"), 1),
    ):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            straight, permuted = (module(team(o))[key] for o in (observation, observation[..., order, :]))
        assert straight.shape == (*batch, n, width)
        torch.testing.assert_close(permuted, straight[..., order, :], rtol=1e-4, atol=1e-5)
    assert policy()(team(observation))[LOG_PROB].shape == (*batch, n)


def test_a_robot_decides_on_what_it_hears_alone():
    near = torch.randn(2, 9)
    far = torch.randn(1, 9)
    far[:, :2] += 50
    alone, together = near, torch.cat([near, far])
    central = state_value(encoder("other"), 64, centralised=True)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for module, key in ((policy(), ACTION), (state_value(encoder("other"), 64), ("agents", "state_value"))):
            torch.testing.assert_close(module(team(together))[key][:2], module(team(alone))[key])
        values = [central(team(observation))["agents", "state_value"][:2] for observation in (alone, together)]
    assert (values[0] - values[1]).abs().min() > 1e-4


def test_the_density_is_that_of_a_squashed_gaussian():
    module = policy(initial_std=0.7)
    data = module(team(torch.randn(50, 5, 9)))
    loc, scale = data["agents", "loc"].double(), data["agents", "scale"].double()
    torch.testing.assert_close(scale, torch.full_like(scale, 0.7), rtol=1e-3, atol=1e-3)
    squash = [TanhTransform(), AffineTransform(((LOW + HIGH) / 2).double(), ((HIGH - LOW) / 2).double())]
    expected = TransformedDistribution(Independent(Normal(loc, scale), 1), squash).log_prob(data[ACTION].double())
    inside = ((data[ACTION] - LOW).abs() > 1e-3) & ((data[ACTION] - HIGH).abs() > 1e-3)
    inside = inside.all(-1)
    assert inside.float().mean() > 0.5
    torch.testing.assert_close(data[LOG_PROB].double()[inside], expected[inside], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("bound", [LOW, HIGH], ids=["low", "high"])
def test_log_probability_and_its_gradient_are_finite_at_the_bounds(bound):
    module = policy(initial_std=0.05)
    distribution = module.get_dist(team(torch.randn(8, 5, 9)))
    log_prob = distribution.log_prob(bound.expand(8, 5, 2))
    log_prob.mean().backward()
    assert log_prob.isfinite().all()
    assert all(p.grad.isfinite().all() for p in module.parameters() if p.grad is not None)


def test_actions_stay_within_bounds_and_the_mean_action_is_the_squashed_mean():
    module = policy(initial_std=3.0)
    data = module(team(10 * torch.randn(200, 5, 9)))
    assert (data[ACTION] >= LOW).all() and (data[ACTION] <= HIGH).all()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        mean = module(data.clone())
    squashed = mean["agents", "loc"].tanh() * (HIGH - LOW) / 2 + (HIGH + LOW) / 2
    torch.testing.assert_close(mean[ACTION], squashed, rtol=1e-4, atol=1e-5)


def test_a_new_policy_is_near_the_middle_of_the_bounds():
    module = gaussian_policy(encoder(), 64, LOW, HIGH)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        action = module(team(torch.randn(8, 5, 9)))[ACTION]
    assert (action - (LOW + HIGH) / 2).abs().max() < 0.1


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="initial_std: got 0.0"):
        policy(initial_std=0.0)
    with pytest.raises(ValueError, match="activation: got 'step'"):
        state_value(encoder(), 64, activation="step")
    with pytest.raises(ValueError, match="kind: got 'oracle', allowed are diffusion, gaussian"):
        build_policy(PolicyConfig(9, kind="oracle"))
    with pytest.raises(ValueError, match="a ppo policy has no chain"):
        build_policy(PolicyConfig(9, kind="ppo"), fixed_latent=True)


def test_a_policy_file_gives_the_same_actions(tmp_path):
    from redig.modules import DDPM

    config = PolicyConfig(9, kind="ppo", hidden=(32, 32), activation="tanh")
    module = build_policy(config)
    for parameter in module.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    path = tmp_path / "policy.safetensors"
    save_policy(path, module, config, {"formation": "line"})
    observation = torch.randn(8, 5, 9)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        one, two = (net(team(observation))[ACTION] for net in (module, load_policy(path, 9)))
    assert torch.equal(one, two)
    assert math.isfinite(one.sum().item()) and one.std() > 0.01
    with pytest.raises(ValueError, match="holds a ppo policy"):
        load_policy(path, sampler=DDPM(5))
