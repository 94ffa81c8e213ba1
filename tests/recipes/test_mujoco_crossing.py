import csv
from pathlib import Path

import pytest
import torch
from mujoco_crossing import Arguments, case, main, tracking
from tensordict import TensorDict

from redig.policy import read_header

WEDGE = Path(__file__).parents[2] / "recipes/policies/wedge.safetensors"


def test_cases_are_written_with_spread_and_a_crossing_is_drawn(tmp_path):
    main(Arguments(WEDGE, starts=2, seed=1_000_011, cases=("VMAS", "grip 0.2"), out=tmp_path))
    rows = list(csv.DictReader((tmp_path / "wedge.csv").read_text().splitlines()))
    assert [row["case"] for row in rows] == ["VMAS", "grip 0.2"]
    assert all(float(row["success_rate"]) == 1.0 for row in rows)
    assert float(rows[1]["travel_time"]) > float(rows[0]["travel_time"])  # wheels that slip are slower
    assert float(rows[0]["error_across"]) < float(rows[1]["error_across"])
    assert {path.name for path in tmp_path.iterdir()} == {"wedge.csv", "wedge.png", "wedge.mp4"}


@pytest.mark.parametrize("name", ["0.5 m/s", "limo, 0.5 m/s", "grip 0.05, 0.5 m/s"])
def test_slow_teams_are_slow_and_what_they_are_called_besides(name):
    _, scenario = read_header(WEDGE)
    env = case(name, scenario, 1)
    env.set_seed(0)
    env.rollout(1)
    assert env.scenario.motion.speed.unique().item() == 0.5
    assert env.scenario.drives[0][0].base.max_angular == (1.0 if "limo" in name else 6.0)
    plain = case("MuJoCo", scenario, 1).scenario
    assert (env.scenario.teams[0].model.geom_friction != plain.teams[0].model.geom_friction).any() == ("grip" in name)


def test_tracking_of_a_robot_that_makes_half_of_each_step_and_drifts():
    command = torch.rand(1, 9, 2, 2, generator=torch.Generator().manual_seed(0)) + 0.5
    velocity = torch.zeros(1, 9, 2, 2)
    for t in range(1, 9):
        velocity[:, t] = (velocity[:, t - 1] + command[:, t]) / 2
    never = torch.zeros(1, 9, 2, dtype=torch.bool)
    team = {"command": command, "velocity": velocity, "arrived": never, "mask": ~never[..., 0]}
    figures = tracking(TensorDict(team, [1, 9]))
    assert figures["response"].item() == pytest.approx(0.5, abs=1e-5)
    error = (velocity - command)[:, 1:].square().sum(-1).mean().sqrt()
    parts = figures["error_along"].square() + figures["error_across"].square()
    assert parts.sqrt().item() == pytest.approx(error.item(), rel=1e-4)


def test_an_unknown_case_is_named(tmp_path):
    with pytest.raises(ValueError, match="cases: got 'moon'"):
        main(Arguments(WEDGE, starts=1, cases=("moon",), out=tmp_path))
