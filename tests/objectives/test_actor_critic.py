"""The critics' half of every loss: TD targets, gradients, targets, weights and the errors for a bad batch."""

import pytest
import torch
from small_losses import NETWORKS, constant, gradient, known, make, single, transitions
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import ValueEstimators
from torchrl.objectives.value import TD0Estimator, TDLambdaEstimator

from redig.modules import GraphEncoder, QNetwork
from redig.objectives import DIPOLoss


def test_td_target_by_hand():
    loss, data = constant(), transitions(6)
    out = loss(data)
    encoder, _, critics = known(loss)
    target_encoder, target_action, target_critics = known(loss, "target_")
    total, errors, targets, next_values = 0.0, torch.zeros(6, 3, 1), [], []
    for b in range(6):
        for i in range(3):
            following = torch.cat([target_encoder @ data["next", "observation"][b, i], target_action])
            next_value = min(float(w @ following) for w in target_critics)
            alive = 0.0 if data["next", "terminated"][b, i, 0] else 1.0
            target = float(data["next", "reward"][b, i, 0]) + 0.9 * alive * next_value
            here = torch.cat([encoder @ data["observation"][b, i], data["action"][b, i]])
            distances = [abs(float(w @ here) - target) for w in critics]
            total += sum(d**2 for d in distances)
            errors[b, i] = sum(distances) / 2
            targets.append(target)
            next_values.append(next_value)
    assert out["loss_qvalue"].item() == pytest.approx(total / 18, rel=1e-4)
    assert out["target_value"].item() == pytest.approx(sum(targets) / 18, abs=1e-5)
    assert out["next_state_value"].item() == pytest.approx(sum(next_values) / 18, abs=1e-5)
    torch.testing.assert_close(data["td_error"], errors)


def test_smooth_l1():
    found = constant(loss_function="smooth_l1").qvalue_loss(transitions(6))[0]
    loss, data = constant(reduction="none", num_qvalue_nets=2), transitions(6)
    encoder, _, critics = known(loss)
    value = torch.cat([data["observation"] @ encoder.T, data["action"]], -1) @ critics.T
    error = (value - loss._target_value(data)[0]).abs()
    expected = torch.where(error < 1, error**2 / 2, error - 0.5).sum(-1).mean()
    torch.testing.assert_close(found, expected)


def test_timeout_bootstraps_and_termination_does_not():
    data = transitions(6)
    data["next", "terminated"] = torch.zeros(6, 3, 1, dtype=torch.bool)
    results = {}
    for done in (True, False):
        data["next", "done"] = torch.full((6, 3, 1), done)
        results[done] = constant()(data)["loss_qvalue"]
    assert torch.equal(results[True], results[False])
    data["next", "terminated"] = torch.ones(6, 3, 1, dtype=torch.bool)
    torch.testing.assert_close(constant()(data)["target_value"], data["next", "reward"].mean())


def test_numbers_of_the_team_count_for_each_robot():
    team, each = transitions(6), transitions(6)
    flag, reward, steps = torch.rand(6, 1) < 0.5, torch.randn(6, 1), torch.randint(1, 5, (6, 1))
    for name, value in {"done": flag, "terminated": flag, "reward": reward}.items():
        team["next", name] = value
        each["next", name] = value[:, None].expand(6, 3, 1)
    team["steps_to_next_obs"], each["steps_to_next_obs"] = steps, steps[:, None].expand(6, 3, 1)
    first, second = constant()(team), constant()(each)
    assert (first == second).all()
    assert torch.equal(team["td_error"], each["td_error"])


def test_n_step_windows_discount_the_bootstrap():
    data = transitions(6)
    steps = data["steps_to_next_obs"] = torch.randint(1, 6, (6, 3, 1))
    loss = constant(reduction="none")
    target, next_value = loss._target_value(data)
    alive = (~data["next", "terminated"]).float()
    torch.testing.assert_close(target, data["next", "reward"] + 0.9**steps * alive * next_value)


@pytest.mark.parametrize(("kind", "decay"), [(ValueEstimators.TD1, 1.0), (ValueEstimators.TDLambda, 0.6)])
def test_td_lambda_on_trajectories(kind, decay):
    data = transitions(4, 7)
    data["next", "done"] = data["next", "terminated"] | (torch.rand(4, 7, 1, 1) < 0.2)
    lmbda = {"lmbda": decay} if kind is ValueEstimators.TDLambda else {}
    loss = constant().make_value_estimator(kind, gamma=0.9, **lmbda)
    target, next_value = loss._target_value(data)
    expected = torch.zeros(4, 7, 3, 1)
    for b in range(4):
        for i in range(3):
            for t in reversed(range(7)):
                ahead = next_value[b, t, i]
                if t < 6 and not data["next", "done"][b, t, i]:
                    ahead = (1 - decay) * ahead + decay * expected[b, t + 1, i]
                alive = ~data["next", "terminated"][b, t, i]
                expected[b, t, i] = data["next", "reward"][b, t, i] + 0.9 * alive * ahead
    torch.testing.assert_close(target, expected)


def test_target_actor_is_sampled_not_its_mode():
    loss, data = make(), transitions(64)
    first, second = (loss._target_value(data)[1] for _ in range(2))
    assert not torch.equal(first, second)


@pytest.mark.parametrize(
    ("options", "reached"),
    [
        ({}, {"encoder", "qvalue"}),
        ({"detach_encoder": True}, {"qvalue"}),
        ({"separate": True}, {"critic_encoder", "qvalue"}),
    ],
)
def test_gradient_of_the_critic_loss(options, reached):
    loss = make(**options)
    loss(transitions(16))["loss_qvalue"].backward()
    for name in NETWORKS if "separate" in options else ("encoder", "actor", "qvalue"):
        assert bool(gradient(loss, name)) == (name in reached), name


@pytest.mark.parametrize("separate", [False, True])
def test_targets_take_no_gradient_and_have_their_own_memory(separate):
    loss = make(separate=separate)
    out = loss(transitions(16))
    (out["loss_qvalue"] + out["loss_actor"]).backward()
    for name in NETWORKS if separate else ("encoder", "actor", "qvalue"):
        online, target = (getattr(loss, f"{which}{name}_network_params") for which in ("", "target_"))
        for key, value in target.items(True, True):
            assert not value.requires_grad
            assert value.grad is None
            assert value.data_ptr() != online[key].data_ptr()
    names = {name for name, parameter in loss.named_parameters() if parameter.requires_grad}
    assert names
    assert not any("target" in name for name in names)


def test_twin_critics_start_apart():
    weight = make().qvalue_network_params["module", "net", "0", "weight"]
    assert weight.shape[0] == 2
    assert not torch.equal(weight[0], weight[1])
    assert make(num_qvalue_nets=3).qvalue_network_params["module", "net", "0", "weight"].shape[0] == 3


@pytest.mark.parametrize("shape", [(6,), (6, 1)])
def test_priority_weights_count_for_all_robots_of_a_team(shape):
    none = make(actor_seed=2, reduction="none")(transitions(6))
    weight, data = torch.rand(6), transitions(6)
    data["priority_weight"] = weight.view(shape)
    out = make(actor_seed=2)(data)
    for name in ("loss_qvalue", "loss_actor"):
        torch.testing.assert_close(out[name], (none[name].mean((1, 2)) * weight).sum() / weight.sum())


def test_keys_set_after_the_value_estimator_was_made():
    data = transitions(6)
    before = constant()(data.clone())
    data["next", "r"] = data["next", "reward"]
    data["next", "reward"] = torch.full((6, 3, 1), torch.nan)
    loss = constant()
    loss.set_keys(reward="r")
    assert (loss(data) == before).all()


def test_without_encoder_and_agent_dimension():
    generator = torch.Generator().manual_seed(0)
    observation, action, following, reward = torch.rand(4, 8, 1, generator=generator)
    flag = torch.tensor([True, False]).repeat(4).unsqueeze(-1)
    data = TensorDict({"observation": observation, "action": action}, [8])
    data["next"] = TensorDict({"observation": following, "reward": reward, "done": flag, "terminated": flag}, [8])
    loss = single(reduction="none")
    out = loss(data)
    assert out["loss_qvalue"].shape == out["loss_actor"].shape == data["td_error"].shape == (8, 1)
    assert data["refined_action"].shape == (8, 1)
    target, next_value = loss._target_value(data)
    assert torch.equal(target[flag], reward[flag])
    torch.testing.assert_close(target[~flag], (reward + 0.9 * next_value)[~flag])
    assert loss.in_keys[:3] == ["action", "observation", ("next", "observation")]


def test_gamma():
    data = transitions(6)
    loss = constant().make_value_estimator(gamma=0.0)
    torch.testing.assert_close(loss(data)["target_value"], data["next", "reward"].mean())


@pytest.mark.parametrize(
    "given", [ValueEstimators.TD0, "td0", TD0Estimator, TD0Estimator(gamma=0.9, value_network=None)]
)
def test_ways_to_name_the_value_estimator(given):
    expected, loss = constant()(transitions(6)), constant()
    options = {"gamma": 0.9} if given in (ValueEstimators.TD0, "td0") else {}
    if given is TD0Estimator:
        options = {"gamma": 0.9, "value_network": None}
    assert loss.make_value_estimator(given, **options) is loss
    assert isinstance(loss.value_estimator, TD0Estimator)
    assert (loss(transitions(6)) == expected).all()


def test_time_may_be_any_dimension_that_is_named():
    data, lmbda = transitions(4, 7), {"gamma": 0.9, "lmbda": 0.6}
    expected = constant().make_value_estimator(TDLambdaEstimator, value_network=None, **lmbda)(data)["target_value"]
    data = data.transpose(0, 1).contiguous()
    data.names = ["time", None]
    found = constant().make_value_estimator(ValueEstimators.TDLambda, **lmbda)(data)["target_value"]
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_padded_steps_do_not_count(reduction):
    data = transitions(4, 7)
    valid = torch.rand(4, 7, generator=torch.Generator().manual_seed(1)) < 0.6
    data["collector", "mask"] = valid.unsqueeze(-1)
    each = constant(reduction="none")(transitions(4, 7))
    padded = constant(reduction=reduction)(data)
    for name in ("loss_qvalue", "loss_actor"):
        kept = each[name] * valid[..., None, None]
        expected = {"mean": kept.sum() / (3 * valid.sum()), "sum": kept.sum(), "none": kept}[reduction]
        torch.testing.assert_close(padded[name], expected)


def test_value_is_the_least_of_the_critics():
    loss, data = constant(), transitions(6)
    encoder, _, critics = known(loss)
    expected = torch.cat([data["observation"] @ encoder.T, data["action"]], -1) @ critics.T
    torch.testing.assert_close(loss.value(data), expected.amin(-1, keepdim=True))


# --- what users get wrong


def broken(change):
    data = transitions(6)
    change(data)
    return data


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("action"), r"no key action \(set_keys renames keys\); it has next.done, .*, observation"),
        (lambda d: d["next"].pop("reward"), "no key next.reward "),
        (lambda d: d["next"].pop("observation"), "no key next.observation "),
        (lambda d: d.pop("next"), "no key next.observation, next.reward, next.done, next.terminated "),
    ],
)
def test_missing_keys_are_named(change, message):
    with pytest.raises(KeyError, match=message):
        make().qvalue_loss(broken(change))


def set_to(key, *shape):
    return lambda data: data.set(key, torch.zeros(*shape))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            set_to(("next", "reward"), 6, 3),
            r"'reward'\): got shape \[6, 3\], expected \[6, 3, 1\], .* \[6, 1\]",
        ),
        (set_to(("next", "done"), 6, 2, 1), r"\('next', 'done'\): got shape \[6, 2, 1\], expected \[6, 3, 1\]"),
        (set_to("steps_to_next_obs", 6, 3), r"steps_to_next_obs: got shape \[6, 3\], expected \[6, 3, 1\]"),
        (set_to("priority_weight", 6, 3), r"priority_weight: got shape \[6, 3\], expected \[6, 3, 1\]"),
        (set_to("action", 6, 4, 2), r"action: got shape \[6, 4, 2\], expected \[6, 3, 2\]: .* embedding \[6, 3, 8\]"),
        (set_to("action", 6, 3, 3), r"action: got shape \[6, 3, 3\], expected \[6, 3, 2\]: actions of width 2"),
        (set_to("action", 6, 2), r"action: got shape \[6, 2\], expected \[6, 3, 2\]"),
    ],
)
def test_wrong_shapes_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        make().qvalue_loss(broken(change))


@pytest.mark.parametrize("name", ["action", "state_action_value"])
def test_keys_that_the_critic_does_not_know_are_named(name):
    loss, data = make(), transitions(6)
    data["other"] = data["action"]
    loss.set_keys(**{name: "other"})
    with pytest.raises(KeyError, match=rf"{name}: got other, the critic has .*{name}; set_keys\({name}=...\)"):
        loss(data)


def test_an_actor_without_diffusion_is_refused():
    actor = TensorDictModule(nn.Linear(4, 2), in_keys=["observation"], out_keys=["action"])
    value = TensorDictModule(QNetwork(4, 2), in_keys=["observation", "action"], out_keys=["state_action_value"])
    with pytest.raises(TypeError, match="actor: got TensorDictModule whose module has no action_loss, low, high"):
        DIPOLoss(None, actor, value)


def test_critic_encoder_without_encoder_is_refused_not_ignored():
    first, own = make(), TensorDictModule(GraphEncoder(4, 8, 8), in_keys=["observation"], out_keys=["embedding"])
    with pytest.raises(ValueError, match="critic_encoder"):
        DIPOLoss(None, first.actor_network, first.qvalue_network, critic_encoder=own)
