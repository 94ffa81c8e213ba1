import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.objectives import SoftUpdate, ValueEstimators

from redig.modules import DDPM, DenoisingMLP, DiffusionActor, GraphEncoder, NoiseSchedule, QNetwork
from redig.objectives import DIPOLoss

NETWORKS = ("encoder", "critic_encoder", "actor", "qvalue")


class ConstantActor(nn.Module):
    """Does the same everywhere; its diffusion loss is the plain squared error."""

    def __init__(self, action):
        super().__init__()
        self.action = nn.Parameter(torch.tensor(action))
        self.register_buffer("low", torch.tensor(-1.0))
        self.register_buffer("high", torch.tensor(1.0))

    def forward(self, embedding):
        return self.action.expand(*embedding.shape[:-1], -1)

    def denoising_error(self, action, embedding):
        return (action - self.action).square().mean(-1)


class LinearQ(nn.Module):
    """Q = w . [h, a]."""

    def __init__(self, width):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(width))

    def forward(self, embedding, action):
        return (torch.cat([embedding, action], -1) * self.weight).sum(-1, keepdim=True)


class QuadraticQ(nn.Module):
    """Q = -|a - best|^2."""

    def __init__(self, best):
        super().__init__()
        self.best = nn.Parameter(torch.tensor(best))

    def forward(self, embedding, action):
        return -(action - self.best).square().sum(-1, keepdim=True)


def graph_encoder():
    return TensorDictModule(GraphEncoder(4, 8, 8), in_keys=["observation"], out_keys=["embedding"])


def make(seed=0, actor_seed=None, key=lambda name: name, separate=False, **kwargs):
    """The loss around small networks; ``actor_seed`` gives the actor a generator of its own."""
    torch.manual_seed(seed)
    in_keys, out_keys = [key("observation")], [key("embedding")]
    encoder, own = (TensorDictModule(GraphEncoder(4, 8, 8), in_keys=in_keys, out_keys=out_keys) for _ in range(2))
    actor = DiffusionActor(
        DenoisingMLP(2, 8, (16,)),
        Bounded(-1, 1, (3, 2)),
        in_keys=out_keys,
        out_keys=[key("action")],
        schedule=NoiseSchedule(5),
        generator=None if actor_seed is None else torch.Generator().manual_seed(actor_seed),
    )
    value = TensorDictModule(
        QNetwork(8, 2, (16,)), in_keys=[*out_keys, key("action")], out_keys=[key("state_action_value")]
    )
    return DIPOLoss(encoder, actor, value, critic_encoder=own if separate else None, **kwargs)


def constant(action=(0.3, -0.2), refine_steps=0, **kwargs):
    """The loss around networks that are known in closed form: linear encoder, constant actor, linear critics."""
    torch.manual_seed(0)
    encoder = TensorDictModule(nn.Linear(4, 3, bias=False), in_keys=["observation"], out_keys=["embedding"])
    actor = TensorDictModule(ConstantActor(action), in_keys=["embedding"], out_keys=["action"])
    value = TensorDictModule(LinearQ(5), in_keys=["embedding", "action"], out_keys=["state_action_value"])
    loss = DIPOLoss(encoder, actor, value, refine_steps=refine_steps, **kwargs)
    for name in ("encoder", "actor", "qvalue"):  # all different from their targets
        for which in ("", "target_"):
            for leaf in getattr(loss, f"{which}{name}_network_params").values(True, True):
                if leaf.ndim:
                    leaf.data.copy_(torch.randn(leaf.shape))
    return loss.make_value_estimator(gamma=0.9)


def known(loss, which=""):
    """Weights of :func:`constant`: encoder ``[3, 4]``, action ``[2]``, critics ``[2, 5]``."""
    names = (("encoder", "weight"), ("actor", "action"), ("qvalue", "weight"))
    return [getattr(loss, f"{which}{network}_network_params")["module", leaf].detach() for network, leaf in names]


def refining(best, **kwargs):
    """The loss around a critic whose best action is known."""
    actor = TensorDictModule(ConstantActor([0.0, 0.0]), in_keys=["observation"], out_keys=["action"])
    value = TensorDictModule(QuadraticQ(best), in_keys=["observation", "action"], out_keys=["state_action_value"])
    loss = DIPOLoss(None, actor, value, **kwargs)
    loss.qvalue_network_params["module", "best"].data[:] = torch.tensor(best)
    return loss


def transitions(*batch, n=3, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*batch, *shape, generator=generator)

    terminated = torch.rand(*batch, n, 1, generator=generator) < 0.3
    following = {"observation": normal(n, 4), "reward": normal(n, 1), "done": terminated, "terminated": terminated}
    return TensorDict({"observation": normal(n, 4), "action": normal(n, 2).clamp(-1, 1), "next": following}, batch)


def gradient(loss, name):
    """Largest gradient of a network's parameters, or ``None`` where none arrived."""
    grads = [p.grad for p in getattr(loss, f"{name}_network_params").parameters() if p.grad is not None]
    return max(g.abs().max().item() for g in grads) if grads else None


# --- loss_qvalue


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


def test_gamma_and_unknown_value_estimator():
    loss, data = constant(), transitions(6)
    loss.make_value_estimator(gamma=0.0)
    torch.testing.assert_close(loss(data)["target_value"], data["next", "reward"].mean())
    with pytest.raises(ValueError, match=r"value_type: got ValueEstimators\.GAE"):
        loss.make_value_estimator(ValueEstimators.GAE)


# --- where gradients go


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
    loss = refining(best, refine_steps=60, refine_step_size=0.2)
    data = transitions(5)
    expected = torch.tensor(best).clamp(-1, 1).expand(5, 3, 2)
    torch.testing.assert_close(loss.refine(data, data["action"]), expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_number_and_size_of_steps(steps):
    loss, data = refining([0.4, -0.7], refine_steps=steps, refine_step_size=0.1), transitions(5)
    best = torch.tensor([0.4, -0.7])
    expected = best + (data["action"] - best) * 0.8**steps  # the gradient is -2 (a - best)
    torch.testing.assert_close(loss.refine(data, data["action"]), expected)


def test_refined_action_stays_near_the_original():
    data = transitions(50)
    data["action"] *= 0.3
    best, limit = torch.tensor([0.5, -0.5]), 0.05
    refined = refining(best.tolist(), refine_steps=20, refine_step_size=0.3, refine_max_norm=limit).refine(
        data, data["action"]
    )
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


def test_actor_loss_is_the_denoising_error_of_the_actor():
    loss, data = make(actor_seed=3, refine_steps=0), transitions(6)
    found = loss.actor_loss(data)[0]
    reference = make(actor_seed=3)
    with reference.encoder_network_params.to_module(reference.encoder_network):
        embedding = reference.encoder_network(data.select("observation"))["embedding"]
    with reference.actor_network_params.to_module(reference.actor_network):
        expected = reference.actor_network.module.denoising_error(data["action"], embedding).mean()
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("shape", [(6,), (6, 1)])
@pytest.mark.parametrize("refine_from", ["stored", "policy"])
def test_demonstrations_are_not_refined(shape, refine_from):
    loss, data = make(refine_steps=2, refine_step_size=1.0, refine_from=refine_from), transitions(6)
    flag = torch.tensor([True, False, False, True, True, False])
    data["demonstration"] = flag.view(shape)
    data["base"] = -data["action"]
    loss.set_keys(base_action="base")
    out = loss(data)
    assert torch.equal(data["refined_action"][flag], data["action"][flag])
    assert ((data["refined_action"] - data["action"]).abs().amax((-1, -2)) > 1e-4)[~flag].all()
    assert out["refine_distance"] > 0
    data["demonstration"] = torch.ones(shape, dtype=torch.bool)
    assert loss(data)["refine_distance"] == 0


def test_base_action_is_refined_in_place_of_the_executed_one():
    loss, data = refining([0.4, -0.7], refine_steps=1, refine_step_size=0.1), transitions(6)
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


# --- reductions, weights, keys


def test_reductions():
    results = {}
    for reduction in ("none", "mean", "sum"):
        results[reduction] = make(actor_seed=2, reduction=reduction)(transitions(6))
    for name in ("loss_qvalue", "loss_actor"):
        none = results["none"][name]
        assert none.shape == (6, 3, 1)
        torch.testing.assert_close(results["mean"][name], none.mean())
        torch.testing.assert_close(results["sum"][name], none.sum())


@pytest.mark.parametrize("shape", [(6,), (6, 1)])
def test_priority_weights_count_for_all_robots_of_a_team(shape):
    none = make(actor_seed=2, reduction="none")(transitions(6))
    weight, data = torch.rand(6), transitions(6)
    data["priority_weight"] = weight.view(shape)
    out = make(actor_seed=2)(data)
    for name in ("loss_qvalue", "loss_actor"):
        torch.testing.assert_close(out[name], (none[name].mean((1, 2)) * weight).sum() / weight.sum())


def nested(name):
    return ("team", "deep", name)


def test_nested_keys():
    flat, data = transitions(6), TensorDict({}, [6])
    for name in ("observation", "action"):
        data[nested(name)] = flat[name]
    for name in ("observation", "reward", "done", "terminated"):
        data["next", *nested(name)] = flat["next", name]
    flag = torch.rand(6) < 0.5
    extra = {"demonstration": flag, "actor_mask": torch.rand(6, 3, 1) < 0.5, "steps_to_next_obs": torch.full((6, 1), 2)}
    for name, value in extra.items():
        flat[name], data[nested(name)] = value, value
    names = ("action", "state_action_value", "reward", "done", "terminated", "refined_action", *extra)
    loss = make(actor_seed=4, key=nested)
    loss.set_keys(**{name: nested(name) for name in names}, priority=nested("td"))
    loss.make_value_estimator(gamma=0.9)
    expected = make(actor_seed=4).make_value_estimator(gamma=0.9)(flat)
    assert (loss(data) == expected).all()
    assert torch.equal(data[nested("refined_action")], flat["refined_action"])
    assert torch.equal(data[nested("td")], flat["td_error"])
    following = [("next", *nested(name)) for name in ("observation", "reward", "done", "terminated")]
    assert loss.in_keys == [nested("action"), nested("observation"), *following]


def test_keys_set_after_the_value_estimator_was_made():
    data = transitions(6)
    before = constant()(data.clone())
    data["next", "r"] = data["next", "reward"]
    data["next", "reward"] = torch.full((6, 3, 1), torch.nan)
    loss = constant()
    loss.set_keys(reward="r")
    assert (loss(data) == before).all()


def test_dispatch_takes_tensors():
    data = transitions(6)
    expected = make(actor_seed=5)(data.clone())
    loss = make(actor_seed=5)
    arguments = {"_".join(key) if isinstance(key, tuple) else key: data[key] for key in loss.in_keys}
    for name, value in zip(loss.out_keys, loss(**arguments), strict=True):
        assert torch.equal(value, expected[name])


# --- state, targets, other shapes


@pytest.mark.parametrize("separate", [False, True])
def test_state_dict_round_trip(separate):
    first, second = make(0, 1, separate=separate), make(9, 1, separate=separate)
    data = transitions(6)
    second.load_state_dict(first.state_dict())
    assert (first(data.clone()) == second(data.clone())).all()


def test_soft_update_moves_the_targets_of_all_networks():
    loss, tau = make(separate=True), 0.3
    updater = SoftUpdate(loss, tau=tau)
    pairs = [[getattr(loss, f"{which}{name}_network_params") for which in ("", "target_")] for name in NETWORKS]
    for online, _ in pairs:
        for parameter in online.parameters():
            parameter.data.normal_()
    before = [(online.data.clone(), target.data.clone()) for online, target in pairs]
    updater.step()
    for (online, target), (online_before, target_before) in zip(pairs, before, strict=True):
        for key, value in target.items(True, True):
            if isinstance(online[key], nn.Parameter):
                expected = (1 - tau) * target_before[key] + tau * online_before[key]
                torch.testing.assert_close(value.data, expected)
                assert not torch.equal(value.data, target_before[key])
            assert torch.equal(online[key].data, online_before[key])


def single(reduction="mean", refine_steps=1, **kwargs):
    """One robot without an encoder: observation ``[B, 1]``, action ``[B, 1]``."""
    torch.manual_seed(0)
    actor = DiffusionActor(
        DenoisingMLP(1, 1, (32, 32)),
        Bounded(-1.0, 1.0, (1,)),
        in_keys=["observation"],
        out_keys=["action"],
        schedule=NoiseSchedule(10),
        sampler=DDPM(num_steps=5),
    )
    value = TensorDictModule(QNetwork(1, 1, (32, 32)), ["observation", "action"], ["state_action_value"])
    loss = DIPOLoss(None, actor, value, reduction=reduction, refine_steps=refine_steps, **kwargs)
    return loss.make_value_estimator(gamma=0.9)


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


def test_solves_a_bandit():
    """Reward -(a - 0.6)^2, one step an episode, from actions drawn at random."""
    loss = single(refine_steps=2, refine_step_size=0.4)
    optimizer = torch.optim.Adam(loss.parameters(), 5e-3)
    target = SoftUpdate(loss, tau=0.05)
    flag, observation = torch.ones(256, 1, dtype=torch.bool), torch.zeros(256, 1)
    for _ in range(200):
        action = 2 * torch.rand(256, 1) - 1
        following = {"observation": observation, "reward": -((action - 0.6) ** 2), "done": flag, "terminated": flag}
        out = loss(TensorDict({"observation": observation, "action": action, "next": following}, [256]))
        optimizer.zero_grad()
        (out["loss_qvalue"] + out["loss_actor"]).backward()
        optimizer.step()
        target.step()
    with torch.no_grad(), loss.actor_network_params.to_module(loss.actor_network):
        action = loss.actor_network(observation=observation)
    assert action.mean().item() == pytest.approx(0.6, abs=0.1)
    assert (action - 0.6).abs().mean() < 0.15


# --- bad arguments


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
    ],
)
def test_bad_arguments(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_critic_encoder_without_encoder_is_refused_not_ignored():
    actor = TensorDictModule(ConstantActor([0.0, 0.0]), in_keys=["observation"], out_keys=["action"])
    value = TensorDictModule(LinearQ(6), in_keys=["observation", "action"], out_keys=["state_action_value"])
    with pytest.raises(ValueError, match="critic_encoder"):
        DIPOLoss(None, actor, value, critic_encoder=graph_encoder())
