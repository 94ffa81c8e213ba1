import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.modules import DDIM, DDPM, DenoisingMLP, DPMSolver, NoiseSchedule
from redig.modules.diffusion import DiffusionPolicy

LOW, HIGH = torch.tensor([-0.5, 0.0]), torch.tensor([2.0, 0.1])


def make(denoiser=None, steps=10, sampler=None, seed=None, low=LOW, high=HIGH, **options):
    torch.manual_seed(0)
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    denoiser = denoiser or DenoisingMLP(2, 6, hidden=(16,))
    return DiffusionPolicy(denoiser, NoiseSchedule(steps), sampler or DDPM(), low, high, generator, **options)


def deterministic():
    return set_exploration_type(ExplorationType.DETERMINISTIC)


class Watch:
    """A denoiser that keeps what it is given: actions and steps, first call first."""

    def __init__(self):
        self.actions, self.steps = [], []

    def __call__(self, action, step, embedding):
        self.actions.append(action)
        self.steps.append(step.item())
        return 0.5 * action + embedding[..., :2]


def test_scaling_between_the_bounds_and_minus_one_to_one():
    policy = make()
    torch.testing.assert_close(policy.normalize(torch.stack([LOW, HIGH])), torch.tensor([[-1.0, -1.0], [1.0, 1.0]]))
    action = LOW + torch.rand(20, 2) * (HIGH - LOW)
    torch.testing.assert_close(policy.denormalize(policy.normalize(action)), action)
    for beyond in (-2 * torch.ones(2), 2 * torch.ones(2)):  # rounding must not lead out of the bounds
        assert torch.equal(policy.denormalize(beyond), LOW if beyond[0] < 0 else HIGH)


def test_deterministic_chain_starts_from_zero_and_adds_no_noise():
    policy, embedding = make(), torch.randn(8, 5, 6)
    expected = policy.sampler(
        lambda a, k: policy.denoiser(a, torch.tensor(k), embedding),
        torch.zeros(8, 5, 2),
        policy.schedule,
        deterministic=True,
    )
    with deterministic():
        torch.testing.assert_close(policy(embedding), policy.denormalize(expected))


@pytest.mark.parametrize("kind", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_latent_that_is_read_is_where_the_chain_begins(kind):
    watch = Watch()
    policy, embedding, latent = make(watch, sampler=DDIM(5), latent=True), torch.randn(8, 5, 6), torch.randn(8, 5, 2)
    with set_exploration_type(kind):
        first, again = policy(embedding, latent), policy(embedding, latent)
    assert torch.equal(watch.actions[0], latent)
    assert torch.equal(first, again)  # DDIM adds no noise, so nothing is random


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_the_chain_is_in_float32_whatever_the_inputs_are(dtype):
    watch = Watch()
    policy = make(watch, sampler=DDIM(5), latent=True, warm_start=9)
    embedding, latent, previous = torch.zeros(4, 6).to(dtype), torch.ones(4, 2).to(dtype), torch.ones(4, 2).to(dtype)
    action, kept = policy(embedding, latent, previous)
    assert {seen.dtype for seen in (*watch.actions, action, kept)} == {torch.float32}


@pytest.mark.parametrize(("warm_start", "first"), [(9, 9), (8, 7), (7, 7), (6, 5), (1, 1)])
def test_warm_start_begins_with_the_previous_action_noised_to_the_step(warm_start, first):
    watch = Watch()
    policy = make(watch, sampler=DDIM(5), latent=True, warm_start=warm_start)
    embedding, latent, previous = torch.randn(8, 5, 6), torch.randn(8, 5, 2), 2 * torch.rand(8, 5, 2) - 1
    action, kept = policy(embedding, latent, previous)
    alpha = policy.schedule.alphas_cumprod[first]
    torch.testing.assert_close(watch.actions[0], alpha.sqrt() * previous + (1 - alpha).sqrt() * latent)
    assert watch.steps == list(range(first, -1, -2))
    torch.testing.assert_close(policy.normalize(action), kept)
    assert kept.abs().max() <= 1


def test_warm_start_draws_its_noise_or_leaves_it_out():
    watch, previous = Watch(), 2 * torch.rand(4000, 2) - 1
    policy, embedding = make(watch, sampler=DDIM(5), warm_start=5), torch.zeros(4000, 6)
    alpha = policy.schedule.alphas_cumprod[5]
    policy(embedding, previous)
    noise = (watch.actions[0] - alpha.sqrt() * previous) / (1 - alpha).sqrt()
    assert noise.mean().item() == pytest.approx(0, abs=0.05)
    assert noise.std().item() == pytest.approx(1, abs=0.05)
    watch.actions.clear()
    with deterministic():
        first, again = policy(embedding, previous), policy(embedding, previous)
    torch.testing.assert_close(watch.actions[0], alpha.sqrt() * previous)
    assert torch.equal(first[0], again[0])


@pytest.mark.parametrize("sampler", [DDPM(5), DDIM(5), DPMSolver(5)])
def test_a_warm_start_near_the_end_stays_near_the_previous_action(sampler):
    """With a denoiser that sees no noise the chain has only the last steps to leave where it began."""
    previous = torch.full((100, 2), 0.8)
    actions = {}
    for start in (1, 9):
        policy = make(lambda action, *_: torch.zeros_like(action), sampler=sampler, warm_start=start)
        with deterministic():
            actions[start] = policy(torch.zeros(100, 6), previous)[1]
    assert (actions[1] - previous).abs().max() < 0.05


@pytest.mark.parametrize(
    ("sampler", "warm_start", "allowed"),
    [
        (DDIM(5), 0, "1, the lowest step of DDIM.*, to 9"),
        (DDIM(5), 10, "1, the lowest step of DDIM.*, to 9"),
        (DDIM(5), -1, "1, the lowest step of DDIM.*, to 9"),
        (DDPM(early_stop=4), 5, "6, the lowest step of DDPM.*, to 9"),
    ],
)
def test_warm_start_out_of_range(sampler, warm_start, allowed):
    with pytest.raises(ValueError, match=f"warm_start: got {warm_start}, must be from {allowed}"):
        make(sampler=sampler, warm_start=warm_start)
    policy = make(sampler=DDPM(), warm_start=max(0, min(9, warm_start)))
    if policy.warm_start == warm_start:
        with pytest.raises(ValueError, match=f"warm_start: got {warm_start}, must be from {allowed}"):
            policy(torch.zeros(3, 6), torch.zeros(3, 2), sampler=sampler)


def test_action_loss_on_the_same_noise():
    policy, embedding = make(seed=7), torch.randn(8, 5, 6)
    action = LOW + torch.rand(8, 5, 2) * (HIGH - LOW)
    found = policy.action_loss(action, embedding)
    generator = torch.Generator().manual_seed(7)
    step = torch.randint(10, (8, 5), generator=generator)
    noise = torch.randn(8, 5, 2, generator=generator)
    for b in range(8):
        for i in range(5):
            alpha = policy.schedule.alphas_cumprod[step[b, i]]
            clean = 2 * (action[b, i] - LOW) / (HIGH - LOW) - 1
            noisy = alpha.sqrt() * clean + (1 - alpha).sqrt() * noise[b, i]
            predicted = policy.denoiser(noisy, step[b, i], embedding[b, i])
            torch.testing.assert_close(found[b, i], ((predicted - noise[b, i]) ** 2).sum() / 2)


def test_action_loss_covers_every_step_and_vanishes_for_the_right_noise():
    action, seen = LOW + torch.rand(2000, 2) * (HIGH - LOW), []
    clean = 2 * (action - LOW) / (HIGH - LOW) - 1

    def perfect(noisy, step, _):
        seen.append(step)
        alpha = NoiseSchedule(10).alphas_cumprod[step].unsqueeze(-1)
        return (noisy - alpha.sqrt() * clean) / (1 - alpha).sqrt()

    def silent(noisy, *_):
        return torch.zeros_like(noisy)

    assert make(perfect).action_loss(action, clean).max() < 1e-6
    assert torch.bincount(seen[0], minlength=10).min() > 100
    assert seen[0].max() == 9
    assert make(silent).action_loss(action, clean).mean().item() == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("shape", [(8, 5, 3), (8, 4, 2), (5, 2), (8, 5, 1)])
def test_action_loss_of_shapes_that_do_not_fit(shape):
    with pytest.raises(ValueError, match=r"action: got shape .*, expected \[8, 5, 2\] .* shape \[8, 5, 6\]"):
        make().action_loss(torch.zeros(shape), torch.zeros(8, 5, 6))


def test_learns_a_distribution_with_two_modes():
    torch.manual_seed(0)
    policy = make(DenoisingMLP(1, 1, hidden=(128, 128)), 20, low=torch.tensor([-2.0]), high=torch.tensor([1.0]))
    optimizer = torch.optim.Adam(policy.parameters(), 5e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1, 0.02, 800)
    embedding = torch.zeros(512, 1)
    for _ in range(800):
        action = torch.where(torch.rand(512, 1) < 0.3, -1.5, 0.5)
        loss = policy.action_loss(action, embedding).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    for sampler, tolerance in ((DDPM(), 0.06), (DDIM(10), 0.1), (DPMSolver(10), 0.1)):  # one network, any sampler
        with torch.no_grad():
            action = policy(torch.zeros(4000, 1), sampler=sampler)
        left, right = ((action - mode).abs() < 0.3 for mode in (-1.5, 0.5))
        assert (left | right).float().mean() > 0.9
        assert (action < -0.5).float().mean().item() == pytest.approx(0.3, abs=tolerance)
