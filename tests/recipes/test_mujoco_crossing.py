import csv
from pathlib import Path

import pytest
import torch
from mujoco_crossing import Arguments, main, tracking
from tensordict import TensorDict

WEDGE = Path(__file__).parents[2] / "recipes/policies/wedge.safetensors"


def test_cases_are_written_with_spread_and_a_crossing_is_drawn(tmp_path):
    main(Arguments(WEDGE, starts=2, seed=1_000_011, cases=("VMAS", "grip 0.2"), out=tmp_path))
    rows = list(csv.DictReader((tmp_path / "wedge.csv").read_text().splitlines()))
    assert [row["case"] for row in rows] == ["VMAS", "grip 0.2"]
    assert all(float(row["success_rate"]) == 1.0 for row in rows)
    assert float(rows[1]["travel_time"]) > float(rows[0]["travel_time"])  # wheels that slip are slower
    assert float(rows[0]["error_across"]) < float(rows[1]["error_across"])
    assert {path.name for path in tmp_path.iterdir()} == {"wedge.csv", "wedge.png", "wedge.mp4"}


def test_in_slow_motion_ice_is_no_ice(tmp_path):
    options = {"starts": 1, "seed": 1_000_011, "cases": ("grip 0.05",), "out": tmp_path, "film": "none"}
    fast, slow = (main(Arguments(WEDGE, pace=pace, **options))[0] for pace in (1.0, 0.5))
    assert fast["team_success_rate"] == 0.0 and slow["team_success_rate"] == 1.0


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
