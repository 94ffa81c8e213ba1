"""Every step of our chains against the schedulers of ``diffusers``, which know nothing of ours, on the same noise."""

import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler, DPMSolverMultistepScheduler

from redig.modules import DDIM, DDPM, DPMSolver, NoiseSchedule
from redig.modules.schedule import SCHEDULES

K = 100
kinds = pytest.mark.parametrize("kind", SCHEDULES)
counts = pytest.mark.parametrize("count", [1, 2, 5, 20, K])
dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def predict(action, step):
    """A nonlinear denoiser that uses all of its inputs and drives some estimates of a^0 beyond the clamp."""
    return 0.9 * action + 0.3 * torch.sin(2 * action.flip(-1) + 0.1 * step)


def make_latent(dtype):
    return torch.randn(16, 5, 2, dtype=dtype, generator=torch.Generator().manual_seed(0))


def our_chain(sampler, schedule, latent):
    """All actions that the chain passes through, the result last."""
    chain = []

    def denoise(action, step):
        chain.append(action)
        return predict(action, step)

    result = sampler(denoise, latent, schedule, torch.Generator().manual_seed(1))
    return torch.stack([*chain, result])


def their_chain(scheduler, latent, steps, **arguments):
    """The same of a scheduler; ``steps`` is a number or a list of them."""
    scheduler.set_timesteps(**({"timesteps": steps} if isinstance(steps, list) else {"num_inference_steps": steps}))
    generator, chain = torch.Generator().manual_seed(1), [latent]
    for step in scheduler.timesteps:
        noise = predict(chain[-1], step.item())
        chain.append(scheduler.step(noise, step, chain[-1], generator=generator, **arguments).prev_sample)
    return torch.stack(chain)


def scheduler_of(sampler, schedule, exact=True):
    """Their counterpart of a sampler. ``exact``: with our variances in double precision; they round to float32."""
    options = {"num_train_timesteps": K, "trained_betas": schedule.betas.tolist(), "timestep_spacing": "trailing"}
    if sampler is DDPM:
        scheduler = DDPMScheduler(**options, variance_type="fixed_small", clip_sample=True)
    elif sampler is DDIM:
        scheduler = DDIMScheduler(**options, set_alpha_to_one=True, clip_sample=True)
    else:  # dynamic thresholding with a largest value of 1 is our clamp
        options |= {"algorithm_type": "dpmsolver++", "solver_order": 2, "final_sigmas_type": "zero"}
        scheduler = DPMSolverMultistepScheduler(**options, thresholding=True, sample_max_value=1.0)
    if exact:
        scheduler.alphas_cumprod = torch.tensor([schedule.signal(k) for k in range(K)], dtype=torch.float64)
    return scheduler


@kinds
@counts
@dtypes
@pytest.mark.parametrize("sampler", [DDPM, DPMSolver])
def test_ddpm_and_dpm_solver(sampler, kind, count, dtype):
    schedule, latent = NoiseSchedule(K, kind), make_latent(dtype)
    expected = their_chain(scheduler_of(sampler, schedule), latent, count)
    torch.testing.assert_close(our_chain(sampler(count), schedule, latent), expected, atol=1e-5, rtol=0)


@kinds
@counts
@dtypes
@pytest.mark.parametrize("eta", [0.0, 0.5, 1.0])
def test_ddim(kind, count, eta, dtype):
    schedule, latent = NoiseSchedule(K, kind), make_latent(dtype)
    options = {"eta": eta, "use_clipped_model_output": True}  # the noise is taken anew from the clamped estimate
    expected = their_chain(scheduler_of(DDIM, schedule), latent, count, **options)
    torch.testing.assert_close(our_chain(DDIM(count, eta), schedule, latent), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("count", [3, 7, 30])
@pytest.mark.parametrize("sampler", [DDPM, DPMSolver])
def test_counts_that_do_not_divide_the_schedule(sampler, count):
    """Their rounding of such steps is another, so they are given ours; their DDIM takes no list of steps."""
    schedule, latent = NoiseSchedule(K), make_latent(torch.float64)
    expected = their_chain(scheduler_of(sampler, schedule), latent, sampler(count).timesteps(schedule))
    torch.testing.assert_close(our_chain(sampler(count), schedule, latent), expected, atol=1e-5, rtol=0)


@kinds
@pytest.mark.parametrize("sampler", [DDPM, DDIM, DPMSolver])
def test_with_their_own_rounding_of_the_variances(sampler, kind):
    """In 100 steps of DDPM their float32 of ``1 - alphas_cumprod`` alone would make up 5e-5."""
    schedule, latent = NoiseSchedule(K, kind), make_latent(torch.float32)
    options = {"use_clipped_model_output": True} if sampler is DDIM else {}
    expected = their_chain(scheduler_of(sampler, schedule, exact=False), latent, 20, **options)
    torch.testing.assert_close(our_chain(sampler(20), schedule, latent), expected, atol=1e-5, rtol=0)


def test_the_comparison_covers_both_sides_of_the_clamp():
    schedule, latent = NoiseSchedule(K), make_latent(torch.float64)
    for k, action in zip(range(K - 1, -1, -1), our_chain(DDIM(), schedule, latent), strict=False):
        clean = (action - (1 - schedule.signal(k)) ** 0.5 * predict(action, k)) / schedule.signal(k) ** 0.5
        if k in (0, 10, 50):
            assert 0.02 < (clean.abs() > 1).double().mean() < 0.98
