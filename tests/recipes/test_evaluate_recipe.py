import json
import subprocess
from pathlib import Path

import evaluate
import pytest
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
