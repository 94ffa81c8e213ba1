"""What TorchRL's own tests ask of every loss, asked of ours."""

import copy
import dataclasses
import io

import pytest
import torch
from small_losses import NETWORKS, nested, transitions
from tensordict import TensorDict
from torch import nn
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate, ValueEstimators

from redig.objectives import DIPOLoss


def networks(loss):
    return [name for name in NETWORKS if f"{name}_network_params" in loss._modules]


def clear(loss):
    for parameter in loss.parameters():
        parameter.grad = None


def test_keys(build):
    loss = build()
    with pytest.raises(ValueError, match="unknown_key is not an accepted tensordict key"):
        loss.set_keys(unknown_key="x")
    fields = {field.name: field.default for field in dataclasses.fields(loss.tensor_keys)}
    assert {"action", "reward", "done", "terminated", "priority", "priority_weight"} < set(fields)
    for name, default in fields.items():
        assert getattr(loss.tensor_keys, name) == getattr(loss.default_keys(), name) == default
        loss.set_keys(**{name: ("a", "b")})
        assert getattr(loss.tensor_keys, name) == ("a", "b")
        loss.set_keys(**{name: None})
        assert getattr(loss.tensor_keys, name) == default


@pytest.mark.parametrize("kind", [ValueEstimators.TD0, ValueEstimators.TD1, ValueEstimators.TDLambda])
def test_the_value_estimator_follows_the_keys(build, kind):
    names = ("reward", "done", "terminated")
    for first in (True, False):
        loss = build()
        if first:
            loss.make_value_estimator(kind)
        loss.set_keys(**{name: nested(name) for name in names})
        if not first:
            loss.make_value_estimator(kind)
        for name in names:
            assert getattr(loss.value_estimator.tensor_keys, name) == nested(name)
            assert ("next", *nested(name)) in loss.in_keys


@pytest.mark.parametrize("kind", [ValueEstimators.GAE, ValueEstimators.VTrace])
def test_other_value_estimators_are_refused(build, kind):
    with pytest.raises(NotImplementedError, match=rf"{kind.name}.*Supported value types: \['TD0', 'TD1', 'TDLambda'\]"):
        build().make_value_estimator(kind)


def test_nested_keys(build):
    flat, data = transitions(6), TensorDict({}, [6])
    for name in ("observation", "action"):
        data[nested(name)] = flat[name]
    for name in ("observation", "reward", "done", "terminated"):
        data["next", *nested(name)] = flat["next", name]
    flags = {"demonstration": torch.rand(6) < 0.5, "actor_mask": torch.rand(6, 3, 1) < 0.5}
    extra = {**flags, "steps_to_next_obs": torch.full((6, 1), 2), "priority_weight": torch.rand(6)}
    for name, value in extra.items():
        flat[name], data[nested(name)] = value, value
    plain, loss = build(actor_seed=4), build(actor_seed=4, key=nested)
    for each in (plain, loss):
        each.make_value_estimator(gamma=0.9)
    loss.set_keys(**{field.name: nested(field.name) for field in dataclasses.fields(loss.tensor_keys)})
    if isinstance(loss, DIPOLoss):
        loss.set_keys(base_action=None)
    torch.manual_seed(0)
    expected = plain(flat)
    torch.manual_seed(0)
    assert (loss(data) == expected).all()
    assert torch.equal(data[nested("priority")], flat["td_error"])
    following = [("next", *nested(name)) for name in ("observation", "reward", "done", "terminated")]
    assert loss.in_keys == [nested("action"), nested("observation"), *following]


def test_forward_leaves_what_it_was_given_as_it_was(build):
    data = transitions(6)
    before = data.clone()
    loss = build()
    out = loss(data)
    written = {"td_error"} | ({"refined_action"} if isinstance(loss, DIPOLoss) else set())
    assert set(data.keys()) - set(before.keys()) == written
    assert (data.exclude(*written) == before).all()
    assert all(not value.requires_grad for name, value in out.items() if not name.startswith("loss_"))


@pytest.mark.parametrize("selected", [None, ["loss_actor"], ["loss_qvalue", "pred_value"]])
def test_dispatch_takes_tensors(build, selected):
    data = transitions(6)
    expected = build(actor_seed=5)(data.clone())
    loss = build(actor_seed=5)
    if selected:
        loss.select_out_keys(*selected)
    arguments = {"_".join(key) if isinstance(key, tuple) else key: data[key] for key in loss.in_keys}
    out = loss(**arguments)
    names = selected or list(expected.keys())
    assert sorted(loss.out_keys) == sorted(names)
    for name, value in zip(loss.out_keys, (out,) if len(names) == 1 else out, strict=True):
        assert torch.equal(value, expected[name])


@pytest.mark.parametrize("separate", [False, True])
def test_each_loss_teaches_its_own_networks(build, separate):
    loss = build(separate=separate)
    out = loss(transitions(16))
    critics = {"critic_encoder" if separate else "encoder", "qvalue"}
    for name, reached in {"loss_qvalue": critics, "loss_actor": {"encoder", "actor"}}.items():
        clear(loss)
        out[name].backward(retain_graph=True)
        for network in networks(loss):
            params = getattr(loss, f"{network}_network_params")
            assert all((p.grad is not None and p.grad.any()) == (network in reached) for p in params.parameters()), (
                network
            )
            assert all(p.grad is None for p in getattr(loss, f"target_{network}_network_params").values(True, True))


def test_parameters_leave_out_targets_and_buffers(build):
    loss = build()
    names = [name for name, _ in loss.named_parameters()]
    assert {name.split("_network_params")[0] for name in names} == {"encoder", "actor", "qvalue"}
    assert all(isinstance(parameter, nn.Parameter) and parameter.requires_grad for parameter in loss.parameters())
    assert not any(name.endswith(("low", "high", "betas", "alphas_cumprod")) for name in names)
    assert loss.functional
    assert isinstance(loss, LossModule)


def test_the_networks_that_were_passed_in_are_trained(build):
    loss = build()
    data, network = transitions(4), loss.get_stateful_net("actor_network", copy=False)
    own, held = list(network.parameters()), list(loss.actor_network_params.parameters())
    assert len(own) == len(held)
    assert all(any(mine is other for other in held) for mine in own)
    optimizer = torch.optim.SGD(loss.parameters(), 0.1)
    before = [parameter.detach().clone() for parameter in own]
    loss(data)["loss_actor"].backward()
    optimizer.step()
    assert not any(torch.equal(now, old) for now, old in zip(own, before, strict=True))


def test_stateful_networks_go_out_and_in(build):
    loss, other = build(seed=0), build(seed=9)
    network = other.get_stateful_net("actor_network")
    loss.from_stateful_net("actor_network", network)
    for key, value in loss.actor_network_params.items(True, True):
        assert torch.equal(value, other.actor_network_params[key])


def test_reset_parameters_recursive(build):
    loss = build()
    before = {}
    with torch.no_grad():
        for name, parameter in loss.named_parameters():
            before[name] = parameter.add_(1000).clone()
    schedule = loss.actor_network_params["module", "schedule", "betas"].clone()
    loss.reset_parameters_recursive()
    for name, parameter in loss.named_parameters():
        assert parameter.abs().max() < 100 and not torch.equal(parameter, before[name]), name
    assert torch.equal(loss.actor_network_params["module", "schedule", "betas"], schedule)


@pytest.mark.parametrize("separate", [False, True])
def test_state_dict_round_trip(build, separate):
    first, second = build(seed=0, actor_seed=1, separate=separate), build(seed=9, actor_seed=1, separate=separate)
    for loss in (first, second):
        loss.make_value_estimator(gamma=0.9)
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second.load_state_dict(torch.load(file, weights_only=True))
    data = transitions(6)
    torch.manual_seed(0)
    expected = first(data.clone())
    torch.manual_seed(0)
    assert (second(data.clone()) == expected).all()


def test_deepcopy_is_independent(build):
    loss = build()
    twin = copy.deepcopy(loss)
    for network in networks(loss):
        getattr(loss, f"{network}_network_params").data.zero_()
    assert all(parameter.any() for name, parameter in twin.named_parameters() if name.endswith("weight"))
    assert torch.isfinite(twin(transitions(6))["loss_actor"])


@pytest.mark.parametrize(
    ("updater", "options", "tau"),
    [
        (SoftUpdate, {"tau": 0.3}, 0.3),
        (SoftUpdate, {"eps": 0.7}, 0.3),
        (HardUpdate, {"value_network_update_interval": 0}, 1),
    ],
)
def test_target_updates_move_all_networks(build, updater, options, tau):
    loss = build(separate=True)
    update = updater(loss, **options)
    pairs = [[getattr(loss, f"{which}{name}_network_params") for which in ("", "target_")] for name in NETWORKS]
    for online, _ in pairs:
        for parameter in online.parameters():
            parameter.data.normal_()
    before = [(online.data.clone(), target.data.clone()) for online, target in pairs]
    update.step()
    for (online, target), (online_before, target_before) in zip(pairs, before, strict=True):
        for key, value in target.items(True, True):
            if isinstance(online[key], nn.Parameter):
                expected = (1 - tau) * target_before[key] + tau * online_before[key]
                torch.testing.assert_close(value.data, expected)
                assert not torch.equal(value.data, target_before[key])
            assert torch.equal(online[key].data, online_before[key])


def test_reductions_and_masks_keep_their_meaning(build):
    results, mask = {}, torch.rand(6, 3, 1, generator=torch.Generator().manual_seed(0)) < 0.5
    for reduction in ("none", "mean", "sum"):
        loss = build(actor_seed=2, reduction=reduction)
        for which in ("all", "some"):
            loss.actor_network.module.generator.manual_seed(2)
            torch.manual_seed(0)
            data = transitions(6)
            if which == "some":
                data["actor_mask"] = mask
            results[which, reduction] = loss(data)
    for name in ("loss_qvalue", "loss_actor"):
        none = results["all", "none"][name]
        assert none.shape == (6, 3, 1)
        torch.testing.assert_close(results["all", "mean"][name], none.mean())
        torch.testing.assert_close(results["all", "sum"][name], none.sum())
    none = results["some", "none"]["loss_actor"]
    assert torch.equal(none != 0, mask)
    torch.testing.assert_close(results["some", "mean"]["loss_actor"], none.sum() / mask.sum())
    assert (results["some", "none"]["loss_qvalue"] == results["all", "none"]["loss_qvalue"]).all()


@pytest.mark.parametrize("weighted", [False, True])
def test_nothing_that_counts_gives_zero(build, weighted):
    loss, data = build(), transitions(6)
    data["actor_mask"] = torch.zeros(6, 3, 1, dtype=torch.bool)
    if weighted:
        data["priority_weight"] = torch.ones(6)
    out = loss(data)
    assert out["loss_actor"] == 0
    out["loss_actor"].backward()
    assert all(torch.isfinite(p.grad).all() for p in loss.parameters() if p.grad is not None)


def test_priority_weights_can_be_switched_off(build):
    results = []
    for switch in ("auto", False):
        loss, data = build(actor_seed=1), transitions(6)
        loss.use_prioritized_weights = switch
        data["priority_weight"] = torch.arange(6.0)
        torch.manual_seed(0)
        results.append(loss(data)["loss_qvalue"])
    assert not torch.equal(*results)
