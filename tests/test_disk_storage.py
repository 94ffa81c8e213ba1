import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer

from redig.checkpoint import buffer_state, load_checkpoint, save_checkpoint, set_buffer_state
from redig.disk_storage import DiskStorage

SIZE = 8


def on_disk(folder):
    return TensorDictReplayBuffer(storage=DiskStorage(SIZE, folder), batch_size=16)


def in_memory():
    return TensorDictReplayBuffer(storage=LazyTensorStorage(SIZE), batch_size=16)


def numbered(start, count):
    number = torch.arange(start, start + count, dtype=torch.float32)
    return TensorDict({"number": number, "next": {"agents": {"flag": number.view(-1, 1) > 4}}}, [count])


def assert_same_entries(one, other):
    assert len(one) == len(other)
    if len(one):
        assert (one[:].exclude("index") == other[:].exclude("index")).all()


@settings(max_examples=60, deadline=None)
@given(st.lists(st.one_of(st.integers(1, SIZE), st.sampled_from(["save", "kill", "kill while saving"])), max_size=25))
def test_entries_are_always_those_of_a_buffer_in_memory(actions):
    """Oracle: the buffer in memory with full copies as checkpoints; a number stands for as many new entries."""
    with tempfile.TemporaryDirectory() as folder:
        mine, oracle, start, saved = on_disk(folder), in_memory(), 0, None
        for action in actions:
            if isinstance(action, int):
                for one in (mine, oracle):
                    one.extend(numbered(start, action))
                start += action
            elif action == "save":
                saved = buffer_state(mine), buffer_state(oracle)
            else:
                if action == "kill while saving" and saved is not None:
                    buffer_state(mine)  # and the file is never written
                mine, oracle = on_disk(folder), in_memory()
                if saved is not None:
                    set_buffer_state(mine, saved[0])
                    set_buffer_state(oracle, saved[1])
            assert_same_entries(mine, oracle)


@pytest.mark.parametrize("killed", ["before the write", "in the write"])
def test_killed_within_a_write(tmp_path, monkeypatch, killed):
    def half_written(storage, cursor, data, **options):
        if killed == "in the write":
            storage._storage[cursor[: len(cursor) // 2]] = data[: len(cursor) // 2]
        raise KeyboardInterrupt

    mine, oracle = on_disk(tmp_path), in_memory()
    for one in (mine, oracle):
        one.extend(numbered(0, SIZE))
    state = buffer_state(mine)
    with monkeypatch.context() as patch:
        patch.setattr(LazyMemmapStorage, "set", half_written)
        with pytest.raises(KeyboardInterrupt):
            mine.extend(numbered(100, 6))
    restored = on_disk(tmp_path)
    set_buffer_state(restored, state)
    assert_same_entries(restored, oracle)


def test_samples_and_later_writes_continue(tmp_path):
    mine, oracle = on_disk(tmp_path), in_memory()
    for one in (mine, oracle):
        one.extend(numbered(0, SIZE - 2))
    save_checkpoint(tmp_path / "c.pt", buffer_state(mine))
    mine.extend(numbered(50, 5))
    restored = on_disk(tmp_path)
    set_buffer_state(restored, load_checkpoint(tmp_path / "c.pt"))
    for start in (20, 30):
        samples = []
        for one in (restored, oracle):
            torch.manual_seed(start)
            samples.append(one.sample().exclude("index"))
            one.extend(numbered(start, 5))
        assert (samples[0] == samples[1]).all()
        assert_same_entries(restored, oracle)


def test_a_checkpoint_holds_no_entries(tmp_path):
    buffer = on_disk(tmp_path)
    buffer.extend(numbered(0, 5))
    assert buffer_state(buffer)["storage"] == {"size": 5, "writes": 1}


def test_overwritten_entries_are_kept_no_longer_than_needed(tmp_path):
    buffer = on_disk(tmp_path)
    for start in range(0, 40, 4):
        buffer.extend(numbered(start, 4))
        buffer_state(buffer)
    assert len(list((tmp_path / "overwritten").iterdir())) == 1  # until the last checkpoint is surely written


def test_a_run_without_a_checkpoint_starts_again_in_its_folder(tmp_path):
    on_disk(tmp_path).extend(numbered(0, SIZE))
    again = on_disk(tmp_path)
    assert len(again) == 0
    again.extend(numbered(70, 3))
    assert again[:]["number"].tolist() == [70.0, 71.0, 72.0]


def test_missing_entries_are_named(tmp_path):
    buffer = on_disk(tmp_path / "one")
    buffer.extend(numbered(0, 3))
    with pytest.raises(FileNotFoundError, match=f"buffer: no entries in {Path(tmp_path / 'two' / 'entries')}"):
        set_buffer_state(on_disk(tmp_path / "two"), buffer_state(buffer))
