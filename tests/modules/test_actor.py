import copy
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential, set_skip_existing
from torchrl.data import Bounded, Composite
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.testing import get_default_devices

from redig.modules import DDIM, DDPM, DenoisingMLP, DiffusionActor, DPMSolver, GraphEncoder, NoiseSchedule

LOW, HIGH = torch.tensor([-0.5, 0.0]), torch.tensor([2.0, 0.1])
devices = pytest.mark.parametrize("device", get_default_devices())


def make(spec=None, seed=None, denoiser=None, steps=10, sampler=None, kind="linear", **keys):
    """An untrained actor; with the linear schedule its actions do not all end at the bounds."""
    torch.manual_seed(0)
    keys = {"in_keys": ["embedding"], "out_keys": ["action"], **keys}
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    denoiser = denoiser or DenoisingMLP(2, 6, hidden=(16,))
    spec = Bounded(-1, 1, (5, 2)) if spec is None else spec
    return DiffusionActor(
        denoiser, spec, schedule=NoiseSchedule(steps, kind), sampler=sampler, generator=generator, **keys
    )


def embeddings(*batch, width=6):
    return TensorDict({"embedding": torch.randn(*batch, width)}, batch[:1])


def sample(actor, data, kind=ExplorationType.RANDOM, **options):
    with set_exploration_type(kind):
        return actor(data.clone(), **options)["action"]


def best(actor, data, **options):
    return sample(actor, data, ExplorationType.DETERMINISTIC, **options)


class TestRandomness:
    def test_exploration_type_decides(self):
        actor, data = make(), embeddings(8, 5)
        assert not torch.equal(sample(actor, data), sample(actor, data))
        for kind in (ExplorationType.DETERMINISTIC, ExplorationType.MEAN, ExplorationType.MODE):
            before = torch.get_rng_state()
            assert torch.equal(sample(actor, data, kind), sample(actor, data, kind))
            assert torch.equal(torch.get_rng_state(), before)

    def test_none_set_means_random(self):
        actor, data = make(), embeddings(8, 5)
        assert not torch.equal(sample(actor, data, None), sample(actor, data, None))
        assert not torch.equal(actor(data.clone())["action"], actor(data.clone())["action"])

    def test_seeded_generator_is_independent_of_the_global_one(self):
        data = embeddings(8, 5)
        actors = [make(seed=seed) for seed in (3, 3, 4)]
        torch.manual_seed(11)
        before = torch.get_rng_state()
        first = sample(actors[0], data), actors[0].module.action_loss(torch.zeros(8, 5, 2), data["embedding"])
        assert torch.equal(torch.get_rng_state(), before)
        torch.manual_seed(12)
        second = sample(actors[1], data), actors[1].module.action_loss(torch.zeros(8, 5, 2), data["embedding"])
        assert torch.equal(first[0], second[0])
        assert torch.equal(first[1], second[1])
        assert not torch.equal(first[0], sample(actors[2], data))
        assert not torch.equal(first[0], sample(actors[0], data))  # it moves on

    def test_without_a_generator_the_global_one_is_used(self):
        actor, data = make(), embeddings(8, 5)
        torch.manual_seed(5)
        first = sample(actor, data)
        torch.manual_seed(5)
        assert torch.equal(sample(actor, data), first)

    def test_copies_carry_their_generator_along(self):
        actor, data = make(seed=3), embeddings(8, 5)
        copies = copy.deepcopy(actor), pickle.loads(pickle.dumps(actor))
        expected = sample(actor, data)
        for other in copies:
            assert torch.equal(sample(other, data), expected)


class TestBounds:
    @settings(deadline=None)
    @given(seed=st.integers(0, 2**31), scale=st.floats(0, 1000), kind=st.sampled_from([*ExplorationType]))
    def test_untrained_actor_never_leaves_them(self, seed, scale, kind):
        actor, data = make(Bounded(LOW, HIGH, (2,)), seed=seed), embeddings(16)
        for parameter in actor.parameters():
            parameter.data.mul_(scale)
        for sampler in (DDPM(), DDIM(5, 0.5), DPMSolver(5)):
            action = sample(actor, data, kind, sampler=sampler)
            assert (action >= LOW).all()
            assert (action <= HIGH).all()

    def test_both_ends_are_reached(self):
        for sign, end in ((1, LOW), (-1, HIGH)):
            actor = make(
                Bounded(LOW, HIGH, (2,)), denoiser=lambda action, *_, sign=sign: sign * 1e6 * torch.ones_like(action)
            )
            torch.testing.assert_close(sample(actor, embeddings(4)), end.expand(4, 2))

    def test_of_a_team(self):
        policy = make(Bounded(LOW.expand(5, 2), HIGH.expand(5, 2), (5, 2))).module
        assert torch.equal(policy.low, LOW)
        assert torch.equal(policy.high, HIGH)

    def test_spec_of_the_actor(self):
        spec = Bounded(LOW.expand(5, 2), HIGH.expand(5, 2), (5, 2))
        actor = make(spec, out_keys=[("a", "b", "action")])
        assert actor.spec["a", "b", "action"] == spec
        assert actor.bfloat16().spec["a", "b", "action"] == spec  # the actions stay in float32
        batched = Composite(action=Bounded(LOW.expand(3, 5, 2), HIGH.expand(3, 5, 2), (3, 5, 2)), shape=(3,))
        assert make(batched).spec["action"] == spec
        assert make().double().spec["action"].dtype == torch.float64


class TestKeys:
    @pytest.mark.parametrize("embedding", ["h", ("a", "h"), ("a", "b", "c", "h")])
    @pytest.mark.parametrize("action", ["u", ("a", "u"), ("x", "y", "z", "u")])
    def test_of_any_depth(self, embedding, action):
        actor, value = make(in_keys=[embedding], out_keys=[action]), torch.randn(3, 5, 6)
        assert (actor.in_keys, actor.out_keys) == ([embedding], [action])
        data = TensorDict({embedding: value}, [3])
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            assert actor(data) is data
            assert torch.equal(data[action], best(make(), TensorDict({"embedding": value}, [3])))
        assert set(data.keys(True, True)) == {embedding, action}
        assert torch.equal(data[embedding], value)

    def test_of_a_composite_spec(self):
        bounds = Bounded(LOW.expand(3, 5, 2), HIGH.expand(3, 5, 2), (3, 5, 2))
        spec = Composite(agents=Composite(action=bounds, shape=(3, 5)), shape=(3,))
        actor = make(spec, in_keys=[("agents", "deep", "embedding")], out_keys=[("agents", "action")])
        data = actor(TensorDict({"agents": {"deep": {"embedding": torch.randn(3, 5, 6)}}}, [3]))
        assert data["agents", "action"].shape == (3, 5, 2)
        assert spec.is_in(data.select(("agents", "action")))

    def test_several_embeddings_are_concatenated(self):
        both = torch.randn(8, 5, 6)
        split = TensorDict({"first": both[..., :2], ("agents", "second"): both[..., 2:]}, [8])
        together, apart = make(seed=1), make(seed=1, in_keys=["first", ("agents", "second")])
        apart.load_state_dict(together.state_dict())
        expected = sample(together, TensorDict({"embedding": both}, [8]))
        assert torch.equal(sample(apart, split), expected)
        action = torch.rand(8, 5, 2)
        found = apart.module.action_loss(action, both[..., :2], both[..., 2:])
        assert torch.equal(found, together.module.action_loss(action, both))

    def test_dispatch_of_plain_tensors(self):
        actor = make(in_keys=["first", ("a", "b", "second")], out_keys=[("a", "action")])
        first, second = torch.randn(8, 5, 2), torch.randn(8, 5, 4)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            data = TensorDict({"first": first, ("a", "b", "second"): second}, [8])
            expected = actor(data)["a", "action"]
            assert torch.equal(actor(first, second), expected)
            assert torch.equal(actor(first=first, a_b_second=second), expected)
            assert torch.equal(actor(first, a_b_second=second), expected)
            fewer = actor(first, second, sampler=DDIM(2))
            assert torch.equal(fewer, actor.with_sampler(DDIM(2))(first, second))

    def test_select_out_keys(self):
        kept = {"latent_key": "z", "warm_start": 5, "previous_action_key": "previous"}
        actor, data = make(**kept), embeddings(8, 5)
        data["z"], data["previous"] = torch.zeros(2, 8, 5, 2)
        assert actor.in_keys == ["embedding", "z", "previous"]
        assert actor.out_keys == ["action", ("next", "previous")]
        fast = actor.with_sampler(DDIM(2)).select_out_keys("action")
        assert set(fast(data.clone()).keys(True, True)) == {*data.keys(), "action"}
        assert set(actor(data.clone()).keys(True, True)) == {*data.keys(), "action", ("next", "previous")}
        fast.reset_out_keys()
        assert ("next", "previous") in fast(data.clone()).keys(True)

    def test_skip_existing_and_tensordict_out(self):
        actor, data = make(), embeddings(8, 5)
        done = data.clone().set("action", torch.full((8, 5, 2), 7.0))
        with set_skip_existing(True):
            assert (actor(done)["action"] == 7).all()
        out = TensorDict({}, [8])
        assert actor(data, tensordict_out=out) is out
        assert set(data.keys()) == {"embedding"}
        assert set(out.keys()) == {"action"}


class TestBatches:
    @pytest.mark.parametrize("batch", [(), (3,), (3, 5), (3, 4, 5), (0,), (2, 0, 5)])
    def test_shapes(self, batch):
        actor, data = make(Bounded(-1, 1, (2,))), embeddings(*batch)
        assert sample(actor, data).shape == (*batch, 2)
        assert actor.module.action_loss(torch.zeros(*batch, 2), data["embedding"]).shape == batch
        rows = embeddings(data["embedding"].numel() // 6)
        rows["embedding"] = data["embedding"].reshape(-1, 6)
        torch.testing.assert_close(best(actor, data).reshape(-1, 2), best(actor, rows))

    @pytest.mark.parametrize("dims", [0, 1, 2, 3])
    def test_batch_size_of_the_tensordict_may_be_any_part_of_the_shape(self, dims):
        actor, embedding = make(), torch.randn(2, 3, 5, 6)
        data = TensorDict({"embedding": embedding}, embedding.shape[:dims])
        torch.testing.assert_close(best(actor, data), best(actor, TensorDict({"embedding": embedding}, [2])))

    def test_an_actor_of_five_robots_drives_any_number(self):
        assert sample(make(), embeddings(8, 3)).shape == (8, 3, 2)

    def test_gradient_reaches_embedding_and_all_weights(self):
        actor, data = make(sampler=DDIM(3)), embeddings(8, 5)
        data["embedding"].requires_grad_()
        best(actor, data).sum().backward()
        for tensor in (data["embedding"], *actor.parameters()):
            assert tensor.grad.abs().max() > 0


class TestSamplers:
    @pytest.mark.parametrize("sampler", [DDPM(3), DDIM(5, 0.5), DPMSolver(5), DDPM(early_stop=4)])
    def test_for_one_call_and_for_good(self, sampler):
        actor, data = make(seed=1), embeddings(8, 5)
        for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
            results = []
            for other, options in (
                (actor, {"sampler": sampler}),
                (actor.with_sampler(sampler), {}),
                (make(sampler=sampler), {}),
            ):
                other.module.generator = torch.Generator().manual_seed(2)
                results.append(sample(other, data, kind, **options))
            assert torch.equal(results[0], results[1])
            assert torch.equal(results[0], results[2])
        assert actor.module.sampler == DDPM()

    def test_with_sampler_shares_the_weights(self):
        actor, data = make(), embeddings(8, 5)
        fast = actor.with_sampler(DDIM(2))
        assert [*map(id, fast.parameters())] == [*map(id, actor.parameters())]
        assert [*map(id, fast.buffers())] == [*map(id, actor.buffers())]
        before = best(fast, data)
        other = DiffusionActor(DenoisingMLP(2, 6, (16,)), Bounded(-3, 3, (2,)), schedule=NoiseSchedule(10, "linear"))
        actor.load_state_dict(other.state_dict())
        assert actor.module.sampler == DDPM()
        assert fast.module.sampler == DDIM(2)
        assert not torch.equal(best(fast, data), before)
        torch.testing.assert_close(best(fast, data), best(actor, data, sampler=DDIM(2)))
        assert torch.equal(fast.module.high, torch.tensor([3.0, 3.0]))
        actor.double()
        assert best(fast, data).dtype == torch.float64

    def test_with_sampler_has_hooks_of_its_own(self):
        actor, data, calls = make(), embeddings(8, 5), []
        fast = actor.with_sampler(DDIM(2))
        fast.register_forward_hook(lambda *_: calls.append(1))
        actor(data.clone())
        assert calls == []
        fast(data.clone())
        assert calls == [1]

    def test_a_deepcopy_has_weights_of_its_own(self):
        actor, data = make(), embeddings(8, 5)
        fast = actor.with_sampler(DDIM(2))
        other, before = copy.deepcopy(fast), best(fast, data)
        for parameter in actor.parameters():
            parameter.data.zero_()
        assert other.module.sampler == DDIM(2)
        assert torch.equal(best(other, data), before)
        assert not torch.equal(best(fast, data), before)

    def test_after_an_encoder(self):
        encoder = TensorDictModule(GraphEncoder(4, 6, 8), [("agents", "observation")], ["embedding"])
        actor, data = make(), TensorDict({("agents", "observation"): torch.randn(8, 5, 4)}, [8])
        policy = TensorDictSequential(encoder, actor)
        fast = TensorDictSequential(encoder, actor.with_sampler(DDIM(2)))
        assert policy.in_keys == [("agents", "observation")]
        torch.testing.assert_close(best(fast, data), best(actor, encoder(data.clone()), sampler=DDIM(2)))
        assert not torch.equal(best(fast, data), best(policy, data))


class TestPrecision:
    @devices
    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
    @pytest.mark.parametrize("sampler", [DDPM(), DDIM(5), DPMSolver(5)])
    def test_half_network_keeps_a_float32_chain(self, device, dtype, sampler):
        spec, data = Bounded(LOW, HIGH, (2,)), embeddings(8, 5).to(device)
        expected = best(make(spec, steps=100, sampler=sampler).to(device), data)
        actor = make(spec, steps=100, sampler=sampler).to(device=device, dtype=dtype)
        assert {parameter.dtype for parameter in actor.parameters()} == {dtype}
        assert {buffer.dtype for buffer in actor.buffers()} == {torch.float32}
        for cast in (data, data.to(dtype)):
            action = best(actor, cast)
            assert action.dtype == torch.float32
            assert ((action >= LOW.to(device)) & (action <= HIGH.to(device))).all()
            change = actor.module.normalize(action) - actor.module.normalize(expected)
            assert change.abs().max() < 0.05
            error = actor.module.action_loss(action, cast["embedding"])
            assert error.dtype == torch.float32
            error.mean().backward()
        torch.testing.assert_close(actor.float().module.low.cpu(), LOW, atol=0, rtol=0)  # nothing was rounded

    def test_a_schedule_that_half_types_cannot_hold(self):
        actor = make(steps=1000, kind="cosine").half()
        assert best(actor, embeddings(8, 5)).isfinite().all()
        torch.testing.assert_close(actor.module.schedule.alphas_cumprod, NoiseSchedule(1000).alphas_cumprod)

    @devices
    def test_double(self, device):
        actor, data = make(sampler=DDIM(5)).to(device), embeddings(8, 5).to(device)
        expected = best(actor, data)
        found = best(actor.double(), data.double())
        assert found.dtype == torch.float64
        torch.testing.assert_close(found.float(), expected, atol=1e-4, rtol=0)

    def test_autocast(self):
        actor, data = make(sampler=DDIM(5)), embeddings(8, 5)
        with torch.autocast("cpu", torch.bfloat16):
            found = best(actor, data)
        assert found.dtype == torch.float32
        assert (found - best(actor, data)).abs().max() < 0.05


class TestWeights:
    def test_bring_the_bounds_along(self):
        first, second = make(Bounded(LOW, HIGH, (2,)), seed=1), make(seed=1)
        second.load_state_dict(first.state_dict())
        data = embeddings(8)
        assert torch.equal(sample(first, data), sample(second, data))

    def test_of_another_schedule(self):
        with pytest.raises(ValueError, match="weights are of another schedule than 'linear' of 10 steps"):
            make().load_state_dict(make(steps=11).state_dict())

    def test_functional_parameters(self):
        actor, other, data = make(), make(), embeddings(8, 5)
        for parameter in other.parameters():
            parameter.data.normal_()
        before, expected = best(actor, data), best(other, data)
        with TensorDict.from_module(other).to_module(actor):
            assert torch.equal(best(actor, data), expected)
        assert torch.equal(best(actor, data), before)

    def test_vmap_over_functional_parameters(self):
        actors, data = [make(), make(), make()], embeddings(8, 5)
        for actor in actors[1:]:
            for parameter in actor.parameters():
                parameter.data.normal_()
        params = torch.stack([TensorDict.from_module(actor).data for actor in actors])
        module = make()

        def call(data, params):
            with params.to_module(module):
                return module(data)["action"]

        with set_exploration_type(ExplorationType.DETERMINISTIC):
            found = torch.vmap(call, (None, 0))(data.clone(), params)
        torch.testing.assert_close(found, torch.stack([best(actor, data) for actor in actors]))
        with set_exploration_type(ExplorationType.RANDOM):
            same = params[:1].expand(2)
            first, second = torch.vmap(call, (None, 0), randomness="different")(data.clone(), same)
        assert not torch.equal(first, second)
