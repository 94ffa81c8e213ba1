import csv

import control
import pytest


def test_toy_run(tmp_path):
    arguments = control.Arguments(steps=(3, 2), starts=2, repeats=2, out=tmp_path)
    rates, quality = control.main(arguments)
    assert [row["steps"] for row in rates] == [row["steps"] for row in quality] == [3, 2]
    assert all(row[f"{form} (Hz)"] > 0 for row in rates for form in ("team, module", control.TEAM, control.ROBOT))
    assert quality[0]["team_success_rate"] == 1
    for name in ("control", "control_quality"):
        with open(tmp_path / f"{name}.csv") as file:
            assert len(list(csv.DictReader(file))) == 2


def test_distance_to_the_reference():
    reference = {"success_rate": 0.5, "cfi_0.5": 0.8, "jerk_mean": 2.0}
    row = control.beside({"success_rate": 0.51, "cfi_0.5": 0.84, "jerk_mean": 1.5}, reference)
    assert row["success (points)"] == pytest.approx(1) and row["CFI (%)"] == pytest.approx(5)
    assert row["jerk (%)"] == pytest.approx(-25)
