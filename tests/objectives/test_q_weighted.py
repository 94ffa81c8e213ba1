"""What QWeightedLoss adds to the critics: weights of the actor's own samples, against loops and closed forms."""

import math

import pytest
import torch
from small_losses import (
    ConstantActor,
    LinearQ,
    QuadraticQ,
    act,
    bandit,
    constant,
    known,
    make,
    single,
    transitions,
    valued_by,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.objectives import SoftUpdate

from redig.objectives import QWeightedLoss

WEIGHTINGS = ("advantage", "exponential")


class UniformActor(ConstantActor):
    """Draws uniformly from the bounds and keeps what it drew and what it was to learn; the error is that to a point."""

    def forward(self, embedding):
        self.drawn = 2 * torch.rand(*embedding.shape[:-1], len(self.action)) - 1
        self.learned = []
        return self.drawn

    def action_loss(self, action, embedding):
        self.learned.append(action)
        return super().action_loss(action, embedding)


def uniform_actor(action=(0.0, 0.0)):
    return TensorDictModule(UniformActor(list(action)), in_keys=["embedding"], out_keys=["action"])


def around_uniform(**options):
    """:func:`constant` with an actor that draws from the bounds."""
    loss = constant(QWeightedLoss, **options)
    actor = uniform_actor()
    loss = QWeightedLoss(loss.encoder_network, actor, loss.qvalue_network, **options)
    for name in ("encoder", "qvalue"):
        for leaf in getattr(loss, f"{name}_network_params").values(True, True):
            leaf.data.normal_()
    return loss


def by_loops(loss, data, actor, mask, demonstration, priority):
    """The loss of the actor, one robot and one candidate after the other."""
    encoder, point, critics = known(loss)
    states = [(b, i) for b in range(data.shape[0]) for i in range(3)]
    advantage = {}
    for b, i in states:
        h = encoder @ data["observation"][b, i]
        values = [min(float(w @ torch.cat([h, action])) for w in critics) for action in actor.drawn[:, b, i]]
        advantage[b, i] = [value - sum(values) / len(values) for value in values]
    own = [s for s in states if mask[s] and not demonstration[s]]
    mean_best = sum(max(advantage[s]) for s in own) / len(own)
    spread = math.sqrt(sum(sum(a**2 for a in advantage[s]) / loss.num_candidates for s in own) / len(own))
    total = weights = 0.0

    def error(action):
        return float((action - point).square().mean())

    for b, i in states:
        advantages, candidates = advantage[b, i], actor.drawn[:, b, i]
        if demonstration[b, i]:
            value = error(data["action"][b, i])
        elif loss.weighting == "advantage":
            weight = max(advantages) / mean_best
            best, elsewhere = candidates[advantages.index(max(advantages))], actor.learned[1][b, i]
            value = weight * (error(best) + loss.entropy_weight * error(elsewhere))
        else:
            odds = [math.exp(a / (loss.temperature * spread)) for a in advantages]
            value = sum(odd / sum(odds) * error(action) for odd, action in zip(odds, candidates, strict=True))
        total += priority[b] * value * mask[b, i]
        weights += priority[b] * mask[b, i]
    return float(total / weights)


@pytest.mark.parametrize(
    "options",
    [
        {"weighting": "advantage", "entropy_weight": 0.3},
        {"weighting": "exponential", "temperature": 0.5},
    ],
)
@pytest.mark.parametrize(
    "flags", [set(), {"actor_mask"}, {"demonstration"}, {"actor_mask", "demonstration", "priority"}]
)
def test_the_loss_by_loops(options, flags):
    torch.manual_seed(0)
    loss, data = around_uniform(num_candidates=5, **options), transitions(6)
    mask, demonstration = torch.ones(6, 3, dtype=torch.bool), torch.zeros(6, 3, dtype=torch.bool)
    priority = torch.ones(6)
    if "actor_mask" in flags:
        mask = torch.rand(6, 3) < 0.6
        data["actor_mask"] = mask.unsqueeze(-1)
    if "demonstration" in flags:
        demonstration = (torch.rand(6, 1) < 0.5).expand(6, 3)
        data["demonstration"] = demonstration[:, :1]
    if "priority" in flags:
        priority = torch.rand(6)
        data["priority_weight"] = priority
    found, metadata = loss.actor_loss(data)
    actor = loss.actor_network.module
    expected = by_loops(loss, data, actor, mask, demonstration, priority)
    assert found.item() == pytest.approx(expected, rel=1e-4)
    assert metadata["candidate_gap"] > 0
    if options["weighting"] == "advantage":
        elsewhere = actor.learned[1]
        assert elsewhere.abs().max() <= 1 and elsewhere.std() == pytest.approx(3**-0.5, abs=0.15)


def test_exponential_weights_are_a_step_of_mirror_descent():
    """With many candidates the actor learns pi_old exp(Q / temperature) / Z; pi_old is uniform, Q = -|a - best|^2."""
    torch.manual_seed(0)
    best, point, temperature = 0.3, -0.4, 0.7
    actor = TensorDictModule(UniformActor([point]), in_keys=["observation"], out_keys=["action"])
    options = {"weighting": "exponential", "temperature": temperature, "num_candidates": 200_000}
    loss = valued_by(QuadraticQ([best]), QWeightedLoss, actor, **options)
    data = TensorDict({"observation": torch.zeros(1, 1), "action": torch.zeros(1, 1)}, [1])
    grid = torch.linspace(-1, 1, 20_001, dtype=torch.float64)
    value = -((grid - best) ** 2)
    density = (value / (temperature * value.std())).softmax(0)
    found = loss.actor_loss(data)[0]
    assert found.item() == pytest.approx(float((density * (grid - point) ** 2).sum()), rel=0.01)
    found.backward()  # the slope of a squared error tells the mean of what is learned
    slope = loss.actor_network_params["module", "action"].grad.item()
    assert point - slope / 2 == pytest.approx(float((density * grid).sum()), abs=0.01)


def train(loss, parameters, make_batch, steps=300, critic_first=0, critic=True):
    """Adam with a rate that falls to 0, on the losses of both, or of the actor only (``critic=False``)."""
    optimizer = torch.optim.Adam(parameters, 5e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    target = SoftUpdate(loss, tau=0.05)
    for step in range(steps):
        batch, total = make_batch(), torch.zeros(())
        if critic:
            total = total + loss.qvalue_loss(batch)[0]
        if step >= critic_first:
            total = total + loss.actor_loss(batch)[0]
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        schedule.step()
        target.step()


def test_a_diffusion_policy_takes_a_step_of_mirror_descent(monkeypatch):
    """A Gaussian of mean m and deviation s, weighted by exp(a / (s temperature)), has mean m + s / temperature."""
    temperature = 1.0
    loss = valued_by(
        LinearQ(2), QWeightedLoss, single().actor_network, weighting="exponential", temperature=temperature
    )
    loss.qvalue_network_params["module", "weight"].data.copy_(torch.tensor([0.0, 1.0]).expand(2, 2))  # Q = a
    parameters = list(loss.actor_network_params.parameters())

    def demonstrations():
        data = bandit(0.25 * torch.randn(256, 1) - 0.2)
        data["demonstration"] = torch.ones(256, 1, dtype=torch.bool)
        return data

    train(loss, parameters, demonstrations, critic=False)
    before = act(loss, 4096)
    old, sample = loss.actor_network_params.data.clone(), loss._sample_action
    monkeypatch.setattr(loss, "_sample_action", lambda embedding, params: sample(embedding, old))
    train(loss, parameters, lambda: bandit(torch.zeros(32, 1)), critic=False)
    shift = (before.std() / temperature).item()
    assert shift > 0.1  # of the best candidates it would be more than twice that
    assert act(loss, 4096).mean().item() == pytest.approx(before.mean().item() + shift, abs=0.04)


@pytest.mark.parametrize("options", [{"weighting": "advantage"}, {"weighting": "exponential", "temperature": 0.3}])
def test_solves_a_bandit(options):
    """From actions drawn at random; the critic learns first, because early on any action may look the best."""
    loss = single(QWeightedLoss, num_candidates=8, **options)
    train(loss, loss.parameters(), lambda: bandit(2 * torch.rand(64, 1) - 1), steps=500, critic_first=300)
    action = act(loss)
    assert action.mean().item() == pytest.approx(0.6, abs=0.2)
    assert (action - 0.6).abs().mean() < 0.25


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_weights_do_not_depend_on_the_units_of_the_reward(weighting):
    results = []
    for scale in (1.0, 100.0):
        loss = around_uniform(weighting=weighting)
        loss.qvalue_network_params.data.apply_(lambda weight, scale=scale: weight * scale)
        torch.manual_seed(1)
        results.append(loss.actor_loss(transitions(6))[0])
    torch.testing.assert_close(*results, rtol=1e-4, atol=0)


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize("flag", ["actor_mask", "demonstration"])
def test_others_do_not_change_the_weights_of_a_robot(weighting, flag):
    """Those that are masked or demonstrations, whatever their values: here they see 1,000 times as much."""
    left_out = torch.rand(6, 3, 1, generator=torch.Generator().manual_seed(0)) < 0.5
    results = []
    for scale in (1.0, 1000.0):
        loss, data = around_uniform(weighting=weighting, reduction="none"), transitions(6)
        data["observation"] = data["observation"].where(~left_out, scale * data["observation"])
        data[flag] = ~left_out if flag == "actor_mask" else left_out
        torch.manual_seed(1)
        results.append(loss.actor_loss(data)[0][~left_out])
    torch.testing.assert_close(*results)


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_demonstrations_are_cloned(weighting):
    data = transitions(6)
    data["demonstration"] = torch.ones(6)
    cloned = constant()(data)["loss_actor"]
    loss = constant(QWeightedLoss, weighting=weighting)
    torch.testing.assert_close(loss(data)["loss_actor"], cloned)


@pytest.mark.parametrize(("weighting", "expected"), [("advantage", 0.0), ("exponential", 1.0)])
def test_values_that_are_all_the_same_give_no_preference(weighting, expected):
    loss, data = around_uniform(weighting=weighting), transitions(6)
    loss.qvalue_network_params.data.zero_()
    found = loss.actor_loss(data)[0]
    mean = loss.actor_network.module.learned[0].sub(known(loss)[1]).square().mean()
    torch.testing.assert_close(found, expected * mean)


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_candidates_come_from_the_actor_and_are_valued_by_the_critics_own_encoder(weighting):
    def gap(*changed):
        loss = make(QWeightedLoss, separate=True, actor_seed=3, weighting=weighting)
        for name in changed:
            getattr(loss, f"{name}_network_params").data.zero_()
        return loss.actor_loss(transitions(6))[1]["candidate_gap"].item()

    for name in ("actor", "critic_encoder", "qvalue"):
        assert gap(name) != gap()
    assert gap("target_actor", "target_encoder", "target_critic_encoder", "target_qvalue") == gap()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weighting": "softmax"}, "weighting: got 'softmax', allowed are advantage, exponential"),
        ({"num_candidates": 1}, "num_candidates: got 1, must be at least 2"),
        ({"temperature": 0.0}, "temperature: got 0.0, must be greater than 0"),
        ({"temperature": float("nan")}, "temperature: got nan"),
        ({"entropy_weight": -0.1}, "entropy_weight: got -0.1, must be at least 0"),
        ({"reduction": "average"}, "reduction: got 'average'"),
    ],
)
def test_bad_arguments(options, message):
    with pytest.raises(ValueError, match=message):
        make(QWeightedLoss, **options)
