import os
import pickle
import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from vmas.simulator.environment import Environment

from redig.checkpoint import (
    buffer_state,
    collection_state,
    flat,
    load_checkpoint,
    rng_state,
    save_checkpoint,
    set_buffer_state,
    set_collection_state,
    set_rng_state,
    unflat,
)
from redig.envs import make_env

# torch warns of what these tests write on purpose
pytestmark = pytest.mark.filterwarnings("ignore:Detected pickle protocol")

STATE = {"weights": {"a": torch.arange(50.0)}, "step": 7, "best": 0.5, "name": "run", "history": [1, {"x": 2.0}]}


def same(first, second):
    """Equal nested containers of tensors, numbers and strings."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)
    if isinstance(first, torch.Tensor):
        return first.dtype == second.dtype and torch.equal(first, second)
    return first == second


@pytest.fixture
def path(tmp_path):
    save_checkpoint(tmp_path / "checkpoint.pt", STATE)
    return tmp_path / "checkpoint.pt"


# --- files


def test_round_trip(path):
    assert same(load_checkpoint(path), STATE)


def test_optimiser_continues_as_if_nothing_had_happened(tmp_path):
    def training():
        torch.manual_seed(0)
        net = torch.nn.Linear(3, 1)
        return net, torch.optim.Adam(net.parameters(), 0.1)

    def steps(net, optimizer, count):
        for _ in range(count):
            optimizer.zero_grad()
            net(torch.randn(8, 3)).square().mean().backward()
            optimizer.step()

    first, second = training(), training()
    steps(*first, 3)
    state = {"net": dict(first[0].state_dict()), "optimizer": first[1].state_dict(), "rng": rng_state()}
    save_checkpoint(tmp_path / "c.pt", state)
    steps(*first, 3)
    loaded = load_checkpoint(tmp_path / "c.pt")
    second[0].load_state_dict(loaded["net"])
    second[1].load_state_dict(loaded["optimizer"])
    set_rng_state(loaded["rng"])
    steps(*second, 3)
    assert same(dict(first[0].state_dict()), dict(second[0].state_dict()))


class Fails:
    def __getstate__(self):
        raise RuntimeError("disk full")


def test_failing_save_leaves_the_old_file(path):
    content = path.read_bytes()
    with pytest.raises(RuntimeError, match="disk full"):
        save_checkpoint(path, {"weights": torch.zeros(1000), "bad": Fails()})
    assert path.read_bytes() == content
    assert os.listdir(path.parent) == [path.name]


def test_save_killed_before_the_end_leaves_the_old_file(path, monkeypatch):
    def killed(*_):
        raise KeyboardInterrupt

    content = path.read_bytes()
    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(path, {"step": 8})
    assert path.read_bytes() == content


def test_save_replaces_the_old_file(path):
    save_checkpoint(path, {"step": 8})
    assert load_checkpoint(path) == {"step": 8}
    assert os.listdir(path.parent) == [path.name]


@pytest.mark.parametrize("part", [0.0, 0.01, 0.5, 0.9, 0.999])
def test_truncated_file(path, part):
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(ValueError, match=re.escape(f"checkpoint: {path} is damaged")):
        load_checkpoint(path)


@pytest.mark.parametrize(
    "content", [b"hello", b"\x00" * 100, b"q!", b"0", b"h<", b"\x80\x02X\x01\x00\x00\x00\xff.", b"{}"]
)
def test_file_of_something_else(path, content):
    path.write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(f"checkpoint: {path} is damaged")):
        load_checkpoint(path)


def test_corrupt_bytes_in_the_middle(path):
    content = bytearray(path.read_bytes())
    start = content.index(b"weights")
    for offset in range(-12, 40):
        damaged = content.copy()
        damaged[start + offset] ^= 0xFF
        path.write_bytes(damaged)
        try:
            load_checkpoint(path)  # a damaged letter of a name cannot be noticed
        except ValueError as error:
            assert f"checkpoint: {path} is damaged" in str(error)


class Bomb:
    exploded = False

    def __reduce__(self):
        return (setattr, (Bomb, "exploded", True))


@pytest.mark.parametrize("write", [torch.save, lambda o, p: p.write_bytes(pickle.dumps(o))])
@pytest.mark.parametrize("content", [Bomb(), Path("file"), SystemExit])
def test_pickled_objects_are_refused_and_not_executed(path, write, content):
    write({"step": content}, path)
    with pytest.raises(ValueError, match=re.escape(f"checkpoint: {path} is damaged or not a checkpoint")):
        load_checkpoint(path)
    assert not Bomb.exploded


def test_missing_file(tmp_path):
    for path in (tmp_path / "absent.pt", tmp_path):
        with pytest.raises(FileNotFoundError, match=re.escape(f"checkpoint: no such file: {path}")):
            load_checkpoint(path)


# --- random numbers


def test_rng_state_covers_torch_and_vmas():
    env = make_env(2)
    state = rng_state()
    first = torch.rand(4), env.reset()["agents", "observation"]
    env.reset()
    torch.rand(3)
    set_rng_state(state)
    second = torch.rand(4), env.reset()["agents", "observation"]
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


def test_rng_state_is_a_copy():
    env, state = make_env(2), rng_state()
    before = {name: value.clone() for name, value in state.items()}
    env.reset()
    torch.rand(3)
    assert same(state, before)
    set_rng_state(state)
    assert Environment.vmas_random_state[0].data_ptr() != state["vmas"].data_ptr()


# --- replay buffers


def buffer(size=20):
    return TensorDictReplayBuffer(storage=LazyTensorStorage(size), batch_size=16)


def numbered(start, count):
    number = torch.arange(start, start + count, dtype=torch.float32)
    return TensorDict({"number": number, "agents": {"flag": number > 4}, "next": {"number": number + 1}}, [count])


@pytest.mark.parametrize("written", [[7], [20], [20, 5], [13, 13, 13]])
def test_buffer_round_trip(written, tmp_path):
    first, second, start = buffer(), buffer(), 0
    for count in written:
        first.extend(numbered(start, count))
        start += count
    save_checkpoint(tmp_path / "b.pt", buffer_state(first))
    set_buffer_state(second, load_checkpoint(tmp_path / "b.pt"))
    assert len(second) == len(first) == min(start, 20)
    for _ in range(3):  # also after more was written: the cursors agree, so the same entries are overwritten
        samples = []
        for one in (first, second):
            torch.manual_seed(0)
            samples.append(one.sample())
            one.extend(numbered(start, 6))
        assert (samples[0] == samples[1]).all()
        start += 6


def test_buffer_state_is_a_copy():
    full = buffer()
    full.extend(numbered(0, 20))
    state = buffer_state(full)
    full.extend(numbered(100, 20))
    assert torch.equal(state["data"]["number"], torch.arange(20.0))


def test_empty_buffer(tmp_path):
    save_checkpoint(tmp_path / "b.pt", buffer_state(buffer()))
    restored = buffer()
    set_buffer_state(restored, load_checkpoint(tmp_path / "b.pt"))
    assert len(restored) == 0


def test_flat_and_unflat():
    data = numbered(0, 6)
    assert set(flat(data)) == {"number", "agents/flag", "next/number"}
    assert (unflat(flat(data), [6]) == data).all()


# --- collectors


def collection(seed, num_envs=3):
    """A noisy policy that drives to its goal, in episodes shorter than what is collected."""
    env = make_env(num_envs, max_steps=7, seed=seed, n_robots=3, reward_scale=0.1)

    def drive(observation):
        return (2 * observation[..., 4:6] + 0.5 * torch.randn_like(observation[..., 4:6])).clamp(-1, 1)

    policy = TensorDictModule(drive, in_keys=[("agents", "observation")], out_keys=[("agents", "action")])
    collector = Collector(env, policy, frames_per_batch=5 * num_envs, auto_register_policy_transforms=False)
    return env, collector, iter(collector)


def saved_collection(path, batches_before):
    """What a collector gathers after it was saved to a file."""
    env, collector, batches = collection(seed=0)
    for _ in range(batches_before):
        next(batches)
    save_checkpoint(path, {"collection": collection_state(env, collector), "rng": rng_state()})
    return [next(batches).clone() for _ in range(3)]


def restored_collection(path, batches_before):
    """The batches of another environment that continues from the file, after it was used for something else."""
    env, collector, batches = collection(seed=5)
    for _ in range(batches_before):
        next(batches)
    state = load_checkpoint(path)
    set_collection_state(env, collector, state["collection"])
    set_rng_state(state["rng"])
    return [next(batches).clone() for _ in range(3)]


@pytest.mark.parametrize(("before", "other_before"), [(0, 0), (2, 0), (2, 1)])
def test_collection_continues_bit_for_bit(before, other_before, tmp_path):
    expected = saved_collection(tmp_path / "c.pt", before)
    found = restored_collection(tmp_path / "c.pt", other_before)
    assert torch.stack([batch["next", "done"] for batch in expected]).any()
    for one, other in zip(expected, found, strict=True):
        assert set(one.keys(True, True)) == set(other.keys(True, True))
        for key, value in one.exclude(("collector", "traj_ids")).items(True, True):
            assert torch.equal(other[key], value), key


def test_trajectories_keep_their_numbers(tmp_path):
    expected = saved_collection(tmp_path / "c.pt", 2)
    found = restored_collection(tmp_path / "c.pt", 0)
    for one, other in zip(expected, found, strict=True):
        assert torch.equal(one["collector", "traj_ids"], other["collector", "traj_ids"])
