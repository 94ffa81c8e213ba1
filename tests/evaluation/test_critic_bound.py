import math

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded

from redig.evaluation import (
    algorithmic_error,
    bellman_residual,
    coverage,
    coverage_constant,
    density_ratio,
    statistical_error,
)
from redig.modules import DenoisingMLP, DiffusionActor, GraphEncoder, NoiseSchedule, QNetwork
from redig.objectives import DIPOLoss

STATES, GAMMA = 6, 0.9


class Table(nn.Module):
    """Q of a one-hot state; the only action is known, so it does not matter."""

    def __init__(self):
        super().__init__()
        self.value = nn.Parameter(torch.zeros(STATES))

    def forward(self, observation, action):
        return (observation * self.value).sum(-1, keepdim=True)


class Constant(nn.Module):
    """An actor that always does the same; nothing here trains it."""

    def __init__(self, action):
        super().__init__()
        self.action = nn.Parameter(torch.tensor(action))
        self.register_buffer("low", -torch.ones(len(action)))
        self.register_buffer("high", torch.ones(len(action)))

    def forward(self, observation):
        return self.action.expand(*observation.shape[:-1], -1)

    def action_loss(self, action, observation):
        raise NotImplementedError


def chain_of_states(seed=0):
    """A deterministic chain: next state, reward and whether it ends, for each of the states."""
    generator = torch.Generator().manual_seed(seed)
    following = torch.randint(STATES, (STATES,), generator=generator)
    reward = torch.rand(STATES, generator=generator) * 2 - 1
    return following, reward, torch.tensor([False, True, False, False, True, False])


def tabular_loss(tables, targets):
    """The loss around two known tables and their targets."""
    actor = TensorDictModule(Constant([0.0]), in_keys=["observation"], out_keys=["action"])
    critic = TensorDictModule(Table(), in_keys=["observation", "action"], out_keys=["state_action_value"])
    loss = DIPOLoss(None, actor, critic).make_value_estimator(gamma=GAMMA)
    loss.qvalue_network_params["module", "value"].data.copy_(torch.stack(tables))
    loss.target_qvalue_network_params["module", "value"].data.copy_(torch.stack(targets))
    return loss


def tabular_batch(states):
    """Transitions from ``states`` ``[B, n]``."""
    following, reward, over = (part[states] for part in chain_of_states())
    next_td = {
        "observation": nn.functional.one_hot(following, STATES).float(),
        "reward": reward.unsqueeze(-1),
        "done": over.unsqueeze(-1),
        "terminated": over.unsqueeze(-1),
    }
    data = {"observation": nn.functional.one_hot(states, STATES).float(), "action": torch.zeros(*states.shape, 1)}
    return TensorDict({**data, "next": next_td}, states.shape[:1])


def true_value():
    """Q* of the chain, from the linear system ``(I - gamma P) Q = R``."""
    following, reward, over = chain_of_states()
    step = torch.zeros(STATES, STATES)
    step[torch.arange(STATES), following] = (~over).float()
    return torch.linalg.solve(torch.eye(STATES) - GAMMA * step, reward)


# --- Bellman residual


def test_the_true_value_has_no_residual():
    exact = true_value()
    residual = bellman_residual(tabular_loss([exact] * 2, [exact] * 2), tabular_batch(torch.randint(STATES, (50, 3))))
    torch.testing.assert_close(residual, torch.zeros(50, 3, 1), atol=1e-6, rtol=0)


def test_residual_by_a_double_loop():
    torch.manual_seed(1)
    tables, targets = torch.randn(2, 2, STATES)
    states = torch.randint(STATES, (20, 3))
    residual = bellman_residual(tabular_loss(list(tables), list(targets)), tabular_batch(states))
    following, reward, over = chain_of_states()
    for b in range(20):
        for i in range(3):
            s = states[b, i]
            ahead = 0.0 if over[s] else min(float(target[following[s]]) for target in targets)
            errors = [abs(float(table[s]) - float(reward[s]) - GAMMA * ahead) for table in tables]
            assert residual[b, i, 0].item() == pytest.approx(sum(errors) / 2, abs=1e-5)


def test_largest_residual_bounds_the_error_of_the_value():
    """With Q its own target, |Q - Q*| <= S / (1 - gamma) in the largest norm, and so the printed term does."""
    states = torch.arange(STATES).unsqueeze(-1)
    for seed in range(20):
        torch.manual_seed(seed)
        table = torch.randn(STATES)
        largest = bellman_residual(tabular_loss([table] * 2, [table] * 2), tabular_batch(states)).max().item()
        gap = (table - true_value()).abs().max().item()
        assert gap <= largest / (1 - GAMMA) + 1e-5
        assert gap <= statistical_error(largest, 1.0, GAMMA) + 1e-5


def test_residual_leaves_batch_and_gradients_alone():
    data = tabular_batch(torch.randint(STATES, (4, 3)))
    before = data.clone()
    residual = bellman_residual(tabular_loss([torch.ones(STATES)] * 2, [torch.ones(STATES)] * 2), data)
    assert not residual.requires_grad
    assert set(data.keys(True, True)) == set(before.keys(True, True))
    assert (data == before).all()


def test_residual_under_nested_keys():
    def key(name):
        return ("agents", name)

    spec = Bounded(-1, 1, (3, 2))
    encoder = TensorDictModule(GraphEncoder(4, 8, 8), in_keys=[key("observation")], out_keys=[key("embedding")])
    actor = DiffusionActor(DenoisingMLP(2, 8, (8,)), spec, [key("embedding")], [key("action")], NoiseSchedule(2))
    critic = TensorDictModule(QNetwork(8, 2, (8,)), [key("embedding"), key("action")], [key("state_action_value")])
    loss = DIPOLoss(encoder, actor, critic)
    names = ("action", "state_action_value", "reward", "done", "terminated", "priority")
    loss.set_keys(**{name: key("td_error" if name == "priority" else name) for name in names})
    loss.make_value_estimator(gamma=GAMMA)
    over = torch.zeros(16, 3, 1, dtype=torch.bool)
    agents = {"observation": torch.randn(16, 3, 4), "reward": torch.ones(16, 3, 1), "done": over, "terminated": over}
    data = {"observation": torch.randn(16, 3, 4), "action": torch.zeros(16, 3, 2)}
    data = TensorDict({"agents": data, "next": {"agents": agents}}, [16])
    assert bellman_residual(loss, data).shape == (16, 3, 1)
    assert "td_error" not in data["agents"]
    assert coverage(loss, data, num_neighbours=10).shape == (48,)


# --- coverage


def pairs(count, shift=0.0, width=1, seed=0):
    """Embeddings ``[count, width]`` and actions ``[count, 1]``, standard normal but for a shift of the action."""
    generator = torch.Generator().manual_seed(seed)
    embedding = torch.randn(count, width, generator=generator)
    return embedding, torch.randn(count, 1, generator=generator) + shift


def test_density_ratio_is_one_where_policy_and_buffer_agree():
    ratio = density_ratio(*pairs(2000), *pairs(2000, seed=1))
    # E[(k + 2) / (B + 1)] - 1 = 1 + 2 / (k + 1) for B binomial(k, 1/2), k = 50; the ratios of neighbours are alike,
    # so the mean scatters more than 2 / sqrt(50 * 2000) would say
    assert ratio.mean().item() == pytest.approx(1.04, abs=0.05)
    assert ratio.std().item() == pytest.approx(2 / math.sqrt(50), rel=0.25)


@pytest.mark.parametrize("width", [1, 16])
def test_density_ratio_of_shifted_gaussians(width):
    """N(1, 1) over N(0, 1) is exp(a - 1/2); the embedding tells nothing."""
    embedding, action = pairs(3000, shift=1.0, width=width)
    ratio = density_ratio(embedding, action, *pairs(3000, width=width, seed=1))
    log = ratio.log()
    expected = action.squeeze(-1) - 0.5
    assert torch.corrcoef(torch.stack([log, expected]))[0, 1].item() > 0.85
    middle = expected.abs() < 0.5  # the tails are smoothed
    assert (log - expected)[middle].mean().abs().item() < 0.1


def test_density_ratio_counts_action_and_embedding_equally():
    """Only the action differs, in one of 65 columns; it is seen nevertheless."""
    embedding, action = pairs(1000, shift=5.0, width=64)
    assert density_ratio(embedding, action, *pairs(1000, width=64, seed=1)).median().item() > 10


def test_density_ratio_against_unequal_counts():
    torch.manual_seed(0)
    zero = torch.zeros(500, 1), torch.zeros(2000, 1)
    ratio = density_ratio(zero[0], torch.rand(500, 1) / 4, zero[1], torch.rand(2000, 1))
    assert ratio.median().item() == pytest.approx(4.0, rel=0.15)


def test_density_ratio_ends_where_neighbours_end():
    torch.manual_seed(0)
    nothing = torch.zeros(400, 1)
    ratio = density_ratio(nothing, 10 + torch.rand(400, 1), nothing, torch.rand(400, 1), num_neighbours=20)
    # 21 of 400 against 1 of 401
    torch.testing.assert_close(ratio, torch.full((400,), 21 / 400 * 401))


@pytest.mark.parametrize("num_neighbours", [0, 20])
def test_bad_number_of_neighbours(num_neighbours):
    with pytest.raises(ValueError, match=r"num_neighbours: got \d+, must be in \[1, N \+ M - 1\] = \[1, 19\]"):
        density_ratio(*pairs(10), *pairs(10), num_neighbours=num_neighbours)


def constant_loss(action):
    actor = TensorDictModule(Constant(action), in_keys=["observation"], out_keys=["action"])
    critic = TensorDictModule(QNetwork(2, 2, (8,)), in_keys=["observation", "action"], out_keys=["state_action_value"])
    return DIPOLoss(None, actor, critic)


def stationary(batch, over):
    """States and next states of one distribution; actions around 0.5."""
    torch.manual_seed(0)
    data = {"observation": torch.randn(batch, 3, 2), "action": 0.5 + 0.01 * torch.randn(batch, 3, 2)}
    return TensorDict({**data, "next": {"observation": torch.randn(batch, 3, 2), "terminated": over}}, [batch])


def test_coverage_knows_actions_that_the_buffer_has_from_others():
    data = stationary(200, torch.zeros(200, 3, 1, dtype=torch.bool))
    inside, outside = (coverage(constant_loss([a, a]), data).mean().item() for a in (0.5, -0.5))
    assert outside > 40  # at the end of the scale
    assert outside > 2 * inside


@pytest.mark.parametrize("per_robot", [True, False])
def test_coverage_leaves_out_what_ended(per_robot):
    over = torch.rand(100, 3, 1) < 0.4 if per_robot else torch.rand(100, 1) < 0.4
    left = (~over).sum().item() * (1 if per_robot else 3)
    assert coverage(constant_loss([0.5, 0.5]), stationary(100, over)).shape == (left,)


def test_coverage_reads_the_target_networks():
    loss = constant_loss([0.5, 0.5])
    data = stationary(200, torch.zeros(200, 3, 1, dtype=torch.bool))
    before = coverage(loss, data)
    loss.actor_network_params["module", "action"].data.fill_(-0.5)
    assert coverage(loss, data).equal(before)
    loss.target_actor_network_params["module", "action"].data.fill_(-0.5)
    assert coverage(loss, data).mean() > 2 * before.mean()


@settings(deadline=None)
@given(st.floats(0, 0.95), st.floats(0, 3))
def test_coverage_constant_is_the_series_of_eq_18(gamma, ratio):
    assume(gamma * ratio < 0.95)
    series = sum(gamma ** (m - 1) * sum(ratio**j for j in range(m)) for m in range(1, 500))
    assert coverage_constant(ratio, gamma) == pytest.approx((1 - gamma) ** 2 * series, rel=1e-5)


def test_coverage_constant_of_a_growing_series_is_infinite():
    assert coverage_constant(1 / 0.98, gamma=0.98) == math.inf
    assert coverage_constant(5.0, gamma=0.5) == math.inf


# --- the two terms


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10_000), st.floats(1 / 3, 0.97), st.integers(0, 30), st.floats(0, 0.5))
def test_theorem_2_holds_for_fitted_iteration_on_a_random_chain(seed, gamma, iterations, noise):
    """Q_m = T Q_{m-1} + e_m on a Markov chain: the printed bound in the largest norm, where C = 1."""
    generator = torch.Generator().manual_seed(seed)
    step = torch.rand(8, 8, generator=generator, dtype=torch.float64)
    step /= step.sum(-1, keepdim=True)
    reward = torch.rand(8, generator=generator, dtype=torch.float64) * 2 - 1
    exact = torch.linalg.solve(torch.eye(8, dtype=torch.float64) - gamma * step, reward)
    value = (torch.rand(8, generator=generator, dtype=torch.float64) * 2 - 1) / (1 - gamma)  # within Eq. 26
    largest = 0.0
    for _ in range(iterations):
        error = noise * (torch.rand(8, generator=generator, dtype=torch.float64) * 2 - 1)
        largest = max(largest, error.abs().max().item())
        value = reward + gamma * step @ value + error
    bound = statistical_error(largest, coverage_constant(1.0, gamma), gamma) + algorithmic_error(iterations, 1.0, gamma)
    assert (value - exact).abs().max().item() <= bound + 1e-9


def test_the_printed_bound_fails_below_a_third():
    """Errata of the theory page: at gamma = 0 the printed bound is 0, and Q = R + e is off by e."""
    assert statistical_error(0.3, 1.0, gamma=0.0) + algorithmic_error(5, 1.0, gamma=0.0) == 0
    # gamma = 0.2, no iteration: a start at -R_max / (1 - gamma) with Q* = R_max / (1 - gamma) is 2.5 away
    assert algorithmic_error(0, 1.0, gamma=0.2) == pytest.approx(1.25)


@pytest.mark.parametrize(("gamma", "shown"), [(1.0, "1.0"), (-0.1, "-0.1")])
def test_bad_gamma(gamma, shown):
    for call in (
        lambda: statistical_error(1.0, 1.0, gamma),
        lambda: algorithmic_error(1, 1.0, gamma),
        lambda: coverage_constant(1.0, gamma),
    ):
        with pytest.raises(ValueError, match=rf"gamma: got {shown}, must be in \[0, 1\)"):
            call()


def test_bad_iterations_and_ratio():
    with pytest.raises(ValueError, match="num_iterations: got -1, must be at least 0"):
        algorithmic_error(-1, 1.0, 0.9)
    with pytest.raises(ValueError, match="ratio: got nan, must be at least 0"):
        coverage_constant(math.nan, 0.9)
