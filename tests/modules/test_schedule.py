import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.modules import NoiseSchedule
from redig.modules.schedule import SCHEDULES


def signal(kind: str, num_steps: int) -> list[float]:
    """alphas_cumprod in closed form, without a cumulative product of the code's betas."""
    times = [(k + 1) / num_steps for k in range(num_steps)]
    if kind == "vp":  # exp of minus the integral of beta(t) = 0.1 + 9.9 t
        return [math.exp(-0.1 * t - 9.9 * t**2 / 2) for t in times]
    if kind == "linear":
        betas = [1e-4 + (0.02 - 1e-4) * k / max(num_steps - 1, 1) for k in range(num_steps)]
        return [math.prod(1 - beta for beta in betas[: k + 1]) for k in range(num_steps)]

    def cosine(t: float) -> float:
        return math.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2

    exact = [cosine(t) / cosine(0) for t in times]
    before_last = exact[-2] if num_steps > 1 else 1.0
    return [*exact[:-1], before_last * 0.001]  # the last beta would be 1 and is clipped to 0.999


@pytest.mark.parametrize("kind", SCHEDULES)
@pytest.mark.parametrize("num_steps", [1, 2, 7, 100, 1000])
def test_alphas_cumprod_in_closed_form(kind, num_steps):
    schedule = NoiseSchedule(num_steps, kind)
    expected = torch.tensor(signal(kind, num_steps), dtype=torch.float64)
    torch.testing.assert_close(schedule.alphas_cumprod.double(), expected, rtol=2e-6, atol=1e-12)
    assert schedule.betas.shape == (num_steps,)
    assert (schedule.betas > 0).all()
    assert (schedule.betas < 1).all()


@pytest.mark.parametrize("kind", SCHEDULES)
def test_add_noise_equals_one_step_of_noise_after_another(kind):
    schedule = NoiseSchedule(50, kind)
    mean, variance = 1.0, 0.0
    for k, beta in enumerate(schedule.betas.double().tolist()):
        mean, variance = math.sqrt(1 - beta) * mean, (1 - beta) * variance + beta
        one, zero, step = torch.ones(1), torch.zeros(1), torch.tensor(k)
        assert schedule.add_noise(one, zero, step).item() == pytest.approx(mean, rel=1e-4, abs=1e-7)
        assert schedule.add_noise(zero, one, step).item() ** 2 == pytest.approx(
            variance, rel=1e-4, abs=1e-7
        )  # the float32 of 1 - alpha


def test_add_noise_has_the_moments_of_eq_9():
    torch.manual_seed(0)
    schedule, samples = NoiseSchedule(100, "cosine"), 100_000
    for step in (0, 30, 70, 99):
        action = torch.tensor([-0.8, 0.3]).expand(samples, 2)
        noisy = schedule.add_noise(action, torch.randn(samples, 2), torch.full((samples,), step))
        alpha = signal("cosine", 100)[step]
        torch.testing.assert_close(noisy.mean(0), math.sqrt(alpha) * action[0], atol=0.015, rtol=0)
        torch.testing.assert_close(noisy.var(0), torch.full((2,), 1 - alpha), atol=0.02, rtol=0.02)


def test_add_noise_takes_a_step_for_each_robot():
    schedule = NoiseSchedule(10)
    action, noise, step = torch.rand(3, 4, 2), torch.randn(3, 4, 2), torch.randint(10, (3, 4))
    noisy = schedule.add_noise(action, noise, step)
    for b in range(3):
        for i in range(4):
            torch.testing.assert_close(noisy[b, i], schedule.add_noise(action[b, i], noise[b, i], step[b, i]))


@st.composite
def steps(draw, count=2):
    """A schedule and ``count`` of its steps, latest first; the last may be -1."""
    schedule = NoiseSchedule(draw(st.integers(count, 60)), draw(st.sampled_from(SCHEDULES)))
    chosen = draw(st.sets(st.integers(-1, schedule.num_steps - 1), min_size=count, max_size=count))
    return schedule, sorted(chosen, reverse=True)


@settings(deadline=None)
@given(steps(), st.floats(-1, 1), st.floats(-2, 2))
def test_posterior_is_the_product_of_two_gaussians(chosen, clean, noisy):
    schedule, (step, previous) = chosen
    if previous < 0:
        return
    alpha, alpha_previous = schedule.signal(step), schedule.signal(previous)  # float32 cannot resolve 1 - alpha
    ratio = alpha / alpha_previous
    # q(x | a0) and, as a function of x, q(a^step | x): both on a grid around the narrower one's peak
    peaks = [(math.sqrt(alpha_previous) * clean, math.sqrt(1 - alpha_previous))]
    peaks += [(noisy / math.sqrt(ratio), math.sqrt((1 - ratio) / ratio))]
    centre, width = min(peaks, key=lambda peak: peak[1])
    shift = abs(peaks[0][0] - peaks[1][0])
    x = torch.linspace(centre - 12 * width - shift, centre + 12 * width + shift, 40_001, dtype=torch.float64)
    density = torch.softmax(sum(-(((x - mean) / std) ** 2) / 2 for mean, std in peaks), 0)
    mean = (density * x).sum().item()
    std = (density * (x - mean) ** 2).sum().sqrt().item()
    if x[1] - x[0] > std / 3:
        return  # the grid cannot show a peak this narrow
    c0, ck, sigma = schedule.posterior(step, previous)
    assert c0 * clean + ck * noisy == pytest.approx(mean, abs=1e-5)
    assert sigma == pytest.approx(std, rel=1e-4)


@pytest.mark.parametrize("kind", SCHEDULES)
def test_posterior_of_neighbours_is_eq_7(kind):
    schedule = NoiseSchedule(100, kind)
    alphas, betas = schedule.alphas_cumprod.double().tolist(), schedule.betas.double().tolist()
    for k in range(1, 100):
        c0, ck, sigma = schedule.posterior(k, k - 1)
        assert c0 == pytest.approx(math.sqrt(alphas[k - 1]) * betas[k] / (1 - alphas[k]), rel=2e-3)
        assert ck == pytest.approx(math.sqrt(1 - betas[k]) * (1 - alphas[k - 1]) / (1 - alphas[k]), rel=2e-3)
        assert sigma**2 == pytest.approx(betas[k] * (1 - alphas[k - 1]) / (1 - alphas[k]), rel=2e-3)


@settings(deadline=None)
@given(steps(count=3))
def test_strided_posterior_composes(chosen):
    schedule, (step, middle, previous) = chosen
    c0, ck, sigma = schedule.posterior(step, middle)
    c0_next, ck_next, sigma_next = schedule.posterior(middle, previous)
    composed = (c0_next + ck_next * c0, ck_next * ck, math.hypot(ck_next * sigma, sigma_next))
    assert schedule.posterior(step, previous) == pytest.approx(composed, rel=1e-6, abs=1e-9)


@settings(deadline=None)
@given(steps())
def test_posterior_of_the_clean_action_is_the_clean_action(chosen):
    schedule, (step, _) = chosen
    assert schedule.posterior(step, -1) == pytest.approx((1, 0, 0))


@pytest.mark.parametrize(("step", "previous"), [(3, 3), (3, 4), (10, 0), (0, -2), (-1, -1)])
def test_steps_out_of_order(step, previous):
    with pytest.raises(ValueError, match=rf"got {step}, {previous}, need -1 <= previous < step < 10"):
        NoiseSchedule(10).posterior(step, previous)


def test_bad_arguments():
    with pytest.raises(ValueError, match="num_steps: got 0"):
        NoiseSchedule(0)
    with pytest.raises(ValueError, match="'sigmoid', allowed are cosine, linear, vp"):
        NoiseSchedule(10, "sigmoid")


def test_negative_steps_and_steps_beyond_the_last():
    for step in (-2, 10):
        with pytest.raises(ValueError, match=f"step: got {step}, need -1 <= step < 10"):
            NoiseSchedule(10).signal(step)
    with pytest.raises(ValueError, match="num_steps: got -3, must be at least 1"):
        NoiseSchedule(-3)


@pytest.mark.parametrize(
    ("noise", "step"), [((3, 5, 2), (3,)), ((3, 5, 2), (3, 5, 1)), ((5, 2), (3, 5)), ((3, 5, 1), (3, 5))]
)
def test_shapes_that_do_not_fit(noise, step):
    with pytest.raises(ValueError, match=r"step: got shape .* for actions \[3, 5, 2\] and noise .*, expected \[3, 5\]"):
        NoiseSchedule(10).add_noise(torch.zeros(3, 5, 2), torch.zeros(noise), torch.zeros(step, dtype=torch.long))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_variances_stay_in_float32_in_a_module_of_half_precision(dtype):
    schedule = NoiseSchedule(1000, "cosine")
    module = torch.nn.Sequential(torch.nn.Linear(2, 2), schedule)
    for moved in (module.to(dtype), module.float().to(device="cpu", dtype=dtype)):
        assert moved[0].weight.dtype == dtype
        for buffer in moved[1].buffers():
            assert buffer.dtype == torch.float32
        assert torch.equal(moved[1].alphas_cumprod, NoiseSchedule(1000, "cosine").alphas_cumprod)
    action, noise = torch.randn(2, 1000, 2)
    noisy = schedule.add_noise(action.to(dtype), noise.to(dtype), torch.arange(1000))
    assert noisy.dtype == torch.float32
    torch.testing.assert_close(noisy, schedule.add_noise(action, noise, torch.arange(1000)), atol=0.03, rtol=0.03)


def test_double_precision_and_other_devices_are_followed():
    schedule = NoiseSchedule(10)
    assert schedule.double().alphas_cumprod.dtype == torch.float64
    assert schedule.to("meta").betas.device.type == "meta"


@pytest.mark.parametrize("kind", SCHEDULES)
def test_state_dict_round_trip(kind):
    schedule = NoiseSchedule(50, kind)
    state = schedule.state_dict()
    assert sorted(state) == ["alphas_cumprod", "betas"]
    loaded = NoiseSchedule(50, kind)
    loaded.load_state_dict(
        {key: value.bfloat16() for key, value in state.items()}
    )  # as in a policy saved to save space
    torch.testing.assert_close(loaded.alphas_cumprod, schedule.alphas_cumprod, rtol=5e-3, atol=0)
    loaded.load_state_dict(state)
    assert torch.equal(loaded.alphas_cumprod, schedule.alphas_cumprod)


@pytest.mark.parametrize("other", [NoiseSchedule(50, "vp"), NoiseSchedule(49, "cosine"), NoiseSchedule(1, "cosine")])
def test_weights_of_another_schedule(other):
    schedule = NoiseSchedule(50, "cosine")
    before = schedule.alphas_cumprod.clone()
    with pytest.raises(ValueError, match="weights are of another schedule than 'cosine' of 50 steps"):
        torch.nn.ModuleDict({"schedule": schedule}).load_state_dict(
            torch.nn.ModuleDict({"schedule": other}).state_dict()
        )
    assert torch.equal(schedule.alphas_cumprod, before)


def test_weights_saved_in_float16_where_the_schedule_underflows():
    schedule = NoiseSchedule(1000, "cosine")
    with pytest.raises(ValueError, match="float16"):
        schedule.load_state_dict({key: value.half() for key, value in schedule.state_dict().items()})
