"""Targets and refined actions ahead of their updates: the same losses and gradients as in one go."""

import pytest
import torch
from small_losses import make, transitions
from torchrl.envs.utils import ExplorationType

WHOLE_AND_PARTS = [
    ("qvalue_loss", "write_targets", "td_loss", "td_error"),
    ("actor_loss", "write_refined", "diffusion_loss", "refined_action"),
]


def small(separate=True, **options):
    loss = make(separate=separate, actor_seed=1, refine_step_size=0.5, **options)  # the actor's noise starts anew
    return loss.make_value_estimator(gamma=0.9)


def gradients(loss, value):
    loss.zero_grad()
    value.backward()
    return {name: p.grad.clone() for name, p in loss.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("refine_from", ["stored", "policy"])
@pytest.mark.parametrize("separate", [True, False])
@pytest.mark.parametrize(("whole", "first", "second", "written"), WHOLE_AND_PARTS)
def test_in_two_parts_as_in_one(whole, first, second, written, separate, refine_from):
    results = []
    for calls in ([whole], [first, second]):
        loss, data = small(separate, refine_from=refine_from), transitions(6)
        for call in calls[:-1]:
            assert getattr(loss, call)(data) is data
        value, _ = getattr(loss, calls[-1])(data)
        results.append((value.detach(), gradients(loss, value), data[written]))
    assert results[0][1].keys() == results[1][1].keys()
    torch.testing.assert_close(*results)


@pytest.mark.parametrize(("write", "key"), [("write_targets", "value_target"), ("write_refined", "refined_action")])
def test_a_block_is_its_batches(write, key):
    loss = small()
    loss.deterministic_sampling_mode = ExplorationType.DETERMINISTIC  # no noise, which a block draws in another order
    batches = [transitions(6, seed=seed) for seed in range(3)]
    block = getattr(loss, write)(torch.stack(batches))
    assert not block[key].requires_grad
    for piece, data in zip(block, batches, strict=True):
        torch.testing.assert_close(piece[key], getattr(loss, write)(data)[key])


@pytest.mark.parametrize(("call", "key"), [("td_loss", "value_target"), ("diffusion_loss", "refined_action")])
def test_what_was_not_written_is_named(call, key):
    with pytest.raises(KeyError, match=f"no key {key}"):
        getattr(small(), call)(transitions(6))


def test_keys_can_be_renamed():
    loss, data = small(), transitions(6)
    loss.set_keys(value_target=("deep", "target"), refined_action=("deep", "refined"))
    loss.td_loss(loss.write_targets(data))
    loss.diffusion_loss(loss.write_refined(data))
    assert data["deep", "target"].shape == (6, 3, 1)
    assert data["deep", "refined"].shape == (6, 3, 2)
