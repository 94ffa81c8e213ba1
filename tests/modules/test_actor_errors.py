"""Bad input as users meet it: an error at once, which names the key or argument, what was seen and what is allowed."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from redig.modules import DDIM, DDPM, DenoisingMLP, DiffusionActor, DPMSolver, NoiseSchedule


def make(spec=None, sampler=None, **options):
    options = {"in_keys": ["embedding"], "out_keys": ["action"], "schedule": NoiseSchedule(10), **options}
    spec = Bounded(-1, 1, (5, 2)) if spec is None else spec
    return DiffusionActor(DenoisingMLP(2, 6, hidden=(16,)), spec, sampler=sampler, **options)


def embeddings(*batch, width=6):
    return TensorDict({"embedding": torch.randn(*batch, width)}, batch[:1])


@pytest.mark.parametrize("spec", [Unbounded((5, 2)), Bounded(-torch.inf, 1, (5, 2)), Categorical(3)])
def test_spec_without_bounds(spec):
    with pytest.raises(ValueError, match=r"action_spec: got .* without finite bounds"):
        make(spec)


@pytest.mark.parametrize("spec", [Bounded(-1, 1, ()), Bounded(1, 1, (2,))])
def test_spec_of_another_shape_or_without_room(spec):
    with pytest.raises(ValueError, match=r"action_spec: got shape .*, expected \[\*n, A\] with low < high"):
        make(spec)


def test_bounds_that_differ_between_robots():
    spec = Bounded(-torch.ones(2, 2), torch.tensor([[1.0, 1.0], [1.0, 2.0]]), (2, 2))
    with pytest.raises(ValueError, match="action_spec: the bounds differ between robots"):
        make(spec)


def test_spec_without_the_actions_key():
    with pytest.raises(KeyError, match=r"action_spec: no key 'action', the action's; it has 'command'"):
        make(Composite(command=Bounded(-1, 1, (2,))))


def test_several_out_keys():
    with pytest.raises(ValueError, match=r"out_keys: got \['a', 'b'\], must be one key"):
        make(out_keys=["a", "b"])


def test_sampler_with_more_steps_than_the_schedule():
    message, actor = "num_steps: the sampler asks for 11 steps, the schedule has 10", make()
    with pytest.raises(ValueError, match=message):
        make(sampler=DDPM(11))
    with pytest.raises(ValueError, match=message):
        actor.with_sampler(DDIM(11))
    with pytest.raises(ValueError, match=message):
        actor(embeddings(8, 5), sampler=DPMSolver(11))


def test_sampler_that_does_not_reach_the_warm_start():
    message, actor = r"warm_start: got 5, must be from 9, the lowest step of DDIM.*, to 9", make(warm_start=5)
    with pytest.raises(ValueError, match=message):
        actor.with_sampler(DDIM(1))
    data = embeddings(8, 5).set("previous_action", torch.zeros(8, 5, 2))
    with pytest.raises(ValueError, match=message):
        actor(data, sampler=DDIM(1))


def test_missing_key():
    data = TensorDict({("agents", "observation"): torch.zeros(3, 5, 6)}, [3])
    with pytest.raises(KeyError, match=r"no key 'embedding'; it has .*\('agents', 'observation'\)"):
        make()(data)
    with pytest.raises(KeyError, match="no key 'embedding'"):
        make()(embeding=torch.zeros(3, 5, 6))


def test_missing_latent_or_previous_action():
    message = r"no key 'previous_action', \('agents', 'z'\); it has .*; append make_tensordict_primer\(\)"
    with pytest.raises(KeyError, match=message):
        make(latent_key=("agents", "z"), warm_start=5)(embeddings(3, 5))


@pytest.mark.parametrize("shape", [(5, 2), (3, 1, 2), (3, 4, 2), (3, 5, 3), (3, 5)])
def test_latent_or_previous_action_of_another_shape(shape):
    for key, options in (("z", {"latent_key": "z"}), ("previous_action", {"warm_start": 5})):
        data = TensorDict({"embedding": torch.zeros(3, 5, 6), key: torch.zeros(shape)}, [])
        message = rf"'{key}': got shape .*, expected \[3, 5, 2\] beside 'embedding' of shape \[3, 5, 6\]"
        with pytest.raises(ValueError, match=message):
            make(**options)(data)


def test_embeddings_of_different_teams():
    data = TensorDict({"first": torch.zeros(3, 5, 2), ("a", "second"): torch.zeros(3, 4, 4)}, [3])
    message = r"\('a', 'second'\): got shape \[3, 4, 4\], expected \[3, 5, 4\] beside 'first' of shape \[3, 5, 2\]"
    with pytest.raises(ValueError, match=message):
        make(in_keys=["first", ("a", "second")])(data)


def test_embedding_of_another_width():
    with pytest.raises(ValueError, match=r"embedding: got shape \[3, 5, 7\], expected \[3, 5, 6\]"):
        make()(embeddings(3, 5, width=7))
