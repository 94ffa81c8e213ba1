import runpy
import sys

import config
import pytest
import redig_wedge
from conftest import RECIPES

from redig.policy import read_header


@pytest.mark.parametrize(
    ("formation", "n_robots"), [("line", 4), ("wedge", 3), ("wedge", 6), ("circle", 3), ("circle", 6)]
)
def test_teams_of_other_sizes_train(tmp_path, monkeypatch, formation, n_robots):
    monkeypatch.setattr(redig_wedge, "finish", lambda run, config: {})
    tiny = {"num_trajectories": 4 * n_robots, "clone_updates": 2, "critic_updates": 4, "env_steps": 20}
    monkeypatch.setattr(config, "SMOKE", config.SMOKE | tiny)
    redig_wedge.train(
        config.Config(smoke=True, formation=formation, n_robots=n_robots, out=tmp_path / "run", threads=1)
    )
    _, scenario = read_header(tmp_path / "run" / "last.safetensors")
    assert (scenario["formation"], scenario["n_robots"]) == (formation, n_robots)


@pytest.mark.parametrize("formation", ["line", "circle"])
def test_a_preset_is_the_same_training_with_another_formation(monkeypatch, printed_help, formation):
    trained = []
    monkeypatch.setattr(redig_wedge, "train", trained.append)
    recipe = str(RECIPES / f"redig_{formation}.py")
    monkeypatch.setattr(sys, "argv", [recipe, "--n-robots", "4"])
    runpy.run_path(recipe, run_name="__main__")
    assert trained == [config.Config(formation=formation, n_robots=4)]
    assert "--n-robots" in printed_help(f"redig_{formation}.py")
