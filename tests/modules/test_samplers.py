import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.modules import DDPM, NoiseSchedule
from redig.modules.schedule import SCHEDULES


def exact(schedule, expected_clean):
    """The denoiser that knows the data: eps from E[a0 | a^k], which ``expected_clean(a^k, alpha)`` gives."""

    def denoise(action, step):
        alpha = torch.tensor(schedule.signal(step), dtype=action.dtype)
        return (action - alpha.sqrt() * expected_clean(action, alpha)) / (1 - alpha).sqrt()

    return denoise


def wild(action, step):
    """A denoiser that fits no data but uses all of its inputs."""
    return torch.sin(3 * action + step) + 0.5 * action.flip(-1)


class Calls:
    """Counts the calls of a denoiser and remembers the steps."""

    def __init__(self):
        self.steps = []

    def __call__(self, action, step):
        self.steps.append(step)
        return wild(action, step)


@pytest.mark.parametrize("kind", SCHEDULES)
@pytest.mark.parametrize("sampler", [DDPM(), DDPM(num_steps=5), DDPM(noise_ratio=0), DDPM(early_stop=60), DDPM(1)])
def test_point_mass_is_recovered(kind, sampler):
    torch.manual_seed(0)
    schedule, point = NoiseSchedule(100, kind).double(), torch.tensor([0.3, -0.9], dtype=torch.float64)
    denoise = exact(schedule, lambda action, alpha: point.expand_as(action))
    action = sampler(denoise, torch.randn(50, 2, dtype=torch.float64), schedule)
    torch.testing.assert_close(action, point.expand_as(action), atol=1e-6, rtol=0)


def test_mixture_of_two_points_is_recovered():
    torch.manual_seed(0)
    schedule, points, weights = NoiseSchedule(100, "cosine"), torch.tensor([-0.5, 0.5]), torch.tensor([0.2, 0.8])

    def expected_clean(action, alpha):
        likelihood = -((action.unsqueeze(-1) - alpha.sqrt() * points) ** 2) / (2 * (1 - alpha))
        return (torch.softmax(likelihood + weights.log(), -1) * points).sum(-1)

    action = DDPM()(exact(schedule, expected_clean), torch.randn(20_000, 1), schedule)
    assert ((action.abs() - 0.5).abs() < 0.02).float().mean() > 0.99
    assert (action < 0).float().mean().item() == pytest.approx(0.2, abs=0.03)


def test_gaussian_is_recovered():
    torch.manual_seed(0)
    schedule, mean, std = NoiseSchedule(200, "cosine"), 0.2, 0.15

    def expected_clean(action, alpha):
        gain = std**2 * alpha.sqrt() / (std**2 * alpha + 1 - alpha)
        return mean + gain * (action - alpha.sqrt() * mean)

    action = DDPM()(exact(schedule, expected_clean), torch.randn(50_000, 1), schedule)
    assert action.mean().item() == pytest.approx(mean, abs=0.005)
    assert action.std().item() == pytest.approx(std, rel=0.05)


def reference(sampler, schedule, latent, noise, deterministic):
    """The chain number by number, with the posterior from precisions instead of Eq. 7's coefficients."""
    total = schedule.num_steps
    count = sampler.num_steps or total
    chain = [math.ceil(total * (i + 1) / count) - 1 for i in range(count)][::-1]
    calls = min(sampler.early_stop or count, count)
    alphas = [schedule.signal(step) for step in range(total)]
    result = torch.empty_like(latent)
    for row in range(latent.shape[0]):
        action = latent[row].tolist()
        for i, step in enumerate(chain[:calls]):
            predicted = wild(torch.tensor(action, dtype=torch.float64), step).tolist()
            for d in range(latent.shape[1]):
                clean = (action[d] - math.sqrt(1 - alphas[step]) * predicted[d]) / math.sqrt(alphas[step])
                clean = max(-1.0, min(1.0, clean))
                if i == calls - 1:
                    action[d] = clean
                    continue
                prior = alphas[chain[i + 1]]
                ratio = alphas[step] / prior
                precision = 1 / (1 - prior) + ratio / (1 - ratio)
                mean = math.sqrt(prior) * clean / (1 - prior) + math.sqrt(ratio) * action[d] / (1 - ratio)
                scale = 0.0 if deterministic else sampler.noise_ratio
                action[d] = mean / precision + scale * noise[i][row, d].item() / math.sqrt(precision)
        result[row] = torch.tensor(action, dtype=torch.float64)
    return result


@pytest.mark.parametrize("kind", SCHEDULES)
@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize(
    "sampler", [DDPM(), DDPM(7), DDPM(20, 0.5), DDPM(20, 1.0, 12), DDPM(noise_ratio=0.0), DDPM(6, 1, 9)]
)
def test_chain_equals_a_plain_loop(kind, sampler, deterministic):
    schedule = NoiseSchedule(20, kind).double()
    latent = torch.randn(5, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    generator = torch.Generator().manual_seed(2)
    noise = [torch.empty_like(latent).normal_(generator=generator) for _ in range(20)]
    found = sampler(wild, latent, schedule, torch.Generator().manual_seed(2), deterministic)
    torch.testing.assert_close(found, reference(sampler, schedule, latent, noise, deterministic), atol=1e-6, rtol=0)


@pytest.mark.parametrize(("early_stop", "calls"), [(1, 1), (60, 60), (100, 100), (500, 100), (None, 100)])
def test_early_stop_counts_denoiser_calls(early_stop, calls):
    denoise = Calls()
    DDPM(early_stop=early_stop)(denoise, torch.randn(3, 2), NoiseSchedule(100))
    assert denoise.steps == list(range(99, 99 - calls, -1))


@pytest.mark.parametrize(
    ("total", "count", "expected"),
    [
        (100, 5, [99, 79, 59, 39, 19]),
        (100, 1, [99]),
        (10, 10, list(range(9, -1, -1))),
        (10, None, list(range(9, -1, -1))),
        (10, 3, [9, 6, 3]),
        (1, 1, [0]),
    ],
)
def test_strided_timesteps(total, count, expected):
    denoise = Calls()
    DDPM(num_steps=count)(denoise, torch.randn(3, 2), NoiseSchedule(total))
    assert denoise.steps == expected


@settings(deadline=None)
@given(st.integers(1, 300), st.data())
def test_timesteps_start_at_the_noisiest_and_are_evenly_spread(total, data):
    count = data.draw(st.integers(1, total))
    steps = DDPM(num_steps=count).timesteps(NoiseSchedule(total))
    assert len(steps) == count
    assert steps[0] == total - 1
    assert steps[-1] >= 0
    assert {a - b for a, b in zip([*steps, -1], [*steps[1:], -1, -1], strict=True)} - {0} <= {
        total // count,
        -(-total // count),
    }


@settings(deadline=None)
@given(st.sampled_from(SCHEDULES), st.integers(1, 30), st.floats(0, 3), st.booleans(), st.integers(0, 2**31), st.data())
def test_actions_stay_in_range(kind, total, noise_ratio, deterministic, seed, data):
    sampler = DDPM(data.draw(st.integers(1, total)), noise_ratio, data.draw(st.integers(1, total)))
    generator = torch.Generator().manual_seed(seed)
    latent = 5 * torch.randn(4, 3, 2, generator=generator)
    action = sampler(lambda a, k: 10 * wild(a, k), latent, NoiseSchedule(total, kind), generator, deterministic)
    assert action.shape == latent.shape
    assert action.abs().max() <= 1


@pytest.mark.parametrize(("noise_ratio", "deterministic"), [(1.0, True), (0.0, False), (0.0, True)])
def test_chain_without_noise_draws_none(noise_ratio, deterministic):
    latent, schedule, sampler = torch.randn(4, 2), NoiseSchedule(20), DDPM(noise_ratio=noise_ratio)
    generator = torch.Generator().manual_seed(3)
    before, before_global = generator.get_state(), torch.get_rng_state()
    first = sampler(wild, latent, schedule, generator, deterministic)
    assert torch.equal(generator.get_state(), before)
    assert torch.equal(torch.get_rng_state(), before_global)
    assert torch.equal(first, sampler(wild, latent, schedule, None, deterministic))


def test_noise_comes_from_the_generator():
    latent, schedule = torch.randn(4, 2), NoiseSchedule(20)
    before = torch.get_rng_state()
    first, second, third = (DDPM()(wild, latent, schedule, torch.Generator().manual_seed(seed)) for seed in (0, 0, 1))
    assert torch.equal(first, second)
    assert not torch.equal(first, third)
    assert torch.equal(torch.get_rng_state(), before)


def test_latent_is_left_alone():
    latent = torch.randn(4, 2)
    copy = latent.clone()
    DDPM(5)(wild, latent, NoiseSchedule(20))
    assert torch.equal(latent, copy)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_steps": 0}, "num_steps: got 0, must be at least 1"),
        ({"early_stop": 0}, "early_stop: got 0, must be at least 1"),
        ({"early_stop": -3}, "early_stop: got -3"),
        ({"noise_ratio": -0.1}, "noise_ratio: got -0.1, must be at least 0"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        DDPM(**arguments)


def test_more_steps_than_the_schedule_has():
    with pytest.raises(ValueError, match="asks for 21 steps, the schedule has 20"):
        DDPM(num_steps=21)(wild, torch.randn(1, 2), NoiseSchedule(20))
