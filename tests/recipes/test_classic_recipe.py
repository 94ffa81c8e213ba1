import json
import subprocess

import classic
import pytest
from conftest import command
from PIL import Image


def test_the_command_evaluates_a_baseline(tmp_path):
    options = ("--method", "virtual_structure", "--formation", "line", "--starts", 4, "--out", tmp_path)
    done = subprocess.run(command("classic.py", *options), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["num_starts"] == 4 and metrics["team_success_rate"] == 1.0
    assert "team_success_rate" in done.stdout
    with Image.open(tmp_path / "trajectories.gif") as film:
        assert film.n_frames > 10
    assert (tmp_path / "trajectories.png").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "uncoordinated", "starts": 0}, "starts: got 0"),
        ({"method": "uncoordinated", "delay_cost": 0.1}, "delay_cost: it is an option of virtual_structure"),
        ({"method": "uncoordinated", "formation": "heap"}, "formation: got 'heap'"),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        classic.main(classic.Arguments(**arguments))
