import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.modules import BestOfN, DenoisingMLP, DiffusionActor, NoiseSchedule, QNetwork
from redig.objectives import DIPOLoss

ACTION = ("agents", "action")


def make_actor():
    torch.manual_seed(0)
    keys = {"in_keys": [("agents", "state")], "out_keys": [ACTION]}
    return DiffusionActor(DenoisingMLP(2, 4, (16,)), Bounded(-1, 1, (3, 2)), schedule=NoiseSchedule(5), **keys)


def team(*batch):
    return TensorDict({"agents": {"state": torch.randn(*batch, 3, 4)}}, batch)


def test_takes_the_best_candidate_of_each_robot():
    seen = []

    def value(data):
        seen.append(data[ACTION].clone())
        return data[ACTION][..., :1] - data[ACTION][..., 1:].square()

    data = team(6)
    action = BestOfN(make_actor(), value, 8)(data)[ACTION]
    candidates = seen[0]  # [8, 6, 3, 2]
    for b in range(6):
        for i in range(3):
            scores = [(c[0] - c[1] ** 2).item() for c in candidates[:, b, i]]
            assert torch.equal(action[b, i], candidates[scores.index(max(scores)), b, i])


@pytest.mark.parametrize("kind", [*ExplorationType, None])
def test_candidates_differ_whatever_the_exploration_type(kind):
    seen = []
    best = BestOfN(make_actor(), lambda data: seen.append(data[ACTION]) or data[ACTION][..., :1], 4)
    with set_exploration_type(kind):
        best(team(2))
    assert seen[0].std(0).min() > 0


def test_more_candidates_are_worth_more():
    def mean_value(n):
        torch.manual_seed(1)
        return BestOfN(make_actor(), lambda data: data[ACTION][..., :1], n)(team(500))[ACTION][..., 0].mean()

    values = [mean_value(n).item() for n in (1, 4, 32)]
    assert values == sorted(values)
    assert values[2] > values[0] + 0.2


def test_with_the_critics_of_a_loss():
    actor = make_actor()
    critic = TensorDictModule(QNetwork(4, 2, (8,)), [("agents", "state"), ACTION], [("agents", "state_action_value")])
    loss = DIPOLoss(None, actor, critic)
    loss.set_keys(action=ACTION, state_action_value=("agents", "state_action_value"))
    data = team(5)
    best = BestOfN(actor, loss.value, 16)
    torch.manual_seed(2)
    chosen = best(data.clone())
    torch.manual_seed(2)
    first = BestOfN(actor, loss.value, 1)(data.clone())
    assert chosen[ACTION].shape == (5, 3, 2)
    assert (loss.value(chosen).mean() > loss.value(first).mean()).item()
    assert not chosen[ACTION].requires_grad
    assert sum(p.numel() for p in best.parameters()) == sum(p.numel() for p in actor.parameters())  # no critics


def test_only_the_action_is_written():
    data = team(2)
    before = set(data.keys(True, True))
    assert set(BestOfN(make_actor(), lambda d: d[ACTION][..., :1], 2)(data).keys(True, True)) == before | {ACTION}


def test_bad_number_of_candidates():
    with pytest.raises(ValueError, match="num_candidates: got 0, must be at least 1"):
        BestOfN(make_actor(), lambda data: data[ACTION], 0)
