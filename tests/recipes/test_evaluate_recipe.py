import json
import subprocess
from pathlib import Path

import evaluate
import pytest
from config import Config
from conftest import command
from PIL import Image

SHIPPED = Path(evaluate.__file__).parent / "policies" / "wedge.safetensors"


def test_the_command_evaluates_a_policy_file(smoke, tmp_path):
    folder, _ = smoke
    out = tmp_path / "evaluation"
    done = subprocess.run(
        command("evaluate.py", folder / "policy.safetensors", "--starts", 4, "--seed", 3, "--out", out),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["num_starts"] == 4
    assert "team_success_rate" in done.stdout
    with Image.open(out / "trajectories.gif") as film:
        assert film.n_frames > 10


def test_the_shipped_policy_brings_its_teams_home(tmp_path):
    arguments = evaluate.Arguments(SHIPPED, starts=32, seed=77, out=tmp_path, animation=False)
    metrics = evaluate.main(arguments)
    assert metrics["team_success_rate"] == 1.0
    assert metrics["cfi_0.5"] > 0.85
    again = evaluate.main(arguments)
    assert again == metrics


def test_bad_input_is_named(tmp_path, smoke):
    folder, _ = smoke
    with pytest.raises(FileNotFoundError, match="policy: no such file"):
        evaluate.main(evaluate.Arguments(tmp_path / "none.safetensors"))
    with pytest.raises(ValueError, match="starts: got 0"):
        evaluate.main(evaluate.Arguments(folder / "policy.safetensors", starts=0))
    with pytest.raises(ValueError, match="not a safetensors file"):
        evaluate.main(evaluate.Arguments(folder / "config.json"))


@pytest.mark.parametrize(
    "options",
    [
        {"sampler": "dpmsolver", "sampling_steps": 3},
        {"sampler": "ddim", "eta": 0.5, "stochastic": True},
        {"fixed_latent": True},
        {"warm_start": 40, "stochastic": True, "noise_ratio": 1.0},
    ],
    ids=str,
)
def test_sampling_options(options, tmp_path):
    arguments = evaluate.Arguments(SHIPPED, starts=8, seed=78, out=tmp_path, animation=False, **options)
    metrics = evaluate.main(arguments)
    assert metrics["team_success_rate"] == 1.0
    plain = evaluate.main(evaluate.Arguments(SHIPPED, starts=8, seed=78, out=tmp_path, animation=False))
    assert metrics["jerk_mean"] != plain["jerk_mean"]
    assert "best_of_n" not in plain


def test_best_of_n_is_stated(smoke, tmp_path, capsys):
    folder, _ = smoke
    policy = folder / "policy.safetensors"
    options = {"starts": 2, "out": tmp_path, "animation": False, "best_of_n": 3}
    evaluate.main(evaluate.Arguments(policy, critics=folder, **options))
    assert json.loads((tmp_path / "metrics.json").read_text())["best_of_n"] == 3
    assert "best of 3 actions by min Q" in capsys.readouterr().out
    with pytest.raises(ValueError, match="critics: --best-of-n needs the run"):
        evaluate.main(evaluate.Arguments(policy, **options))
    with pytest.raises(FileNotFoundError, match="critics: .* holds no run with a checkpoint"):
        evaluate.main(evaluate.Arguments(policy, critics=tmp_path, **options))


def test_maps_are_named_in_options_and_stay_json(tmp_path):
    assert "obstacle_map" not in Config().scenario()
    forest = Config(map="forest")
    assert json.loads(json.dumps(forest.scenario()))["obstacle_map"] == "forest:train"
    assert forest.scenario("evaluation")["obstacle_map"] == "forest:evaluation"
    assert Config(map="rooms/hall.yaml").scenario("evaluation")["obstacle_map"] == "rooms/hall.yaml"
    metrics = evaluate.main(evaluate.Arguments(SHIPPED, starts=4, out=tmp_path, map="bollards", animation=False))
    plain = evaluate.main(evaluate.Arguments(SHIPPED, starts=4, out=tmp_path, animation=False))
    assert metrics != plain
    with pytest.raises(ValueError, match="obstacle_map: got 'maze', must be KIND:SPLIT"):
        evaluate.main(evaluate.Arguments(SHIPPED, starts=4, out=tmp_path, map="maze"))
