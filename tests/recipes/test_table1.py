import csv
import fcntl
import json
import os
import signal
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import table1
import table1_methods
import torch
from conftest import RECIPES
from table1 import Arguments
from table1_report import COLUMNS

from redig.checkpoint import load_checkpoint

RECIPE = f"""
import json, pathlib, shutil, sys
options = dict(zip(sys.argv[1::2], sys.argv[2::2]))
out = pathlib.Path(options.get("--out") or options["--resume"])
with open(out / "calls", "a") as file:
    print(*sys.argv[1:], file=file)
if options.get("--seed") == "1":
    sys.exit("seed 1 is broken")
(out / "config.json").write_text(json.dumps({{"frames": 640}}))
shutil.copy({str(RECIPES / "policies" / "wedge.safetensors")!r}, out / "policy.safetensors")
(out / "metrics.json").write_text("{{}}")
"""


@pytest.fixture
def arguments(tmp_path, monkeypatch):
    """One trained method on one formation, by a recipe that ends at once, with an evaluation that does so too."""
    (tmp_path / "recipe.py").write_text(RECIPE)
    dgnn = replace(table1_methods.METHODS["dgnn"], recipe=str(tmp_path / "recipe.py"), options=())
    monkeypatch.setitem(table1_methods.METHODS, "dgnn", dgnn)
    metrics = {name: torch.ones(2) for name in COLUMNS}
    monkeypatch.setattr(table1, "evaluate_teams", lambda policy, env, seed: metrics)
    return Arguments(
        only=("dgnn",), seeds=(0,), formations=("wedge",), runs=tmp_path / "runs", out=tmp_path / "out", parallel=2,
        starts=2,
    )  # fmt: skip


def test_a_run_that_fails_is_reported_and_the_rest_goes_on(arguments, capsys):
    assert table1.main(replace(arguments, seeds=(0, 1, 2))) == 1
    printed = capsys.readouterr()
    broken = arguments.runs / "dgnn-wedge-seed1"
    assert f"failed: dgnn:wedge:1, see {broken / 'output.txt'}" in printed.err
    assert "seed 1 is broken" in (broken / "output.txt").read_text()
    assert "| DGNN (PPO) | 2 |" in printed.out
    with open(arguments.out / "seeds.csv") as file:
        assert [(row["seed"], row["frames"], row["starts"]) for row in csv.DictReader(file)] == [
            ("0", "640", "2"),
            ("2", "640", "2"),
        ]
    assert table1.main(replace(arguments, seeds=(0, 2))) == 0  # nothing left to do
    calls = (arguments.runs / "dgnn-wedge-seed0" / "calls").read_text().splitlines()
    assert calls == [f"--formation wedge --seed 0 --threads 1 --out {arguments.runs / 'dgnn-wedge-seed0'}"]


def test_options_reach_the_recipe_and_the_planners(arguments):
    wanted = replace(arguments, only=("dgnn", "uncoordinated"), options="--n-robots 4 --map doorway")
    assert table1.main(wanted) == 0
    assert (arguments.runs / "dgnn-wedge-seed0" / "calls").read_text().endswith("--n-robots 4 --map doorway\n")
    scenario = json.loads((arguments.runs / "uncoordinated-wedge" / "scenario.json").read_text())
    assert (scenario["n_robots"], scenario["obstacle_map"]) == (4, "doorway:evaluation")
    assert (
        "`python recipes/table1.py --seeds 0 --formations wedge --starts 2 '--options=--n-robots 4 --map doorway'`"
        in (arguments.out / "table.md").read_text()
    )


def test_a_new_policy_or_number_of_starts_is_evaluated_again_and_nothing_else(arguments, monkeypatch):
    evaluated = []

    def count(policy, env, seed):
        evaluated.append(env.batch_size[0])
        return {name: torch.ones(env.batch_size[0]) for name in COLUMNS}

    monkeypatch.setattr(table1, "evaluate_teams", count)
    table1.main(arguments)
    table1.main(arguments)
    assert evaluated == [2]
    folder = arguments.runs / "dgnn-wedge-seed0"
    earlier = (folder / "policy.safetensors").stat().st_mtime - 10
    os.utime(folder / "starts-policy.csv", (earlier, earlier))
    table1.main(arguments)
    assert evaluated == [2, 2]
    table1.main(replace(arguments, starts=3))
    table1.main(replace(arguments, starts=3))
    assert evaluated == [2, 2, 3]


def test_results_that_were_kept_without_their_policy_count(arguments):
    table1.main(arguments)
    folder = arguments.runs / "dgnn-wedge-seed0"
    (folder / "policy.safetensors").unlink()
    assert table1.main(arguments) == 0
    assert len((folder / "calls").read_text().splitlines()) == 1


def test_a_policy_that_is_missing_is_trained_again_or_named(arguments, capsys):
    table1.main(arguments)
    folder = arguments.runs / "dgnn-wedge-seed0"
    for name in ("policy.safetensors", "starts-policy.csv"):
        (folder / name).unlink()
    assert table1.main(replace(arguments, train=False)) == 0
    assert f"not trained yet: dgnn:wedge:0, {folder} has no metrics.json or no policy" in capsys.readouterr().err
    assert table1.main(arguments) == 0
    assert (folder / "calls").read_text().splitlines()[-1] == f"--resume {folder}"


def test_a_damaged_policy_fails_alone(arguments, capsys):
    table1.main(replace(arguments, seeds=(0, 2)))
    (arguments.runs / "dgnn-wedge-seed0" / "policy.safetensors").write_bytes(b"no policy")
    assert table1.main(replace(arguments, seeds=(0, 2))) == 1
    assert "failed: dgnn:wedge:0, " in capsys.readouterr().err


def test_a_run_that_another_process_trains_is_left_alone(arguments, capsys):
    folder = arguments.runs / "dgnn-wedge-seed0"
    folder.mkdir(parents=True)
    with open(folder / "output.txt", "a") as output:
        fcntl.flock(output, fcntl.LOCK_EX)
        assert table1.main(arguments) == 1
    assert "failed: dgnn:wedge:0, another process is training it" in capsys.readouterr().err
    assert not (folder / "calls").exists()


def test_parts_of_the_table():
    all_jobs = table1_methods.jobs(("circle", "wedge", "line"), (0, 1, 2), Path("runs"))
    learned = len(table1_methods.METHODS) - 3
    assert len(all_jobs) == len({job.name for job in all_jobs}) == 3 * (learned * 3 + 3)

    def found(*only):
        return [job.name for job in all_jobs if job.matches(only)]

    assert found() == [job.name for job in all_jobs]
    assert found("redig:wedge") == ["redig:wedge:0", "redig:wedge:1", "redig:wedge:2"]
    assert found("redig:line:1", "leader_follower:circle") == ["leader_follower:circle", "redig:line:1"]
    assert found("afor") == [
        f"afor:{formation}:{seed}" for formation in ("circle", "wedge", "line") for seed in range(3)
    ]
    assert found("red") == found("redig:wedge:0:0") == found("leader_follower:circle:0") == []
    cloned = next(job for job in all_jobs if job.name == "cloned:wedge:0")
    assert (cloned.folder.name, cloned.policy.name, cloned.command) == ("redig-wedge-seed0", "cloned.safetensors", ())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"only": ("dgnn", "redgi:wedge")}, "only: got redgi:wedge, must be METHOD, .* redig, "),
        ({"only": ("redig:star",)}, "only: got redig:star"),
        ({"only": ("redig:wedge:7",)}, "only: got redig:wedge:7"),
        ({"seeds": ()}, "seeds: got nothing, must be at least one seed, each once"),
        ({"seeds": (0, 1, 0)}, "seeds: got 0 1 0"),
        ({"formations": ()}, "formations: got nothing"),
        ({"formations": ("star",)}, "formations: got star, must be of wedge, line, circle"),
        ({"parallel": 0}, "parallel: got 0, must be at least 1"),
        ({"starts": 0}, "starts: got 0, must be at least 1"),
    ],
)
def test_bad_options_are_named(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        table1.main(replace(Arguments(runs=tmp_path / "runs", out=tmp_path / "out"), **options))
    assert not list(tmp_path.iterdir())


def test_an_interrupted_table_goes_on(tmp_path, monkeypatch):
    wanted = Arguments(
        only=("dgnn:line:0",), seeds=(0,), formations=("line",), runs=tmp_path / "runs", out=tmp_path / "out", starts=2,
        options="--smoke",
    )  # fmt: skip
    folder, ended = tmp_path / "runs" / "dgnn-line-seed0", threading.Event()

    def interrupt():
        while not any(folder.glob("log/*/scalars/train")):  # until a round of online training, of four, is done
            if ended.wait(0.01):
                return
        os.kill(os.getpid(), signal.SIGTERM)

    previous = signal.signal(signal.SIGTERM, signal.SIG_IGN)  # should it come too late
    watch = threading.Thread(target=interrupt)
    watch.start()
    try:
        with pytest.raises(SystemExit, match="stopped; the same command goes on"):
            table1.main(wanted)
    finally:
        ended.set()
        watch.join()
        signal.signal(signal.SIGTERM, previous)
    assert "stopped at online" in (folder / "output.txt").read_text()
    before = load_checkpoint(folder / "checkpoint.pt")["counters"]
    assert before["online"] < 4 and not (folder / "metrics.json").exists()
    spent = json.loads((folder / "seconds.json").read_text())

    assert table1.main(wanted) == 0
    assert load_checkpoint(folder / "checkpoint.pt")["counters"]["online"] == 4
    assert json.loads((folder / "seconds.json").read_text()) > spent > 0
    assert "| DGNN (PPO) | 1 |" in (tmp_path / "out" / "table.md").read_text()


def test_help_explains_each_option(printed_help):
    printed = printed_help("table1.py")
    for option in ("--only", "--seeds", "--formations", "--runs", "--out", "--parallel", "--no-train", "--options"):
        assert option in printed
