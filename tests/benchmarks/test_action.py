import csv

import action
import pytest
import torch
from dipo_loop import DIPOLoop


def test_toy_run(tmp_path):
    rows = action.main(action.Arguments(robots=2, hidden=16, repeats=2, out=tmp_path))
    differences = {row["form"]: row["largest difference"] for row in rows}
    assert len(rows) == 6 and differences[action.FLOOR] == differences[action.TORCHRL] == ""
    assert all(difference < 1e-5 for difference in differences.values() if difference != "")
    with open(tmp_path / "action.csv") as file:
        assert [row["form"] for row in csv.DictReader(file)] == list(differences)


def test_another_action_fails_the_run():
    actor = action.trained_actor(16, updates=1)
    exported, _ = action.exported_actor(actor, threads=1)
    embedding = torch.randn(3, action.EMBEDDING_DIM)
    other = DIPOLoop(action.trained_actor(16, updates=1).module.denoiser, actor.module.schedule)
    forms = {action.OURS: lambda: actor(embedding=embedding), "other": lambda: other(embedding)}
    with torch.no_grad(), pytest.raises(RuntimeError, match="actions differ"):
        action.compare(forms, actor, exported, embedding.numpy())


def test_replay_gives_the_same_numbers_however_they_are_drawn():
    numbers = torch.arange(12.0)
    with action.Replay(numbers):
        drawn = [torch.randn(2, 2), torch.randn_like(torch.zeros(4)), torch.randn((1, 4))]
    assert torch.equal(torch.cat([part.flatten() for part in drawn]), numbers)
