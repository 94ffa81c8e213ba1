import csv

import memory
import pytest
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer


def test_toy_run(tmp_path):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    rows = memory.main(memory.Arguments(transitions=3000, batch=4, repeats=2, folder=scratch, out=tmp_path))
    assert [(row["buffer"], row["transitions"]) for row in rows] == [("memory", 3000), ("disk", 3000)]
    in_memory, on_disk = rows
    assert in_memory["buffer on disk (MiB)"] == 0 < on_disk["buffer on disk (MiB)"]
    assert on_disk["checkpoint (MiB)"] < 0.01 < in_memory["checkpoint (MiB)"]
    assert not list(scratch.iterdir())
    with open(tmp_path / "memory.csv") as file:
        assert len(list(csv.DictReader(file))) == 2


def test_the_buffer_is_filled_to_the_last_place():
    data = memory.lived(memory.Config().resolve(), num_envs=2)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100))
    memory.fill(buffer, 100, data)
    assert len(buffer) == 100
    assert (buffer[40:80].exclude("index") == data).all()
    assert {"steps_to_next_obs", "demonstration"} < set(buffer[:].keys())


def test_resident_memory_by_kind(monkeypatch, tmp_path):
    (tmp_path / "status").write_text("Name:\tpython\nGroups:\t\nRssAnon:\t    2048 kB\nRssFile:\t  512 kB\n")
    monkeypatch.setattr(memory, "Path", lambda _: tmp_path / "status")
    assert memory.resident() == {"anonymous": 2.0, "mapped files": 0.5}
    monkeypatch.setattr(memory, "Path", lambda _: tmp_path / "absent")
    assert memory.resident() == {}


def test_an_update_changes_the_loss():
    config = memory.Config(hidden=8).resolve()
    update, data = memory.updater(config), memory.lived(config, num_envs=2)
    update(data)
    assert data["agents", "td_error"].shape == (40, 5, 1)


@pytest.mark.parametrize("kind", ["memory", "disk"])
def test_one_kind_alone_prints_its_row(tmp_path, capsys, kind):
    memory.main(memory.Arguments(transitions=50, batch=2, repeats=1, only=kind, out=tmp_path))
    assert f'"buffer": "{kind}"' in capsys.readouterr().out
    assert not list(tmp_path.iterdir())
