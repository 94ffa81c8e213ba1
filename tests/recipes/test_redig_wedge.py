import csv
import dataclasses
import json
import math
import signal
import subprocess
import time
import zipfile

import pytest
import redig_wedge
import torch
from config import SMOKE, Config
from conftest import command
from PIL import Image
from run import Run

from redig.checkpoint import load_checkpoint
from redig.disk_storage import DiskStorage
from redig.policy import load_policy, read_header

METRICS = [
    "success_rate", "team_success_rate", "travel_time", "cfi_0.5", "cfi_0.1", "cfi_0.03", "cfi_literal_0.5",
    "cfi_literal_0.1", "cfi_literal_0.03", "jerk_mean", "jerk_peak",
]  # fmt: skip


def weights(folder):
    return load_checkpoint(folder / "checkpoint.pt")["loss"]


def assert_same_run(first, second):
    one, two = weights(first), weights(second)
    assert one.keys() == two.keys()
    different = [key for key in one if isinstance(one[key], torch.Tensor) and not torch.equal(one[key], two[key])]
    assert different == []
    rows = [(folder / "evaluations.csv").read_text() for folder in (first, second)]
    assert rows[0] == rows[1]


def test_a_run_leaves_everything(smoke):
    folder, printed = smoke
    metrics = json.loads((folder / "metrics.json").read_text())
    for name in METRICS:
        assert name in metrics and f"cloned_{name}" in metrics
    assert json.loads((folder / "config.json").read_text())["clone_updates"] == SMOKE["clone_updates"]
    with open(folder / "evaluations.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row["phase"] for row in rows] == ["clone", "online", "online"]
    assert list(folder.glob("log/**/*.csv"))
    for name in ("learning_curve.png", "trajectories.png", "trajectories.gif"):
        with Image.open(folder / name) as image:
            assert min(image.size) > 200
    assert "cloned (before online training)" in printed and "success_rate" in printed
    for name in ("policy", "last", "cloned"):
        assert load_policy(folder / f"{name}.safetensors", observation_dim=9)
        assert read_header(folder / f"{name}.safetensors")[1]["max_steps"] == SMOKE["max_steps"]
    assert not list(folder.glob(".*tmp*"))


def test_online_training_changes_the_cloned_policy(smoke):
    folder, _ = smoke
    cloned, last = (load_policy(folder / f"{name}.safetensors").state_dict() for name in ("cloned", "last"))
    assert any(not torch.equal(cloned[key], last[key]) for key in cloned)


@pytest.mark.parametrize("phase,step", [("clone", 7), ("critic", 3), ("online", 1)])
def test_an_interrupted_run_resumes_to_the_same_result(smoke, tmp_path, monkeypatch, phase, step):
    whole, _ = smoke
    monkeypatch.setattr(redig_wedge, "finish", lambda run, config: {})
    loop = redig_wedge.Run.loop

    def interrupting(self, name, *arguments, **options):
        for i in loop(self, name, *arguments, **options):
            if (name, i) == (phase, step):
                signal.raise_signal(signal.SIGINT)
            yield i

    folder = tmp_path / "run"
    torch.set_num_threads(1)
    with monkeypatch.context() as patch:
        patch.setattr(redig_wedge.Run, "loop", interrupting)
        with pytest.raises(SystemExit, match="--resume"):
            redig_wedge.train(Config(smoke=True, out=folder, threads=1))
    assert load_checkpoint(folder / "checkpoint.pt")["counters"][phase] == step + 1
    redig_wedge.train(Config(resume=folder))
    assert_same_run(whole, folder)


def test_a_killed_run_resumes_to_the_same_result(smoke, tmp_path):
    whole, _ = smoke
    folder = tmp_path / "run"
    process = subprocess.Popen(
        command("redig_wedge.py", "--smoke", "--out", folder, "--threads", 1),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 120
    while not (folder / "checkpoint.pt").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert load_checkpoint(folder / "checkpoint.pt")["counters"]
    done = subprocess.run(command("redig_wedge.py", "--resume", folder), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert_same_run(whole, folder)
    assert (folder / "metrics.json").read_text() == (whole / "metrics.json").read_text()


def test_a_buffer_on_disk_changes_nothing_not_even_in_a_run_killed_after_it_has_wrapped(tmp_path, monkeypatch):
    class PowerCut(Exception):
        pass

    def cut(storage, cursor, data, **options):
        write(storage, cursor, data, **options)
        if storage._writes == 3:  # the last one of all, over entries that the checkpoint before it knows
            raise PowerCut

    torch.set_num_threads(1)
    monkeypatch.setattr(redig_wedge, "finish", lambda run, config: {})
    write, options = DiskStorage.set, {"smoke": True, "threads": 1, "buffer_size": 200}
    redig_wedge.train(Config(out=tmp_path / "in_memory", **options))
    with monkeypatch.context() as patch:
        patch.setattr(DiskStorage, "set", cut)
        with pytest.raises(PowerCut):
            redig_wedge.train(Config(out=tmp_path / "on_disk", buffer_on_disk=True, **options))
    assert load_checkpoint(tmp_path / "on_disk" / "checkpoint.pt")["counters"]["online"] == 1
    redig_wedge.train(Config(resume=tmp_path / "on_disk"))
    assert_same_run(tmp_path / "in_memory", tmp_path / "on_disk")


def test_another_seed_gives_another_policy(smoke, tmp_path, monkeypatch):
    whole, _ = smoke
    monkeypatch.setattr(redig_wedge, "finish", lambda run, config: {})
    redig_wedge.train(Config(smoke=True, out=tmp_path / "run", seed=1, threads=1))
    one, two = weights(whole), weights(tmp_path / "run")
    assert any(not torch.equal(one[key], two[key]) for key in one if isinstance(one[key], torch.Tensor))


def test_a_loss_that_is_not_finite_stops_the_run(tmp_path):
    config = Config(smoke=True, out=tmp_path / "run", clone_lr=math.inf)
    with pytest.raises(FloatingPointError, match=r"loss_pi is (nan|inf).*checkpoint"):
        redig_wedge.train(config)


def test_a_gradient_that_is_not_finite_leaves_the_weights_alone(tmp_path):
    run = Run(tmp_path / "run", Config(), "csv")
    weight = torch.nn.Parameter(torch.zeros(1))
    with pytest.raises(FloatingPointError, match="the gradient of loss_q is (nan|inf)"):
        run.step(weight.sqrt().sum(), torch.optim.SGD([weight], 0.1), 2.0, "loss_q")
    assert weight.item() == 0.0


def test_a_run_is_not_overwritten(smoke):
    with pytest.raises(FileExistsError, match="--resume"):
        redig_wedge.train(Config(smoke=True, out=smoke[0]))


def test_a_corrupt_checkpoint_is_named(smoke, tmp_path):
    whole, _ = smoke
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.json").write_bytes((whole / "config.json").read_bytes())
    (folder / "checkpoint.pt").write_bytes((whole / "checkpoint.pt").read_bytes()[:5000])
    with pytest.raises(ValueError, match=r"checkpoint: .*checkpoint.pt is damaged"):
        redig_wedge.train(Config(resume=folder))
    with zipfile.ZipFile(whole / "checkpoint.pt") as file:
        assert file.testzip() is None  # the original is whole


@pytest.mark.parametrize(
    "options,message",
    [
        ({"formation": "star"}, r"formation: got 'star', allowed are wedge, line, circle"),
        ({"corridor_width": 0.15}, r"corridor_width: got 0.15 m, too narrow for one robot"),
        ({"n_robots": 1}, r"n_robots: got 1"),
        ({"logger": "carrier-pigeon"}, r"logger: got 'carrier-pigeon', allowed are csv, tensorboard, wandb"),
        ({"refine_from": "nowhere"}, r"refine_from: got 'nowhere'"),
        ({"schedule": "quadratic"}, r"schedule: got 'quadratic'"),
        ({"sampling_steps": 101}, r"num_steps: the sampler asks for 101 steps, the schedule has 100"),
        ({"batch_size": 0}, r"batch_size: got 0"),
        ({"max_steps": 0}, r"max_steps: got 0"),
        ({"demonstration_share": 1.5}, r"demonstration_share: got 1.5"),
    ],
)
def test_bad_options_stop_before_any_training(tmp_path, options, message):
    config = dataclasses.replace(Config(out=tmp_path / "run"), **options)
    with pytest.raises(ValueError, match=message):
        redig_wedge.train(config)
    assert not (tmp_path / "run").exists()


def test_a_missing_logger_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install 'redig\[wandb\]'"):
        redig_wedge.train(Config(out=tmp_path / "run", logger="wandb"))


def test_resuming_nothing_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="resume: .* holds no run"):
        redig_wedge.train(Config(resume=tmp_path))


@pytest.mark.parametrize("logger", ["tensorboard", "wandb"])
def test_other_loggers_log_offline(tmp_path, monkeypatch, logger):
    monkeypatch.setattr(redig_wedge, "finish", lambda run, config: {})
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    config = Config(smoke=True, out=tmp_path / "run", logger=logger, formation="line")
    redig_wedge.train(config)
    pattern = {"tensorboard": "log/**/events.out.tfevents.*", "wandb": "log/**/*.wandb"}[logger]
    files = list((tmp_path / "run").glob(pattern))
    assert files and files[0].stat().st_size > 0


def test_help_explains_each_option(printed_help):
    printed = printed_help("redig_wedge.py")
    for field in dataclasses.fields(Config):
        assert f"--{field.name.replace('_', '-')}" in printed
