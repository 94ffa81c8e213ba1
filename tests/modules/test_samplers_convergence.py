"""What the chains converge to: the data where the denoiser is exact, and the probability-flow ODE."""

import itertools
import math

import pytest
import torch

from redig.modules import DDIM, DDPM, DPMSolver, NoiseSchedule
from redig.modules.schedule import SCHEDULES


def exact(schedule, expected_clean):
    """The denoiser that knows the data: eps from E[a0 | a^k], which ``expected_clean(a^k, alpha)`` gives."""

    def denoise(action, step):
        alpha = torch.tensor(schedule.signal(step), dtype=action.dtype)
        return (action - alpha.sqrt() * expected_clean(action, alpha)) / (1 - alpha).sqrt()

    return denoise


@pytest.mark.parametrize("kind", SCHEDULES)
@pytest.mark.parametrize(
    "sampler",
    [
        DDPM(),
        DDPM(5),
        DDPM(noise_ratio=0),
        DDPM(early_stop=60),
        DDPM(1),
        DDIM(),
        DDIM(5, 0.5),
        DPMSolver(),
        DPMSolver(5),
    ],
)
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


def clean_of_gaussian(mean, std):
    """E[a0 | a^k] of Gaussian data."""

    def expected_clean(action, alpha):
        gain = std**2 * alpha.sqrt() / (std**2 * alpha + 1 - alpha)
        return mean + gain * (action - alpha.sqrt() * mean)

    return expected_clean


@pytest.mark.parametrize("sampler", [DDPM(), DDIM(), DDIM(eta=0.5), DDIM(eta=1.0), DPMSolver(50)])
def test_gaussian_is_recovered(sampler):
    torch.manual_seed(0)
    schedule, mean, std = NoiseSchedule(200, "cosine"), 0.2, 0.15
    action = sampler(exact(schedule, clean_of_gaussian(mean, std)), torch.randn(50_000, 1), schedule)
    assert action.mean().item() == pytest.approx(mean, abs=0.005)
    assert action.std().item() == pytest.approx(std, rel=0.06)


@pytest.mark.parametrize("kind", SCHEDULES)
@pytest.mark.parametrize(("sampler", "order"), [(DDIM, 1), (DPMSolver, 2)])
def test_order_of_convergence_to_the_probability_flow(kind, sampler, order):
    """For Gaussian data the ODE keeps the standard score; twice the steps divide the error by two to the order."""
    schedule, mean, std, middle = NoiseSchedule(1024, kind), 0.1, 0.25, 255
    score = torch.linspace(-2, 2, 9, dtype=torch.float64).unsqueeze(-1)

    def on_the_flow(step):
        alpha = schedule.signal(step)
        return alpha**0.5 * mean + (alpha * std**2 + 1 - alpha) ** 0.5 * score

    def error(count):
        """At a step in the middle: the last jump, to the clean action, is of first order in all of them."""
        seen, denoise = {}, exact(schedule, clean_of_gaussian(mean, std))

        def watch(action, step):
            seen[step] = action
            return denoise(action, step)

        sampler(count)(watch, on_the_flow(1023), schedule)
        return (seen[middle] - on_the_flow(middle)).abs().max().item()

    errors = [error(count) for count in (16, 32, 64, 128)]
    for coarse, fine in itertools.pairwise(errors):
        assert math.log2(coarse / fine) == pytest.approx(order, abs=0.11)
