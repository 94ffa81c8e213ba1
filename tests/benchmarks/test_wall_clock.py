import csv

import pytest
from wall_clock import TARGETS, Arguments, main, reached, timed_run

# a recipe that writes three evaluations, half a second apart
RECIPE = """
import csv, json, sys, time
from pathlib import Path
out = Path(sys.argv[sys.argv.index("--out") + 1])
out.mkdir()
rows = [dict(phase="clone", updates=0, success_rate=0.5), dict(phase="online", updates=100, success_rate=0.99),
        dict(phase="online", updates=200, success_rate=1.0)]
for i, row in enumerate(rows):
    row |= {"team_success_rate": 1.0, "travel_time": 7.0, "cfi_0.5": 0.95, "jerk_mean": 1.0}
    time.sleep(0.5)
    with open(out / "evaluations.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(row)); writer.writeheader(); writer.writerows(rows[: i + 1])
time.sleep(0.5)
(out / "metrics.json").write_text(json.dumps({**rows[-1], "travel_time": 8.0}))
"""


@pytest.fixture
def checkout(tmp_path):
    (tmp_path / "recipes").mkdir()
    (tmp_path / "recipes/redig_wedge.py").write_text(RECIPE)
    return tmp_path


def test_times_are_those_of_the_evaluations(checkout):
    row, curve = timed_run(checkout, seed=3, threads=1, options=())
    first, second, third = (evaluation["seconds"] for evaluation in curve)
    assert row["to 99 % success (s)"] == second < row["to all targets (s)"] == third < row["whole run (s)"]
    assert second - first > 0.25
    assert not row["final: all targets"]  # the travel time of the final evaluation


def test_a_run_can_be_stopped_once_all_targets_are_reached(checkout):
    row, curve = timed_run(checkout, seed=0, threads=1, until_targets=True)
    assert len(curve) == 3 and row["whole run (s)"] == "stopped"
    assert row["to all targets (s)"] == curve[-1]["seconds"] and row["success_rate"] == ""


def test_a_run_that_fails_says_why(checkout):
    (checkout / "recipes/redig_wedge.py").write_text("raise SystemExit('no corridor')")
    with pytest.raises(RuntimeError, match="no corridor"):
        timed_run(checkout, seed=0, threads=1, options=())


def test_both_recipes_are_in_the_table(checkout, tmp_path, monkeypatch):
    monkeypatch.setattr("wall_clock.ROOT", checkout)
    main(Arguments(seeds=(0,), before=checkout, threads=1, out=tmp_path / "out"))
    with open(tmp_path / "out/wall_clock.csv") as file:
        assert [row["recipe"] for row in csv.DictReader(file)] == ["this version", "before"]
    with open(tmp_path / "out/wall_clock_curves.csv") as file:
        assert len(list(csv.DictReader(file))) == 6


@pytest.mark.parametrize("name", TARGETS)
def test_each_target_counts(name):
    good = {"success_rate": 1.0, "team_success_rate": 1.0, "travel_time": 7.0, "cfi_0.5": 0.92, "jerk_mean": 1.5}
    assert reached(good)
    worse = 0.5 if TARGETS[name][1] else 9.0
    assert not reached({**good, name: worse})
    assert not reached({**good, name: float("nan")})
