"""The update written plainly is an oracle of ours: same weights, same batch, same random numbers, same losses."""

import csv

import pytest
import torch
from update import Arguments, disagreement, main, make_batch, pair

from redig.policy import PolicyConfig


@pytest.mark.parametrize(("robots", "activation"), [(5, "mish"), (1, "silu")])
def test_plain_and_ours_have_the_same_losses(robots, activation):
    torch.manual_seed(0)
    config = PolicyConfig(9, hidden=(16,) * 3, diffusion_steps=7, noise_ratio=0.0, activation=activation)
    assert disagreement(*pair(config), make_batch(4, robots)) < 1e-5


def test_toy_run(tmp_path):
    main(Arguments(teams=4, robots=3, hidden=(8,), diffusion_steps=6, repeats=2, out=tmp_path))
    with open(tmp_path / "update.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert all(float(row["ms"]) > 0 for row in rows)
    assert (tmp_path / "update_parts.md").exists()
