"""The networks inside a loss: their types and devices, ``torch.compile``, ``torch.vmap`` and sources of randomness."""

import pytest
import torch
from small_losses import make, single, transitions
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.objectives import SoftUpdate, ValueEstimators

from redig.modules import DenoisingMLP, DiffusionActor, NoiseSchedule
from redig.objectives import QWeightedLoss

# --- types and devices


def precise(loss):
    """What must not be rounded: schedule and bounds of the actor and its target, and the discount factor."""
    module = {
        f"{which}.{key[-1]}": value
        for which in ("actor_network_params", "target_actor_network_params")
        for key, value in getattr(loss, which).items(True, True)
        if key[-1] in ("low", "high", "betas", "alphas_cumprod")
    }
    return {**module, "gamma": loss.value_estimator.gamma}


def moved_before(dtype):
    """A loss around networks that are of another type already."""

    def build(cls, **options):
        first = make(cls, **options)
        encoder, actor, qvalue = (
            getattr(first, f"{name}_network").to(dtype) for name in ("encoder", "actor", "qvalue")
        )
        return cls(encoder, actor, qvalue, **options)

    return build


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
@pytest.mark.parametrize("when", ["before", "after"])
def test_networks_of_another_type(build, dtype, when):
    loss = (build(make=moved_before(dtype)) if when == "before" else build()).make_value_estimator(gamma=0.99)
    expected = precise(build().make_value_estimator(gamma=0.99))
    if when == "after":
        loss = loss.to(dtype)
    SoftUpdate(loss, tau=0.1).step()
    assert all(parameter.dtype == dtype for parameter in loss.parameters())
    for name, value in precise(loss).items():
        assert value.dtype in (torch.float32, torch.float64), name
        torch.testing.assert_close(value.float(), expected[name])
    out = loss(transitions(6))  # a batch in float32
    assert all(value.dtype != torch.bfloat16 and torch.isfinite(value) for value in out.values())
    (out["loss_qvalue"] + out["loss_actor"]).backward()
    assert all(torch.isfinite(p.grad).all() and p.grad.any() for p in loss.parameters())


def test_half_precision_is_close_to_single(build):
    data, results = transitions(64), []
    for dtype in (torch.float32, torch.bfloat16):
        loss = build(actor_seed=1).make_value_estimator(gamma=0.9).to(dtype)
        torch.manual_seed(0)
        results.append(loss(data.clone()))
    for name in ("loss_qvalue", "loss_actor", "target_value"):
        torch.testing.assert_close(results[1][name], results[0][name], rtol=0.05, atol=0.02)


def test_a_batch_in_half_precision(build):
    out = build().to(torch.bfloat16)(transitions(6).to(torch.bfloat16))
    assert all(value.dtype == torch.float32 and torch.isfinite(value) for value in out.values())


def test_autocast(build):
    loss = build()
    with torch.autocast("cpu", torch.bfloat16):
        out = loss(transitions(6))
    (out["loss_qvalue"] + out["loss_actor"]).backward()
    assert all(torch.isfinite(p.grad).all() for p in loss.parameters())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_everything_moves_to_another_device(build):
    loss = build().make_value_estimator(gamma=0.9).to("cuda")
    assert all(value.device.type == "cuda" for value in loss.state_dict().values())
    out = loss(transitions(6).to("cuda"))
    (out["loss_qvalue"] + out["loss_actor"]).backward()
    assert all(parameter.grad.device.type == "cuda" for parameter in loss.parameters())


def test_bounds_are_those_of_the_parameters_which_move_with_the_loss():
    loss, data = make(refine_step_size=100.0), transitions(6)
    loss.actor_network_params["module", "high"].data.fill_(0.25)
    refined = loss.refine(data, data["action"])
    assert refined.max() == 0.25 and refined.min() == -1


# --- torch.compile


def compiled_and_eager(loss, data):
    """Losses, TD errors and gradients of a batch, from the same seed."""
    torch.compiler.reset()
    SoftUpdate(loss, tau=0.1)
    results = []
    for forward in (loss, torch.compile(loss, fullgraph=True, backend="eager")):
        torch.manual_seed(3)
        batch = data.clone()
        out = forward(batch)
        gradients = torch.autograd.grad(out["loss_qvalue"] + out["loss_actor"], list(loss.parameters()))
        results.append([dict(out), batch["td_error"], list(gradients)])
    return results


def test_compiles_without_graph_breaks_to_the_same(build):
    data = transitions(2, 3)
    data["actor_mask"] = torch.rand(2, 3, 3, 1) < 0.8
    data["demonstration"] = torch.rand(2, 3, 1) < 0.3
    data["steps_to_next_obs"] = torch.full((2, 3, 1), 2)
    data["priority_weight"] = torch.rand(2, 3)
    torch.testing.assert_close(*compiled_and_eager(build(separate=True).make_value_estimator(gamma=0.9), data))


def test_compiles_without_encoder_on_trajectories():
    data = transitions(2, 3, n=1).apply(lambda x: x[..., 0, :1])
    loss = single().make_value_estimator(ValueEstimators.TDLambda, gamma=0.9)
    torch.testing.assert_close(*compiled_and_eager(loss, data))


def test_compiles_with_the_refinement_of_the_authors():
    torch.compiler.reset()
    loss = make(
        refine_steps=3, refine_optimizer="adam", refine_step_size=0.03, refine_grad_norm=0.2, refine_max_norm=0.5
    )
    compiled = torch.compile(loss.refine, fullgraph=True, backend="eager")
    data = transitions(4)
    torch.testing.assert_close(compiled(data, data["action"]), loss.refine(data, data["action"]))


# --- critics and randomness


@pytest.mark.parametrize("vmap", [True, False])
def test_random_critics(build, vmap):
    """Dropout: the copies draw masks of their own, also in the gradient of the refinement."""

    def noisy(cls, **options):
        first = make(cls, **options)
        layers = nn.Sequential(nn.Linear(10, 16), nn.Dropout(0.5), nn.Linear(16, 1))
        critic = TensorDictModule(
            lambda h, a: layers(torch.cat([h, a], -1)), ["embedding", "action"], ["state_action_value"]
        )
        critic.layers = layers
        return cls(first.encoder_network, first.actor_network, critic, deactivate_vmap=not vmap, **options)

    loss = build(make=noisy)
    assert loss.vmap_randomness == "different"
    out = loss(transitions(6))
    (out["loss_qvalue"] + out["loss_actor"]).backward()
    with pytest.raises(ValueError, match="Wrong vmap randomness"):
        loss.set_vmap_randomness("none")
    if vmap:
        loss.set_vmap_randomness("same")
        assert torch.isfinite(loss(transitions(6))["loss_qvalue"])


def test_critics_one_after_the_other_give_the_same(build):
    data, results = transitions(6), []
    for deactivate_vmap in (False, True):
        loss = build(actor_seed=1, deactivate_vmap=deactivate_vmap)
        torch.manual_seed(0)
        results.append(loss(data.clone()))
    torch.testing.assert_close(*(dict(result) for result in results))


def test_seeds(build):
    data, loss = transitions(6), build()
    results = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        results.append(loss(data.clone())["loss_actor"])
    assert results[0] == results[1] != results[2]


def test_a_generator_of_the_actors_own_is_all_that_is_drawn_from(build):
    results = []
    for seed in (1, 2):
        loss = build(actor_seed=7)
        torch.manual_seed(seed)
        results.append(loss(transitions(6)))
    assert (results[0] == results[1]).all()


@pytest.mark.parametrize("options", [{"latent_key": "latent"}, {"warm_start": 2, "previous_action_key": "before"}])
def test_actors_that_keep_something_from_step_to_step(build, options):
    def keeping(cls, **more):
        first = single(cls, **more)
        spec = Bounded(-1, 1, (1,))
        actor = DiffusionActor(
            DenoisingMLP(1, 1, (16,)), spec, ["observation"], ["action"], NoiseSchedule(5), **options
        )
        return cls(None, actor, first.qvalue_network, **more)

    loss, kept = build(make=keeping), next(value for value in options.values() if isinstance(value, str))
    assert {kept, ("next", kept)} < set(loss.in_keys)
    data = TensorDict({"observation": torch.randn(8, 1), "action": torch.zeros(8, 1), kept: torch.zeros(8, 1)}, [8])
    data["next"] = data.select("observation", kept).clone()
    for name in ("reward", "done", "terminated"):
        data["next", name] = torch.zeros(8, 1, dtype=torch.float32 if name == "reward" else torch.bool)
    out = loss(data)
    (out["loss_qvalue"] + out["loss_actor"]).backward()
    if isinstance(loss, QWeightedLoss):
        assert out["candidate_gap"] > 0  # the candidates differ, whatever the batch keeps
    with pytest.raises(KeyError, match=rf"no key {kept}, next.{kept} "):
        loss(data.exclude(kept, ("next", kept)))
