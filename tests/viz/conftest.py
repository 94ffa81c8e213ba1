import pytest
import torch

from redig.envs import formation_offsets


@pytest.fixture
def squeeze():
    """A scripted team that narrows on its way through the origin: [T, n, 2]."""

    def make(formation="wedge", n=5, samples=12):
        offsets = formation_offsets(formation, n)
        way = torch.linspace(-2.75, 2.75, samples)[:, None]
        scale = 1 - 0.6 * torch.exp(-((way / 1.5) ** 4))
        return torch.stack([way + offsets[:, 0], scale * offsets[:, 1]], -1)

    return make
