import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn
from torch.distributions import MultivariateNormal, Normal, kl_divergence
from torchrl.data import Bounded

from redig.evaluation import (
    discretization_error,
    discretization_term,
    matching_divergence,
    matching_error,
    prior_mismatch,
    prior_mismatch_floor,
)
from redig.modules import DDIM, DDPM, DiffusionActor, NoiseSchedule
from redig.modules.schedule import SCHEDULES

MODES, MASSES, WIDTH = (0.8, -0.8), (0.8, 0.2), 0.05  # a two-mode action, as in passing left or right


class ExactNoise(nn.Module):
    """E[eps | a^k] where the clean action is ``embedding + std * standard normal``; std = 0 is a point mass."""

    def __init__(self, schedule, std):
        super().__init__()
        self.schedule, self.std = schedule, std

    def forward(self, action, step, embedding):
        alpha = self.schedule.alphas_cumprod[step]
        alpha = alpha.unsqueeze(-1) if alpha.ndim else alpha
        return (1 - alpha).sqrt() * (action - alpha.sqrt() * embedding) / (alpha * self.std**2 + 1 - alpha)


def gaussian_actor(schedule, std, bound=1.0, **kwargs):
    spec = Bounded(-bound, bound, (2,))
    return DiffusionActor(ExactNoise(schedule, std), spec, ["embedding"], ["action"], schedule, **kwargs)


def gaussian_data(count, std, bound=1.0):
    mean = torch.rand(count, 2) - 0.5
    return TensorDict({"embedding": mean, "action": bound * (mean + std * torch.randn(count, 2))}, [count])


def two_modes(schedule):
    """Exact noise prediction for the mixture ``sum_i MASSES[i] N(MODES[i], WIDTH^2)`` of one-dimensional actions."""

    def denoise(action, step):
        alpha = schedule.alphas_cumprod[step]
        variance = alpha * WIDTH**2 + 1 - alpha
        off = action - alpha.sqrt() * torch.tensor(MODES)
        share = torch.softmax(torch.tensor(MASSES).log() - off.square() / (2 * variance), -1)
        return (1 - alpha).sqrt() * (share * off).sum(-1, keepdim=True) / variance

    return denoise


# --- prior mismatch


@settings(deadline=None, max_examples=50)
@given(st.sampled_from(SCHEDULES), st.integers(1, 200), st.lists(st.floats(-1, 1), min_size=1, max_size=4))
def test_prior_mismatch_is_the_divergence_of_torch_distributions(kind, num_steps, action):
    schedule, action = NoiseSchedule(num_steps, kind), torch.tensor(action, dtype=torch.float64)
    alpha = torch.tensor(schedule.signal(num_steps - 1), dtype=torch.float64)  # 1 - alpha has digits to lose
    expected = kl_divergence(Normal(alpha.sqrt() * action, (1 - alpha).sqrt()), Normal(0.0, 1.0)).sum()
    assert prior_mismatch(schedule, action).item() == pytest.approx(expected.item(), rel=1e-6, abs=1e-12)


def test_prior_mismatch_keeps_batch_and_type():
    found = prior_mismatch(NoiseSchedule(10), torch.zeros(3, 5, 2))
    assert found.shape == (3, 5)
    assert found.dtype == torch.float32


def test_floor_is_the_divergence_of_the_moment_matched_gaussian():
    torch.manual_seed(0)
    schedule, action = NoiseSchedule(100, "linear"), torch.rand(40, 5, 3, dtype=torch.float64) ** 2
    alpha = schedule.alphas_cumprod[-1].double()
    flat = action.flatten(0, 1)
    covariance = alpha * torch.cov(flat.T, correction=0) + (1 - alpha) * torch.eye(3, dtype=flat.dtype)
    prior = MultivariateNormal(torch.zeros(3, dtype=flat.dtype), torch.eye(3, dtype=flat.dtype))
    expected = kl_divergence(MultivariateNormal(alpha.sqrt() * flat.mean(0), covariance), prior)
    assert prior_mismatch_floor(schedule, action).item() == pytest.approx(expected.item(), rel=1e-6)


@pytest.mark.parametrize("num_steps", [20, 100, 400])
def test_both_bounds_enclose_the_divergence_of_the_mixture(num_steps):
    schedule, action = NoiseSchedule(num_steps, "linear"), torch.tensor([[0.9], [0.4], [-0.8]], dtype=torch.float64)
    alpha = schedule.alphas_cumprod[-1].double()
    x = torch.linspace(-9, 9, 60_001, dtype=torch.float64)
    density = Normal(alpha.sqrt() * action, (1 - alpha).sqrt()).log_prob(x).exp().mean(0)  # q(a^K)
    divergence = torch.trapezoid(density * (density.log() - Normal(0.0, 1.0).log_prob(x)), x).item()
    low, high = prior_mismatch_floor(schedule, action).item(), prior_mismatch(schedule, action).mean().item()
    assert low <= divergence <= high
    assert low > 0.03 * high  # neither is empty


def test_bounds_meet_where_there_is_one_action():
    schedule, action = NoiseSchedule(50, "vp"), torch.tensor([0.3, -0.6], dtype=torch.float64).expand(7, 2)
    assert prior_mismatch_floor(schedule, action).item() == pytest.approx(prior_mismatch(schedule, action)[0].item())


@pytest.mark.parametrize(("num_steps", "nats"), [(20, 1.70), (100, 0.45)])
def test_linear_schedules_show_a_mismatch_that_cosine_has_not(num_steps, nats):
    corner = torch.ones(2)
    assert prior_mismatch(NoiseSchedule(num_steps, "linear"), corner).item() == pytest.approx(nats, abs=0.01)
    assert prior_mismatch(NoiseSchedule(num_steps, "cosine"), corner).item() < 1e-4


@pytest.mark.parametrize(
    ("kind", "num_steps", "mass"), [("cosine", 100, 0.80), ("linear", 100, 0.729), ("linear", 20, 0.569)]
)
def test_the_mismatch_is_a_bias_of_what_is_sampled(kind, num_steps, mass):
    """With the exact score, the chain gives the first mode the mass that the wrong prior leaves it."""
    schedule, count = NoiseSchedule(num_steps, kind), 40_000
    generator = torch.Generator().manual_seed(0)
    latent = torch.randn(count, 1, generator=generator)
    sampled = (DDPM()(two_modes(schedule), latent, schedule, generator) > 0).float().mean().item()
    # a continuous chain from N(0, 1) would keep E_z[P(first mode | a^K = z)], by quadrature
    alpha = schedule.alphas_cumprod[-1].item()
    z = torch.linspace(-8, 8, 20_001, dtype=torch.float64)
    shares = [
        m * Normal(math.sqrt(alpha) * a, math.sqrt(1 - alpha)).log_prob(z).exp()
        for m, a in zip(MASSES, MODES, strict=True)
    ]
    kept = torch.trapezoid(shares[0] / sum(shares) * Normal(0.0, 1.0).log_prob(z).exp(), z).item()
    assert kept == pytest.approx(mass, abs=2e-3)
    # four standard errors of the count, sqrt(0.25 / 40,000) = 0.0025, cover what 100 steps discretise away too
    assert sampled == pytest.approx(kept, abs=0.01)
    # data processing: no chain loses more than the mismatch of its start
    lost = sum(p * math.log(p / q) for p, q in zip((0.8, 0.2), (kept, 1 - kept), strict=True))
    actions = torch.tensor(MODES, dtype=torch.float64).unsqueeze(-1)
    mismatch = (torch.tensor(MASSES) * prior_mismatch(schedule, actions)).sum().item()
    assert lost <= mismatch + 1e-9


# --- matching error


@pytest.mark.parametrize("kind", SCHEDULES)
@pytest.mark.parametrize("bound", [1.0, 2.5])
def test_an_exact_denoiser_leaves_the_conditional_variance_of_the_noise(kind, bound):
    torch.manual_seed(0)
    schedule, std = NoiseSchedule(25, kind), 0.4
    error = matching_error(gaussian_actor(schedule, std, bound), gaussian_data(20_000, std, bound))
    alpha = schedule.alphas_cumprod
    expected = 2 * alpha * std**2 / (alpha * std**2 + 1 - alpha)  # two dimensions
    # the mean of 40,000 squares of Gaussians has a relative standard error of sqrt(2 / 40,000) = 0.7 %
    torch.testing.assert_close(error, expected, rtol=0.03, atol=1e-6)


def test_matching_error_of_a_point_mass_is_zero():
    schedule = NoiseSchedule(100)
    error = matching_error(gaussian_actor(schedule, 0.0), gaussian_data(500, 0.0))
    assert error.shape == (100,)
    # 1 - alpha of the first steps has lost digits in float32
    torch.testing.assert_close(error, torch.zeros(100), atol=1e-5, rtol=0)


def test_matching_error_finds_the_step_that_was_not_learned():
    class Forgets(ExactNoise):
        def forward(self, action, step, embedding):
            return super().forward(action, step, embedding) + 3.0 * (step == 7).unsqueeze(-1)

    schedule = NoiseSchedule(20)
    actor = DiffusionActor(Forgets(schedule, 0.0), Bounded(-1, 1, (2,)), ["embedding"], ["other"], schedule)
    error = matching_error(actor, gaussian_data(100, 0.0), action="action")
    assert error.argmax().item() == 7
    assert error[7].item() == pytest.approx(18.0, rel=1e-3)  # 3^2 in each of two dimensions


def test_equal_generators_give_equal_noise_and_spare_the_global_one():
    schedule, data = NoiseSchedule(5), gaussian_data(50, 0.3)
    before = torch.get_rng_state()
    first, second = (
        matching_error(gaussian_actor(schedule, 0.3), data, generator=torch.Generator().manual_seed(1)) for _ in "ab"
    )
    assert first.equal(second)
    assert before.equal(torch.get_rng_state())


class WrongBy(ExactNoise):
    """Exact for a point mass, but for a constant error."""

    def __init__(self, schedule, error):
        super().__init__(schedule, 0.0)
        self.error = error

    def forward(self, action, step, embedding):
        return super().forward(action, step, embedding) + self.error


@pytest.mark.parametrize("kind", SCHEDULES)
def test_divergence_is_that_of_the_two_posteriors(kind):
    """A denoiser that is wrong by a known amount; the posteriors of Eq. 7, compared by torch.distributions."""
    schedule, wrong = NoiseSchedule(30, kind), 1e-3  # so little that no estimate reaches the clamp
    actor = DiffusionActor(WrongBy(schedule, wrong), Bounded(-1, 1, (2,)), ["embedding"], ["action"], schedule)
    found = matching_divergence(
        actor, TensorDict({"embedding": torch.zeros(10, 2), "action": torch.zeros(10, 2)}, [10])
    )
    assert found.isfinite().all()
    assert found[0] > 0
    alphas = torch.tensor([1.0, *(schedule.signal(k) for k in range(30))], dtype=torch.float64)
    for k in range(2, 31):  # as in the paper, from 1
        beta, ratio = 1 - alphas[k] / alphas[k - 1], (1 - alphas[k - 1]) / (1 - alphas[k])
        clean, noise = 0.3, -0.7
        noisy = alphas[k].sqrt() * clean + (1 - alphas[k]).sqrt() * noise
        predicted = (noisy - (1 - alphas[k]).sqrt() * (noise + wrong)) / alphas[k].sqrt()
        spread = (beta * ratio).sqrt()
        means = [
            alphas[k - 1].sqrt() * beta / (1 - alphas[k]) * start + (1 - beta).sqrt() * ratio * noisy
            for start in (clean, predicted)
        ]
        divergence = kl_divergence(Normal(means[0], spread), Normal(means[1], spread)).item()
        weight = beta**2 / (2 * spread**2 * (1 - beta) * (1 - alphas[k]))
        assert weight.item() * wrong**2 == pytest.approx(divergence, rel=1e-5)  # Ho et al., Eq. 12
        assert found[k - 1].item() == pytest.approx(2 * divergence, rel=1e-2, abs=1e-9)  # two dimensions


def test_divergence_knows_the_clamp():
    """At the last step of cosine, a small error in the noise is a huge one in the action, but no action is huge."""
    schedule, wrong = NoiseSchedule(100), 0.1
    actor = DiffusionActor(WrongBy(schedule, wrong), Bounded(-1, 1, (2,)), ["embedding"], ["action"], schedule)
    found = matching_divergence(actor, gaussian_data(100, 0.0))[99].item()
    c0, _, sigma = schedule.posterior(99, 98)
    farthest = 2  # from -1 to 1
    assert found <= 2 * (c0 * farthest / sigma) ** 2 / 2
    without_clamp = wrong * math.sqrt((1 - schedule.signal(99)) / schedule.signal(99))
    assert found < 0.01 * 2 * (c0 * without_clamp / sigma) ** 2 / 2


def test_one_step_has_no_divergence():
    schedule = NoiseSchedule(1)
    with pytest.raises(ValueError, match="schedule: got 1 step, must have at least 2"):
        matching_divergence(gaussian_actor(schedule, 0.1), gaussian_data(3, 0.1))


# --- discretization


@pytest.mark.parametrize("kind", SCHEDULES)
def test_discretization_term_by_hand(kind):
    schedule = NoiseSchedule(12, kind)
    assert discretization_term(schedule).item() == pytest.approx(sum(b**2 for b in schedule.betas.tolist()), rel=1e-6)


def test_discretization_term_as_printed_does_not_fall_with_k():
    """Errata of the theory page: finer cosine or linear schedules have the larger sum, and the worst has the least."""
    for kind in ("cosine", "linear"):
        sums = [discretization_term(NoiseSchedule(steps, kind)).item() for steps in (20, 100, 1000)]
        assert sums == sorted(sums)
    assert discretization_term(NoiseSchedule(20, "linear")) < 0.01 * discretization_term(NoiseSchedule(1000))


def drawn_variance(schedule, std, steps):
    """Variance of what ancestral sampling draws, for Gaussian actions with the exact score.

    Each estimate of a^0 is affine in a^k with the slope ``Cov(a^0, a^k) / Var(a^k)``, so all steps are.
    """
    alphas, variance = torch.cumprod(1 - schedule.betas.double(), 0).tolist(), 1.0
    for step, previous in zip(steps, [*steps[1:], -1], strict=True):
        a, b = alphas[step], 1.0 if previous < 0 else alphas[previous]
        clean = math.sqrt(a) * std**2 / (a * std**2 + 1 - a)
        slope = math.sqrt(b) * (1 - a / b) / (1 - a) * clean + math.sqrt(a / b) * (1 - b) / (1 - a)  # Eq. 7
        variance = slope**2 * variance + (1 - a / b) * (1 - b) / (1 - a)
    return variance


def energy_distance(first, second):
    """Of two isotropic Gaussians in the plane with one mean: ``E|N(0, v I)| = sqrt(pi v / 2)``."""
    return math.sqrt(math.pi / 2) * (2 * math.sqrt(first + second) - math.sqrt(2 * first) - math.sqrt(2 * second))


@pytest.mark.parametrize("count", [1, 2, 5, 20])
@pytest.mark.parametrize("kind", ["cosine", "vp"])
def test_discretization_error_of_gaussian_actions_in_closed_form(kind, count):
    torch.manual_seed(0)
    schedule, std = NoiseSchedule(100, kind), 0.15  # so narrow that few estimates of a^0 reach the clamp
    actor = gaussian_actor(schedule, std, sampler=DDPM(count))
    error = discretization_error(actor, gaussian_data(200, std), num_samples=100)
    variances = [drawn_variance(schedule, std, chain.timesteps(schedule)) for chain in (DDPM(count), DDPM())]
    # 20,000 draws each: the standard error of the estimate is about 0.0003, and 0.0008 for the largest distances
    assert error.mean().item() == pytest.approx(energy_distance(*variances), rel=0.03, abs=0.001)
    assert error.std().item() / math.sqrt(200) < 0.001


def test_one_step_costs_the_whole_spread_and_more_steps_less():
    torch.manual_seed(0)
    schedule, std = NoiseSchedule(100), 0.15
    actor, data = gaussian_actor(schedule, std), gaussian_data(200, std)
    errors = [discretization_error(actor, data, DDPM(count)).mean().item() for count in (1, 2, 5, 20)]
    assert errors == sorted(errors, reverse=True)
    # a point against a Gaussian of standard deviation std
    assert errors[0] == pytest.approx(energy_distance(0.0, std**2), rel=0.1)


def test_a_chain_without_noise_is_told_from_one_with_it():
    torch.manual_seed(0)
    actor, data = gaussian_actor(NoiseSchedule(100), 0.15), gaussian_data(200, 0.15)
    assert discretization_error(actor, data, DDPM(noise_ratio=0.0)).mean().item() > 0.1
    assert abs(discretization_error(actor, data, DDIM()).mean().item()) < 0.005  # the same actions, another way


def test_equal_chains_are_at_no_distance():
    torch.manual_seed(0)
    actor, data = gaussian_actor(NoiseSchedule(20), 0.3, sampler=DDPM(4)), gaussian_data(300, 0.3)
    assert discretization_error(actor, data, reference=DDPM(4)).mean().abs().item() < 0.002
    assert discretization_error(actor, data).mean().item() > 0.005


def test_one_sample_has_no_spread():
    with pytest.raises(ValueError, match="num_samples: got 1, must be at least 2"):
        discretization_error(gaussian_actor(NoiseSchedule(2), 0.1), gaussian_data(3, 0.1), num_samples=1)
