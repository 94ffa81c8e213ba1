import csv

import pytest
import torch
from collection import MAX_STEPS, Arguments, collection, main, recipe_env


def test_toy_run(tmp_path):
    rows = main(Arguments(num_envs=(2,), repeats=1, out=tmp_path))
    assert [row["collector"] for row in rows] == [
        "policy, untrained", "policy, trained", "random actions", "VMAS navigation, random actions",
    ]  # fmt: skip
    for row in rows:
        assert row["frames/s"] == pytest.approx(2 / (row["ms a step"] / 1e3))
        assert ("policy share" in row) == row["collector"].startswith("policy")
    with open(tmp_path / "collection.csv") as file:
        assert [row["collector"] for row in csv.DictReader(file)] == [row["collector"] for row in rows]


def test_teams_are_in_all_phases_of_an_episode():
    torch.manual_seed(0)
    collect = collection(recipe_env(16, "cpu"), policy=None, steps=5)
    batch = collect()
    assert batch.shape == (16, 5)
    steps = batch["step_count"][:, 0, 0]
    assert len(steps.unique()) > 8 and steps.min() >= 0 and steps.max() < MAX_STEPS
