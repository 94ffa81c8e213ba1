import gpu
import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.envs.utils import ExplorationType, set_exploration_type


@pytest.fixture(autouse=True)
def random_actions():
    with set_exploration_type(ExplorationType.RANDOM):
        yield


class NoCopies(TorchFunctionMode):
    """Stands in for a CUDA graph: while it is captured, numbers cannot go from the host to the device or back."""

    forbidden = (
        *(torch.tensor, torch.as_tensor, torch.from_numpy),
        *(torch.Tensor.item, torch.Tensor.tolist, torch.Tensor.numpy, torch.Tensor.cpu),
    )

    def __torch_function__(self, func, types, args=(), kwargs=None):
        assert func not in self.forbidden, f"{func.__name__} copies between host and device"
        return func(*args, **(kwargs or {}))


class NoWaiting(TorchDispatchMode):
    """The same for what looks at numbers of the device from within: truth values, shapes that depend on them."""

    forbidden = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "equal.default")

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        by_mask = "aten.index.Tensor" in str(func) and any(i is not None and i.dtype == torch.bool for i in args[1])
        assert not by_mask and not any(name in str(func) for name in self.forbidden), f"{func} waits for the device"
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    "code",
    [
        lambda x: x.item(), lambda x: bool(x > 0), lambda x: x[x > 0], lambda x: x.tolist(), lambda x: x.cpu(),
        lambda x: torch.tensor([1.0], device=x.device),
    ],
)  # fmt: skip
def test_the_stand_in_finds_what_a_graph_cannot_capture(code):
    with pytest.raises(AssertionError, match="waits|copies"), NoCopies(), NoWaiting():
        code(torch.ones(1))


@pytest.mark.parametrize("encoder", [False, True])
def test_nothing_in_an_action_breaks_a_capture(encoder):
    act, inputs = gpu.actor(3, encoder, "cpu"), torch.randn(5, 9 if encoder else 22)
    with NoCopies(), NoWaiting():
        assert act(inputs).shape == (5, 2)


def test_nothing_in_an_update_breaks_a_capture():
    loss = gpu.loss_of(gpu.configuration(steps=2, hidden=16))
    batch = gpu.batch_of(teams=4, robots=3, device="cpu")
    with NoCopies(), NoWaiting():
        losses = loss(batch)
        (losses["loss_qvalue"] + losses["loss_actor"]).backward()


def test_an_update_changes_networks_and_leaves_the_batch_as_it_was():
    batch = gpu.batch_of(teams=4, robots=3, device="cpu")
    before, keys = batch.clone(), set(batch.keys(True, True))
    update = gpu.updater(2, batch, hidden=16)
    losses = [update().item() for _ in range(30)]
    assert min(losses[-5:]) < losses[0]
    assert set(batch.keys(True, True)) == keys and (batch == before).all()


def test_rows_of_actions_and_updates():
    rows = [
        *gpu.action_rows(100, False, robots=3, device="cpu", repeats=2, compiled=False),
        *gpu.action_rows(60, True, robots=3, device="cpu", repeats=2, compiled=False),
    ]
    assert [(row["form"], row["paper (ms)"]) for row in rows] == [("eager", 7.81), ("eager", 4.5)]
    (row,) = gpu.update_rows(2, teams=2, robots=3, device="cpu", repeats=2, compiled=False)
    assert row["eager / this"] == 1 and row["ms"] > 0


@pytest.mark.skipif(torch.cuda.is_available(), reason="is about machines without a GPU")
def test_without_a_gpu_it_says_so_and_ends(tmp_path, capsys):
    gpu.main(gpu.Arguments(out=tmp_path))
    assert capsys.readouterr().out == "gpu: skipped, torch finds no CUDA device\n"
    assert not list(tmp_path.iterdir())
