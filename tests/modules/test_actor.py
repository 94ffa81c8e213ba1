import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.modules import DDPM, DenoisingMLP, DiffusionActor, NoiseSchedule

LOW, HIGH = torch.tensor([-0.5, 0.0]), torch.tensor([2.0, 0.1])


def make(spec=None, seed=None, denoiser=None, steps=10, sampler=None, **keys):
    torch.manual_seed(0)
    keys = {"in_keys": ["embedding"], "out_keys": ["action"], **keys}
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    denoiser = denoiser or DenoisingMLP(2, 6, hidden=(16,))
    spec = Bounded(-1, 1, (5, 2)) if spec is None else spec
    return DiffusionActor(denoiser, spec, schedule=NoiseSchedule(steps), sampler=sampler, generator=generator, **keys)


def embeddings(*batch, width=6):
    return TensorDict({"embedding": torch.randn(*batch, width)}, batch[:1])


def sample(actor, data, kind=ExplorationType.RANDOM):
    with set_exploration_type(kind):
        return actor(data.clone())["action"]


def test_exploration_type_decides_about_randomness():
    actor, data = make(), embeddings(8, 5)
    assert not torch.equal(sample(actor, data), sample(actor, data))
    for kind in (ExplorationType.DETERMINISTIC, ExplorationType.MEAN, ExplorationType.MODE):
        before = torch.get_rng_state()
        assert torch.equal(sample(actor, data, kind), sample(actor, data, kind))
        assert torch.equal(torch.get_rng_state(), before)


def test_none_set_means_random():
    actor, data = make(), embeddings(8, 5)
    with set_exploration_type(None):
        assert not torch.equal(actor(data.clone())["action"], actor(data.clone())["action"])


def test_deterministic_chain_starts_from_zero():
    actor, data = make(), embeddings(8, 5)
    policy = actor.module
    latent = torch.zeros(8, 5, 2)
    expected = policy.sampler(
        lambda a, k: policy.denoiser(a, torch.tensor(k), data["embedding"]), latent, policy.schedule, deterministic=True
    )
    torch.testing.assert_close(sample(actor, data, ExplorationType.DETERMINISTIC), expected)


@settings(deadline=None)
@given(seed=st.integers(0, 2**31), scale=st.floats(0, 1000), kind=st.sampled_from([*ExplorationType]))
def test_untrained_actor_never_leaves_the_bounds(seed, scale, kind):
    actor, data = make(Bounded(LOW, HIGH, (2,)), seed=seed), embeddings(16)
    for parameter in actor.parameters():
        parameter.data.mul_(scale)
    action = sample(actor, data, kind)
    assert (action >= LOW).all()
    assert (action <= HIGH).all()


def test_both_ends_of_asymmetrical_bounds_are_reached():
    for sign, end in ((1, LOW), (-1, HIGH)):
        actor = make(
            Bounded(LOW, HIGH, (2,)), denoiser=lambda action, *_, sign=sign: sign * 1e6 * torch.ones_like(action)
        )
        torch.testing.assert_close(sample(actor, embeddings(4)), end.expand(4, 2))


def test_bounds_follow_the_spec_of_the_team():
    spec = Bounded(LOW.expand(5, 2), HIGH.expand(5, 2), (5, 2))
    policy = make(spec).module
    assert torch.equal(policy.low, LOW)
    assert torch.equal(policy.high, HIGH)
    torch.testing.assert_close(policy.normalize(torch.stack([LOW, HIGH])), torch.tensor([[-1.0, -1.0], [1.0, 1.0]]))
    action = LOW + torch.rand(20, 2) * (HIGH - LOW)
    torch.testing.assert_close(policy.denormalize(policy.normalize(action)), action)


def test_nested_keys_and_composite_spec():
    spec = Composite(
        agents=Composite(action=Bounded(LOW.expand(3, 5, 2), HIGH.expand(3, 5, 2), (3, 5, 2)), shape=(3,)), shape=(3,)
    )
    actor = make(spec, in_keys=[("agents", "deep", "embedding")], out_keys=[("agents", "action")])
    data = actor(TensorDict({"agents": {"deep": {"embedding": torch.randn(3, 5, 6)}}}, [3]))
    assert data["agents", "action"].shape == (3, 5, 2)
    assert spec.is_in(data.select(("agents", "action")))


def test_several_embeddings_are_concatenated():
    both = torch.randn(8, 5, 6)
    split = TensorDict({"first": both[..., :2], ("agents", "second"): both[..., 2:]}, [8])
    together, apart = make(seed=1), make(seed=1, in_keys=["first", ("agents", "second")])
    apart.load_state_dict(together.state_dict())
    expected = sample(together, TensorDict({"embedding": both}, [8]))
    assert torch.equal(sample(apart, split), expected)
    action = torch.rand(8, 5, 2)
    found = apart.module.denoising_error(action, both[..., :2], both[..., 2:])
    assert torch.equal(found, together.module.denoising_error(action, both))


@pytest.mark.parametrize("batch", [(3,), (3, 5), (3, 4, 5)])
def test_batch_shapes(batch):
    actor, data = make(Bounded(-1, 1, (2,))), embeddings(*batch)
    assert sample(actor, data).shape == (*batch, 2)
    assert actor.module.denoising_error(torch.zeros(*batch, 2), data["embedding"]).shape == batch
    rows = TensorDict({"embedding": data["embedding"].reshape(-1, 6)}, [data["embedding"].numel() // 6])
    alone = sample(actor, rows, ExplorationType.DETERMINISTIC)
    torch.testing.assert_close(sample(actor, data, ExplorationType.DETERMINISTIC).reshape(-1, 2), alone)


def test_seeded_generator_is_independent_of_the_global_one():
    data = embeddings(8, 5)
    actors = [make(seed=seed) for seed in (3, 3, 4)]
    torch.manual_seed(11)
    before = torch.get_rng_state()
    first = sample(actors[0], data), actors[0].module.denoising_error(torch.zeros(8, 5, 2), data["embedding"])
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(12)
    second = sample(actors[1], data), actors[1].module.denoising_error(torch.zeros(8, 5, 2), data["embedding"])
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])
    assert not torch.equal(first[0], sample(actors[2], data))


def test_without_a_generator_the_global_one_is_used():
    actor, data = make(), embeddings(8, 5)
    torch.manual_seed(5)
    first = sample(actor, data)
    torch.manual_seed(5)
    assert torch.equal(sample(actor, data), first)


def test_denoising_error_on_the_same_noise():
    actor, data = make(Bounded(LOW, HIGH, (2,)), seed=7), embeddings(8, 5)
    action, policy = LOW + torch.rand(8, 5, 2) * (HIGH - LOW), actor.module
    found = policy.denoising_error(action, data["embedding"])
    generator = torch.Generator().manual_seed(7)
    step = torch.randint(10, (8, 5), generator=generator)
    noise = torch.empty(8, 5, 2).normal_(generator=generator)
    for b in range(8):
        for i in range(5):
            alpha = policy.schedule.alphas_cumprod[step[b, i]]
            clean = 2 * (action[b, i] - LOW) / (HIGH - LOW) - 1
            noisy = alpha.sqrt() * clean + (1 - alpha).sqrt() * noise[b, i]
            predicted = policy.denoiser(noisy, step[b, i], data["embedding"][b, i])
            torch.testing.assert_close(found[b, i], ((predicted - noise[b, i]) ** 2).sum() / 2)


def test_denoising_error_covers_every_step_and_vanishes_for_the_right_noise():
    action, seen = LOW + torch.rand(2000, 2) * (HIGH - LOW), []
    clean = 2 * (action - LOW) / (HIGH - LOW) - 1

    def perfect(noisy, step, _):
        seen.append(step)
        alpha = NoiseSchedule(10).alphas_cumprod[step].unsqueeze(-1)
        return (noisy - alpha.sqrt() * clean) / (1 - alpha).sqrt()

    def silent(noisy, *_):
        return torch.zeros_like(noisy)

    spec = Bounded(LOW, HIGH, (2,))
    assert make(spec, denoiser=perfect).module.denoising_error(action, clean).max() < 1e-6
    assert torch.bincount(seen[0], minlength=10).min() > 100
    assert seen[0].max() == 9
    assert make(spec, denoiser=silent).module.denoising_error(action, clean).mean().item() == pytest.approx(1, abs=0.1)


def test_learns_a_distribution_with_two_modes():
    torch.manual_seed(0)
    denoiser = DenoisingMLP(1, 1, hidden=(128, 128))
    actor = make(Bounded(-2.0, 1.0, (1,)), denoiser=denoiser, steps=20)
    optimizer = torch.optim.Adam(actor.parameters(), 5e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1, 0.02, 800)
    embedding = torch.zeros(512, 1)
    for _ in range(800):
        action = torch.where(torch.rand(512, 1) < 0.3, -1.5, 0.5)
        loss = actor.module.denoising_error(action, embedding).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        action = sample(actor, TensorDict({"embedding": torch.zeros(4000, 1)}, [4000]))
    left, right = ((action - mode).abs() < 0.3 for mode in (-1.5, 0.5))
    assert (left | right).float().mean() > 0.9
    assert (action < -0.5).float().mean().item() == pytest.approx(0.3, abs=0.06)


def test_saved_weights_bring_the_bounds_along():
    first, second = make(Bounded(LOW, HIGH, (2,)), seed=1), make(seed=1)
    second.load_state_dict(first.state_dict())
    data = embeddings(8)
    assert torch.equal(sample(first, data), sample(second, data))


@pytest.mark.parametrize("spec", [Unbounded((5, 2)), Bounded(-torch.inf, 1, (5, 2))])
def test_spec_without_bounds(spec):
    with pytest.raises(ValueError, match=r"action_spec: got .* without finite bounds"):
        make(spec)


def test_bounds_that_differ_between_robots():
    spec = Bounded(-torch.ones(2, 2), torch.tensor([[1.0, 1.0], [1.0, 2.0]]), (2, 2))
    with pytest.raises(ValueError, match="action_spec: the bounds differ between robots"):
        make(spec)


def test_sampler_that_does_not_fit_the_schedule():
    with pytest.raises(ValueError, match="asks for 11 steps, the schedule has 10"):
        make(sampler=DDPM(11))
