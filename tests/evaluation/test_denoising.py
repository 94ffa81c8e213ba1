import math

import pytest
import torch
from torch import nn
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.evaluation import denoising_path
from redig.modules import DDIM, DDPM, DenoisingMLP, DiffusionActor, DPMSolver, NoiseSchedule

MEAN, SPREAD = 0.2, 0.1


class ExactDenoiser(nn.Module):
    """The noise of a Gaussian of clean actions in closed form."""

    def __init__(self, schedule):
        super().__init__()
        self.schedule = schedule

    def forward(self, action, step, embedding):
        signal = self.schedule.signal(int(step))
        variance = signal * SPREAD**2 + 1 - signal
        return (1 - signal) ** 0.5 * (action - signal**0.5 * MEAN) / variance


@pytest.mark.parametrize("sampler", [DDIM(), DDPM()], ids=str)
def test_states_are_distributed_as_noised_actions(sampler):
    schedule = NoiseSchedule(500)
    generator = torch.Generator().manual_seed(0)
    actor = DiffusionActor(
        ExactDenoiser(schedule), Bounded(-1, 1, (1,)), ["h"], ["action"], schedule, generator=generator
    )
    latent = torch.randn(5_000, 1, generator=generator)
    steps, states = denoising_path(actor, torch.zeros(5_000, 1), latent, sampler)
    assert steps == list(range(500, -1, -1))
    for step, state in zip(steps[5:], states[5:], strict=True):  # the last betas are cut off at 0.999
        signal = schedule.signal(step - 1)
        expected = math.sqrt(signal * SPREAD**2 + 1 - signal)
        assert state.mean().item() == pytest.approx(signal**0.5 * MEAN, abs=0.03)
        assert state.std().item() == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("sampler", [None, DDIM(num_steps=5), DDPM(num_steps=3, noise_ratio=0), DPMSolver(num_steps=4)])
def test_ends_with_the_actors_own_action(sampler):
    torch.manual_seed(0)
    spec = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0]), (2,))
    actor = DiffusionActor(
        DenoisingMLP(2, 8), spec, ["h"], ["action"], NoiseSchedule(20), DDIM(num_steps=10), latent_key="latent"
    )
    embedding, latent = torch.randn(7, 5, 8), torch.randn(7, 5, 2)
    steps, states = denoising_path(actor, embedding, latent, sampler)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        expected = actor(h=embedding, latent=latent) if sampler is None else None
        if sampler is not None:
            expected = actor.module(embedding, latent, sampler=sampler)
    torch.testing.assert_close(states[-1], expected)
    torch.testing.assert_close(states[0], torch.tensor([0.0, 2.0]) + latent * torch.tensor([1.0, 2.0]))
    assert len(states) == len(steps)
    assert steps[0] == 20
    assert steps[-1] == 0
    assert not states.requires_grad
