import dataclasses
import json

import pytest
import redig_wedge
import table1
import tyro
from ablations import Arguments
from config import COORDINATED, PAPER, SMOKE, Config
from table1_methods import ABLATIONS, METHODS, find, jobs
from table1_report import write_report
from test_table1_report import fake_run

from redig.policy import read_header

DEFAULT = Config().resolve()


@pytest.mark.parametrize("name", sorted(ABLATIONS.keys() - {"redig"}))
def test_each_is_the_default_recipe_with_what_its_options_say_changed(name):
    options = find(name).options
    given = tyro.cli(Config, args=list(options)).resolve()
    fields = [field.name for field in dataclasses.fields(Config)]
    changed = {field for field in fields if getattr(given, field) != getattr(DEFAULT, field)}
    named = {option[2:].replace("-", "_").removeprefix("no_") for option in options if option.startswith("--")}
    preset = PAPER if given.paper else COORDINATED if given.coordinated else {}
    assert changed == named | {field for field, value in preset.items() if value != getattr(DEFAULT, field)}


def test_presets_exclude_each_other():
    with pytest.raises(ValueError, match="paper: its robots are not coordinated"):
        Config(paper=True, coordinated=True).resolve()


def test_runs_of_the_table_are_not_made_twice(tmp_path):
    of_table = {job.folder for job in jobs(("wedge",), (0,), tmp_path)}
    of_ablations = {job.method: job.folder for job in jobs(("wedge",), (0,), tmp_path, ABLATIONS)}
    assert of_ablations.keys() == ABLATIONS.keys()
    for name, folder in of_ablations.items():
        assert (folder in of_table) == (name in METHODS)


def test_a_table_of_ablations_names_its_command(tmp_path, monkeypatch):
    runs = tmp_path / "runs"
    for job in jobs(("wedge",), (0,), runs, ABLATIONS):
        if job.method in ("redig", "no_layer_norm"):
            fake_run(job, 1.0, 7.0)
    written = []
    monkeypatch.setattr(
        table1, "write_report", lambda out, done, command: written.append(write_report(out, done, command)) or ""
    )
    arguments = Arguments(seeds=(0,), runs=runs, out=tmp_path / "out", train=False)
    assert table1.main(arguments, ABLATIONS, "recipes/ablations.py") == 0
    lines = written[0].splitlines()
    assert lines[0] == "`python recipes/ablations.py --seeds 0`"
    assert any(line.startswith("| critics without LayerNorm | 1 |") for line in lines)


def test_the_paper_as_printed_trains_at_toy_size(tmp_path, monkeypatch):
    for name, value in {"env_steps": 20, "evaluation_starts": 2, "num_starts": 2, "num_envs": 4}.items():
        monkeypatch.setitem(SMOKE, name, value)  # a hundred steps of the chain for each action take long
    redig_wedge.train(Config(paper=True, smoke=True, out=tmp_path / "run", threads=1))
    policy, scenario = read_header(tmp_path / "run" / "policy.safetensors")
    assert (policy.encoder, policy.encoder_activation, policy.sampling_steps, policy.noise_ratio) == (
        "linear",
        None,
        100,
        1,
    )
    assert (policy.observation_dim, scenario["formation_reward"], scenario["navigation_reward"]) == (
        7,
        "spring_damper",
        "goal_speed",
    )
    saved = json.loads((tmp_path / "run" / "config.json").read_text())
    assert all(saved[name] == value for name, value in PAPER.items() if name not in SMOKE)


def test_a_run_from_before_there_was_a_choice_goes_on_as_it_was(tmp_path):
    config = Config(resume=tmp_path)
    given = dataclasses.asdict(Config(seed=3).resolve())
    (tmp_path / "config.json").write_text(json.dumps(given))
    assert (config.saved().direction_smoothing, config.saved().formation_tolerance) == (0.05, 0.25)
    old = {name: value for name, value in given.items() if name not in ("direction_smoothing", "formation_tolerance")}
    (tmp_path / "config.json").write_text(json.dumps(old))
    assert (config.saved().direction_smoothing, config.saved().formation_tolerance) == (0.0, 0.5)
    assert config.saved().seed == 3


def test_each_formation_has_the_demonstrations_that_suit_it():
    speeds = {name: Config(formation=name).resolve().demonstration_speed for name in ("wedge", "circle", "line")}
    assert speeds == {"wedge": (0.9, 1.0), "circle": (0.9, 1.0), "line": (0.5, 1.0)}
    assert Config(formation="line", demonstration_speed=(0.8, 0.9)).resolve().demonstration_speed == (0.8, 0.9)
    assert Config(coordinated=True).resolve().demonstration_speed == (1.0, 1.0)
