import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.modules import GaussianActor, QNetwork
from redig.modules.gaussian import LOG_STD
from redig.objectives import DIPOLoss
from redig.policy import PolicyConfig, build_policy, load_policy, save_policy


def make(stochastic=True, low=-1.0, high=3.0, width=4):
    torch.manual_seed(0)
    net = nn.Linear(width, 2 * (1 + stochastic))
    return GaussianActor(net, Bounded(low, high, (5, 2)), ["embedding"], ["action"], stochastic)


def test_loss_is_the_negative_log_likelihood_of_torch_distributions():
    actor, embedding = make(), torch.randn(8, 5, 4)
    action = 4 * torch.rand(8, 5, 2) - 1
    mean, log_std = actor.module.distribution(embedding)
    scaled = action / 2 - 0.5  # from [-1, 3] to [-1, 1]
    constant = 0.5 * torch.log(torch.tensor(2 * torch.pi))
    expected = -torch.distributions.Normal(mean, log_std.exp()).log_prob(scaled).mean(-1) - constant
    torch.testing.assert_close(actor.module.action_loss(action, embedding), expected)


def test_deterministic_loss_is_half_the_squared_error():
    actor, embedding = make(stochastic=False), torch.randn(8, 5, 4)
    found = actor.module.action_loss(torch.ones(8, 5, 2), embedding)  # the middle of the bounds
    torch.testing.assert_close(found, 0.5 * actor.module.net(embedding).square().mean(-1))


def test_samples_have_mean_and_standard_deviation_of_the_network():
    actor = make(low=-100.0, high=100.0)
    with torch.no_grad():  # far enough from the bounds
        actor.module.net.weight.mul_(0.1)
        actor.module.net.bias.copy_(torch.tensor([0.1, -0.2, -2.0, -3.0]))
    embedding = torch.randn(1, 4)
    mean, log_std = actor.module.distribution(embedding)
    with set_exploration_type(ExplorationType.RANDOM):
        sample = actor.module(embedding.expand(100_000, 4))
    torch.testing.assert_close(sample.mean(0, keepdim=True), 100 * mean, atol=0.3, rtol=0)
    torch.testing.assert_close(sample.std(0, keepdim=True), 100 * log_std.exp(), atol=0, rtol=0.02)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(actor.module(embedding), 100 * mean, atol=1e-4, rtol=1e-5)


def test_actions_stay_within_the_bounds_and_the_deviation_within_its_limits():
    actor = make()
    with torch.no_grad():
        actor.module.net.weight.mul_(1e3)
    embedding = torch.randn(64, 5, 4)
    action = actor(TensorDict({"embedding": embedding}, [64]))["action"]
    assert action.min() >= -1 and action.max() <= 3
    assert actor.spec["action"].is_in(action[0])
    log_std = actor.module.distribution(embedding)[1]
    assert (log_std.min().item(), log_std.max().item()) == LOG_STD


def test_deterministic_actor_ignores_the_exploration_type():
    actor, data = make(stochastic=False), TensorDict({"embedding": torch.randn(8, 5, 4)}, [8])
    with set_exploration_type(ExplorationType.RANDOM):
        assert torch.equal(actor(data.clone())["action"], actor(data.clone())["action"])


@pytest.mark.parametrize("stochastic", [True, False])
def test_dipo_finds_the_best_action_with_it(stochastic):
    """A bandit whose value is highest at 0.6: critics learn it, refinement climbs it, the actor follows."""
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(1, 32), nn.ReLU(), nn.Linear(32, 1 + stochastic))
    actor = GaussianActor(net, Bounded(-1, 1, (1,)), ["observation"], ["action"], stochastic)
    qvalue = TensorDictModule(QNetwork(1, 1, (32, 32), activation="relu"), ["observation", "action"], ["value"])
    loss = DIPOLoss(None, actor, qvalue, refine_steps=1, refine_step_size=0.3, refine_from="policy")
    loss.set_keys(state_action_value="value")
    loss.make_value_estimator(gamma=0.9)
    optimizer = torch.optim.Adam(loss.parameters(), 3e-3)
    for _ in range(600):
        action = 2 * torch.rand(64, 1) - 1
        ended = torch.ones(64, 1, dtype=torch.bool)
        following = {"observation": torch.ones(64, 1), "reward": -(action - 0.6).square(), "done": ended}
        data = {"observation": torch.ones(64, 1), "action": action, "next": {**following, "terminated": ended}}
        found = loss(TensorDict(data, [64]))
        optimizer.zero_grad()
        (found["loss_qvalue"] + found["loss_actor"]).backward()
        optimizer.step()
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        assert actor.module(torch.ones(1, 1)).item() == pytest.approx(0.6, abs=0.08)


@pytest.mark.parametrize("kind", ["gaussian", "deterministic"])
def test_policy_files(kind, tmp_path):
    config = PolicyConfig(observation_dim=9, hidden=(16,), kind=kind)
    policy = build_policy(config)
    save_policy(tmp_path / "policy.safetensors", policy, config)
    loaded, team = load_policy(tmp_path / "policy.safetensors"), {"agents": {"observation": torch.randn(2, 5, 9)}}
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        found, expected = (one(TensorDict(team, [2]).clone())["agents", "action"] for one in (loaded, policy))
    assert torch.equal(found, expected)


def test_errors():
    with pytest.raises(ValueError, match="kind: got 'flow', allowed are diffusion, gaussian, deterministic, ppo"):
        build_policy(PolicyConfig(observation_dim=9, kind="flow"))
    with pytest.raises(ValueError, match="a gaussian policy has no chain"):
        build_policy(PolicyConfig(observation_dim=9, kind="gaussian"), warm_start=3)
    with pytest.raises(ValueError, match="out_keys: got"):
        GaussianActor(nn.Linear(4, 4), Bounded(-1, 1, (2,)), ["embedding"], ["action", "more"])
    with pytest.raises(ValueError, match=r"action: got shape \[8, 3\], expected \[8, 2\]"):
        make().module.action_loss(torch.zeros(8, 3), torch.zeros(8, 4))
