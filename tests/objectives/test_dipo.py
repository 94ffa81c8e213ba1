"""What DIPOLoss adds to the critics: refined actions, and an actor that learns them by diffusion."""

import pytest
import torch
from small_losses import (
    QuadraticQ,
    act,
    bandit,
    constant,
    gradient,
    known,
    make,
    single,
    transitions,
    valued_by,
)
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate


@pytest.mark.parametrize("refine_from", ["stored", "policy"])
@pytest.mark.parametrize("options", [{}, {"detach_encoder": True}, {"separate": True}])
def test_gradient_of_the_actor_loss(options, refine_from):
    loss = make(**options, refine_from=refine_from, refine_steps=2)
    loss(transitions(16))["loss_actor"].backward()
    assert gradient(loss, "encoder") > 0
    assert gradient(loss, "actor") > 0
    assert gradient(loss, "qvalue") is None
    if "separate" in options:
        assert gradient(loss, "critic_encoder") is None


# --- refinement


def smooth(**kwargs):
    loss = make(**kwargs).double()
    return loss, transitions(4).double()


def least_value(loss, data, action):
    """min(Q1, Q2) of every robot by calling one critic after the other."""
    with loss.encoder_network_params.to_module(loss.encoder_network):
        embedding = loss.encoder_network(data.select("observation"))["embedding"]
    values = []
    for k in range(2):
        with loss.qvalue_network_params[k].to_module(loss.qvalue_network):
            inputs = TensorDict({"embedding": embedding, "action": action}, data.shape)
            values.append(loss.qvalue_network(inputs)["state_action_value"])
    return torch.minimum(*values)


@pytest.mark.parametrize("steps", [1, 3])
def test_refinement_equals_finite_differences(steps):
    loss, data = smooth(refine_steps=steps, refine_step_size=0.2)
    start = 0.1 * data["action"]
    expected, h = start.clone(), 1e-6
    with torch.no_grad():
        for _ in range(steps):
            slope = torch.zeros_like(expected)
            for d in range(2):
                shift = h * torch.eye(2, dtype=torch.float64)[d]
                rise = least_value(loss, data, expected + shift) - least_value(loss, data, expected - shift)
                slope[..., d] = rise.squeeze(-1) / (2 * h)
            expected = expected + 0.2 * slope
    refined = loss.refine(data, start)
    torch.testing.assert_close(refined, expected, atol=1e-7, rtol=0)
    assert (refined - start).abs().max() > 1e-3
    assert not refined.requires_grad


def test_refinement_uses_the_critics_own_encoder():
    loss, data = make(separate=True), transitions(4)
    before = loss.refine(data, data["action"])
    loss.encoder_network_params.data.apply_(lambda x: x * 0)
    assert torch.equal(loss.refine(data, data["action"]), before)
    loss.critic_encoder_network_params.data.apply_(lambda x: x * 0)
    assert not torch.equal(loss.refine(data, data["action"]), before)


@pytest.mark.parametrize("best", [[0.4, -0.7], [0.99, 1.0], [-3.0, 0.2]])
def test_repeated_refinement_finds_the_best_action_within_the_bounds(best):
    loss = valued_by(QuadraticQ(best), refine_steps=60, refine_step_size=0.2)
    data = transitions(5)
    expected = torch.tensor(best).clamp(-1, 1).expand(5, 3, 2)
    torch.testing.assert_close(loss.refine(data, data["action"]), expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_number_and_size_of_steps(steps):
    loss, data = valued_by(QuadraticQ([0.4, -0.7]), refine_steps=steps, refine_step_size=0.1), transitions(5)
    best = torch.tensor([0.4, -0.7])
    expected = best + (data["action"] - best) * 0.8**steps  # the gradient is -2 (a - best)
    torch.testing.assert_close(loss.refine(data, data["action"]), expected)


def test_refined_action_stays_near_the_original():
    data = transitions(50)
    data["action"] *= 0.3
    best, limit = torch.tensor([0.5, -0.5]), 0.05
    loss = valued_by(QuadraticQ(best.tolist()), refine_steps=20, refine_step_size=0.3, refine_max_norm=limit)
    refined = loss.refine(data, data["action"])
    offset = best - data["action"]  # far enough to be cut, or not: in both cases straight toward the best action
    distance = offset.norm(dim=-1, keepdim=True)
    expected = data["action"] + offset * (limit / distance).clamp_max(1)
    torch.testing.assert_close(refined, expected, atol=1e-4, rtol=0)


def test_no_steps_leave_actions_as_they_are():
    loss, data = make(refine_steps=0), transitions(5)
    out = loss(data)
    assert torch.equal(data["refined_action"], data["action"])
    assert out["refine_distance"] == 0


# --- loss_actor


def test_actor_learns_the_refined_action_and_the_critic_the_executed_one():
    data = transitions(6)
    plain = constant().qvalue_loss(data.clone())[0]
    loss = constant(refine_steps=1, refine_step_size=0.1)
    out = loss(data)
    refined = loss.refine(data, data["action"])
    assert torch.equal(data["refined_action"], refined)
    assert not torch.equal(refined, data["action"])
    _, action, _ = known(loss)
    torch.testing.assert_close(out["loss_actor"], (refined - action).square().mean())
    torch.testing.assert_close(out["refine_distance"], (refined - data["action"]).norm(dim=-1).mean())
    torch.testing.assert_close(out["loss_qvalue"], plain)


def test_actor_loss_is_the_action_loss_of_the_actor():
    loss, data = make(actor_seed=3, refine_steps=0), transitions(6)
    found = loss.actor_loss(data)[0]
    reference = make(actor_seed=3)
    with reference.encoder_network_params.to_module(reference.encoder_network):
        embedding = reference.encoder_network(data.select("observation"))["embedding"]
    with reference.actor_network_params.to_module(reference.actor_network):
        expected = reference.actor_network.module.action_loss(data["action"], embedding).mean()
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("shape", [(6,), (6, 1)])
@pytest.mark.parametrize("dtype", [torch.bool, torch.float32, torch.int64])
@pytest.mark.parametrize("refine_from", ["stored", "policy"])
def test_demonstrations_are_not_refined(shape, dtype, refine_from):
    loss, data = make(refine_steps=2, refine_step_size=1.0, refine_from=refine_from), transitions(6)
    flag = torch.tensor([True, False, False, True, True, False])
    data["demonstration"] = flag.view(shape).to(dtype)
    data["base"] = -data["action"]
    loss.set_keys(base_action="base")
    out = loss(data)
    assert torch.equal(data["refined_action"][flag], data["action"][flag])
    assert ((data["refined_action"] - data["action"]).abs().amax((-1, -2)) > 1e-4)[~flag].all()
    assert out["refine_distance"] > 0
    data["demonstration"] = torch.ones(shape, dtype=torch.bool)
    assert loss(data)["refine_distance"] == 0


def test_base_action_is_refined_in_place_of_the_executed_one():
    loss, data = valued_by(QuadraticQ([0.4, -0.7]), refine_steps=1, refine_step_size=0.1), transitions(6)
    data["base"] = torch.zeros(6, 3, 2)
    loss.set_keys(base_action="base")
    _, metadata = loss.actor_loss(data)
    torch.testing.assert_close(data["refined_action"], 0.2 * torch.tensor([0.4, -0.7]).expand(6, 3, 2))
    assert metadata["refine_distance"].item() == pytest.approx(0.2 * (0.4**2 + 0.7**2) ** 0.5)


def test_refining_the_policys_own_actions():
    loss, data = constant(refine_steps=1, refine_from="policy"), transitions(6)
    loss(data)
    expected = loss.refine(data, known(loss)[1].expand(6, 3, 2))
    torch.testing.assert_close(data["refined_action"], expected)


def test_masked_robots_do_not_teach_the_actor():
    mask = torch.rand(6, 3, 1, generator=torch.Generator().manual_seed(0)) < 0.5
    data = transitions(6)
    data["actor_mask"] = mask
    out = constant()(data)
    error = (data["action"] - known(constant())[1]).square().mean(-1, keepdim=True)
    torch.testing.assert_close(out["loss_actor"], error[mask].mean())
    data["actor_mask"] = torch.ones_like(mask)
    unmasked = constant()(data)
    assert torch.equal(unmasked["loss_qvalue"], out["loss_qvalue"])
    torch.testing.assert_close(unmasked["loss_actor"], error.mean())
    data["actor_mask"] = torch.zeros_like(mask)
    assert constant()(data)["loss_actor"] == 0


def test_actions_of_masked_robots_have_no_influence():
    first, second = transitions(6), transitions(6)
    mask = torch.rand(6, 3, 1, generator=torch.Generator().manual_seed(0)) < 0.5
    second["action"] = first["action"].where(mask, -first["action"])
    grads = []
    for data in (first, second):
        data["actor_mask"] = mask
        loss = make(actor_seed=1)
        loss.actor_loss(data)[0].backward()
        grads.append([p.grad for p in loss.actor_network_params.parameters()])
    torch.testing.assert_close(*grads)


def test_solves_a_bandit():
    """From actions drawn at random."""
    loss = single(refine_steps=2, refine_step_size=0.4)
    optimizer = torch.optim.Adam(loss.parameters(), 5e-3)
    target = SoftUpdate(loss, tau=0.05)
    for _ in range(200):
        out = loss(bandit(2 * torch.rand(256, 1) - 1))
        optimizer.zero_grad()
        (out["loss_qvalue"] + out["loss_actor"]).backward()
        optimizer.step()
        target.step()
    action = act(loss)
    assert action.mean().item() == pytest.approx(0.6, abs=0.1)
    assert (action - 0.6).abs().mean() < 0.15


# --- improved actions kept in the buffer, as the authors of DIPO have it

AS_PUBLISHED = {"refine_steps": 20, "refine_optimizer": "adam", "refine_step_size": 0.03, "refine_grad_norm": 0.2}


def keeping_improved_actions(critic, size=40, batch=16):
    """The loss that the authors run and a buffer that keeps the best action so far beside the executed one."""
    loss = valued_by(critic, **AS_PUBLISHED)
    loss.set_keys(base_action="best_action", refined_action="best_action")
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(size), batch_size=batch)
    data = transitions(size)
    data["best_action"] = data["action"].clone()
    buffer.extend(data)
    return loss, buffer, data


def test_improved_actions_kept_in_the_buffer_get_better_and_better():
    torch.manual_seed(0)
    best = torch.tensor([0.4, -0.7])
    loss, buffer, data = keeping_improved_actions(QuadraticQ(best.tolist()))
    distances = []
    for _ in range(30):
        distances.append((buffer[:]["best_action"] - best).norm(dim=-1).mean().item())
        batch = buffer.sample()
        before = batch["best_action"].clone()
        loss.actor_loss(batch)
        moved = (batch["best_action"] - before).abs()
        assert moved.max() < 1.1 * 20 * 0.03  # Adam moves each number by about its rate
        buffer.set_at_("best_action", batch["best_action"], batch["index"])
        assert torch.equal(buffer[:]["best_action"][batch["index"]], batch["best_action"])
    assert distances[0] > 0.8
    assert distances[10] < distances[5] < distances[0]
    assert distances[-1] < 0.05
    assert torch.equal(buffer[:]["action"], data["action"])  # what was executed stays


def test_the_critic_learns_executed_actions_whatever_the_buffer_has_improved():
    loss, buffer, _ = keeping_improved_actions(QuadraticQ([0.4, -0.7]))
    plain = valued_by(QuadraticQ([0.4, -0.7]))
    batch = buffer.sample()
    loss(batch)  # improves best_action
    assert not torch.equal(batch["best_action"], batch["action"])
    torch.testing.assert_close(loss.qvalue_loss(batch)[0], plain.qvalue_loss(batch)[0])
    expected = plain.value(batch) - loss._target_value(batch)[0]
    torch.testing.assert_close(batch["td_error"], expected.abs())


# --- bad arguments and batches


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"refine_from": "buffer"}, "refine_from: got 'buffer', allowed are stored, policy"),
        ({"refine_steps": -1}, "refine_steps: got -1, must be at least 0"),
        ({"refine_max_norm": 0.0}, "refine_max_norm: got 0.0, must be greater than 0"),
        ({"detach_encoder": True, "separate": True}, "detach_encoder: a separate critic_encoder"),
        ({"loss_function": "l1"}, "loss_function: got 'l1', allowed are l2, smooth_l1"),
        ({"reduction": "average"}, "reduction: got 'average'"),
        ({"num_qvalue_nets": 0}, "num_qvalue_nets: got 0"),
        ({"refine_optimizer": "lion"}, "refine_optimizer: got 'lion', allowed are sgd, adam"),
    ],
)
def test_bad_arguments(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_a_missing_base_action_is_named():
    loss = make()
    loss.set_keys(base_action=("agents", "policy_action"))
    with pytest.raises(KeyError, match="no key agents.policy_action "):
        loss(transitions(6))


def test_wrong_shapes_are_named():
    loss, data = make(), transitions(6)
    loss.set_keys(base_action="base")
    data["base"] = torch.zeros(6, 4, 2)
    with pytest.raises(ValueError, match=r"base: got shape \[6, 4, 2\], expected \[6, 3, 2\]"):
        loss(data)
    for name in ("demonstration", "actor_mask"):
        data = transitions(6)
        data["base"] = data["action"]
        data[name] = torch.zeros(6, 2, 1)
        with pytest.raises(ValueError, match=rf"{name}: got shape \[6, 2, 1\], expected \[6, 3, 1\]"):
            loss(data)
