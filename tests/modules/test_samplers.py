import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.modules import DDIM, DDPM, DPMSolver, NoiseSchedule, Sampler
from redig.modules.schedule import SCHEDULES


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


def samplers(total):
    """Any sampler for a schedule of so many steps."""
    count = st.integers(1, total)
    ddpm = st.builds(DDPM, count, st.floats(0, 3), count)
    return st.one_of(ddpm, st.builds(DDIM, count, st.floats(0, 1)), st.builds(DPMSolver, count))


@settings(deadline=None)
@given(st.sampled_from(SCHEDULES), st.integers(1, 30), st.booleans(), st.integers(0, 2**31), st.data())
def test_actions_stay_in_range(kind, total, deterministic, seed, data):
    sampler = data.draw(samplers(total))
    generator = torch.Generator().manual_seed(seed)
    latent = 5 * torch.randn(4, 3, 2, generator=generator)
    action = sampler(lambda a, k: 10 * wild(a, k), latent, NoiseSchedule(total, kind), generator, deterministic)
    assert action.shape == latent.shape
    assert action.abs().max() <= 1


@pytest.mark.parametrize(
    ("sampler", "deterministic"),
    [
        (DDPM(), True),
        (DDPM(noise_ratio=0.0), False),
        (DDIM(eta=1.0), True),
        (DDIM(), False),
        (DPMSolver(), False),
        (DPMSolver(), True),
    ],
)
def test_chain_without_noise_draws_none(sampler, deterministic):
    latent, schedule = torch.randn(4, 2), NoiseSchedule(20)
    generator = torch.Generator().manual_seed(3)
    before, before_global = generator.get_state(), torch.get_rng_state()
    first = sampler(wild, latent, schedule, generator, deterministic)
    assert torch.equal(generator.get_state(), before)
    assert torch.equal(torch.get_rng_state(), before_global)
    assert torch.equal(first, sampler(wild, latent, schedule, None, deterministic))


@pytest.mark.parametrize("sampler", [DDPM(), DDIM(eta=0.5)])
def test_noise_comes_from_the_generator(sampler):
    latent, schedule = torch.randn(4, 2), NoiseSchedule(20)
    before = torch.get_rng_state()
    first, second, third = (sampler(wild, latent, schedule, torch.Generator().manual_seed(seed)) for seed in (0, 0, 1))
    assert torch.equal(first, second)
    assert not torch.equal(first, third)
    assert torch.equal(torch.get_rng_state(), before)


def test_ddim_with_eta_1_is_ddpm():
    latent, schedule = torch.randn(4, 2, dtype=torch.float64), NoiseSchedule(20)
    chains = [sampler(wild, latent, schedule, torch.Generator().manual_seed(0)) for sampler in (DDPM(7), DDIM(7, 1.0))]
    torch.testing.assert_close(*chains)


@pytest.mark.parametrize("sampler", [DDPM(5), DDIM(5, 0.5), DPMSolver(5)])
def test_start_leaves_out_the_steps_above(sampler):
    latent, schedule, denoise = torch.randn(4, 2), NoiseSchedule(20), Calls()
    sampler(denoise, latent, schedule, start=11)
    assert denoise.steps == [11, 7, 3]
    with pytest.raises(ValueError, match="start: got 2, the chain's lowest step is 3"):
        sampler(denoise, latent, schedule, start=2)


def test_a_started_chain_is_the_rest_of_the_whole_one():
    schedule, seen = NoiseSchedule(20), {}

    def watch(action, step):
        seen[step] = action
        return wild(action, step)

    whole = DDIM(5)(watch, torch.randn(4, 2), schedule)
    torch.testing.assert_close(DDIM(5)(wild, seen[11], schedule, start=11), whole)


@pytest.mark.parametrize("sampler", [DDPM(5), DDIM(5), DPMSolver(5)])
def test_latent_is_left_alone(sampler):
    latent = torch.randn(4, 2)
    copy = latent.clone()
    sampler(wild, latent, NoiseSchedule(20))
    assert torch.equal(latent, copy)


@pytest.mark.parametrize("sampler", [DDPM(), DDIM(5, 0.5), DPMSolver(5)])
def test_vmap_over_latents(sampler):
    torch.manual_seed(0)
    latent, schedule = torch.randn(3, 4, 2), NoiseSchedule(20, "linear")

    def chain(latent):
        return sampler(wild, latent, schedule, deterministic=True)

    torch.testing.assert_close(torch.vmap(chain)(latent), chain(latent))
    noisy = torch.vmap(lambda latent: sampler(wild, latent, schedule), randomness="different")(
        latent[:1].expand(2, 4, 2)
    )
    assert torch.equal(noisy[0], noisy[1]) == isinstance(sampler, DPMSolver)


def test_a_sampler_of_ones_own():
    """First-order steps in the other direction of the formulas: the noise, not the estimate, is kept."""

    class Euler(Sampler):
        def coefficients(self, schedule, step, previous, older, deterministic):
            alpha, alpha_previous = schedule.signal(step), schedule.signal(previous)
            sigma, sigma_previous = ((1 - a) ** 0.5 for a in (alpha, alpha_previous))
            # a^previous = sqrt(alpha_previous) a0 + sigma_previous eps with eps = (a - sqrt(alpha) a0) / sigma
            return alpha_previous**0.5 - sigma_previous * alpha**0.5 / sigma, sigma_previous / sigma, 0.0, 0.0

    latent, schedule = torch.randn(4, 2), NoiseSchedule(20)
    torch.testing.assert_close(Euler(6)(wild, latent, schedule), DDIM(6)(wild, latent, schedule))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: DDPM(num_steps=0), "num_steps: got 0, must be at least 1"),
        (lambda: DDIM(num_steps=-5), "num_steps: got -5, must be at least 1"),
        (lambda: DPMSolver(num_steps=-1), "num_steps: got -1, must be at least 1"),
        (lambda: DDPM(early_stop=0), "early_stop: got 0, must be at least 1"),
        (lambda: DDPM(early_stop=-3), "early_stop: got -3"),
        (lambda: DDPM(noise_ratio=-0.1), "noise_ratio: got -0.1, must be at least 0"),
        (lambda: DDPM(noise_ratio=math.nan), "noise_ratio: got nan"),
        (lambda: DDIM(eta=-0.1), r"eta: got -0.1, must be in \[0, 1\]"),
        (lambda: DDIM(eta=1.1), r"eta: got 1.1, must be in \[0, 1\]"),
    ],
)
def test_bad_arguments(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize("sampler", [DDPM(21), DDIM(21), DPMSolver(21)])
def test_more_steps_than_the_schedule_has(sampler):
    with pytest.raises(ValueError, match="num_steps: the sampler asks for 21 steps, the schedule has 20"):
        sampler(wild, torch.randn(1, 2), NoiseSchedule(20))


@pytest.mark.parametrize("sampler", [DDPM(5), DDIM(5), DPMSolver(5)])
def test_half_precision_in_which_the_schedule_underflows(sampler):
    latent = torch.randn(4, 2)
    with pytest.raises(ValueError, match=r"latent: torch.float16 cannot hold sqrt\(alphas_cumprod\[999\]\) = 4.9e-05"):
        sampler(wild, latent.half(), NoiseSchedule(1000, "cosine"))
    for fits in (latent.half(), latent.bfloat16()):
        assert sampler(wild, fits, NoiseSchedule(100, "cosine")).isfinite().all()
    assert sampler(wild, latent.bfloat16(), NoiseSchedule(1000, "cosine")).isfinite().all()
