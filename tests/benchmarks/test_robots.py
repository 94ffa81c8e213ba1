import csv

import pytest
import robots


def test_toy_run(tmp_path):
    arguments = robots.Arguments(steps=(3,), rates=(50.0,), kinds=("onnx",), robots=2, seconds=0.2, out=tmp_path)
    (row,) = robots.main(arguments)
    assert row["file"] == "onnx" and row["steps"] == 3 and 0 < row["rate (Hz)"] <= 50
    assert 0 < row["p50 (ms)"] <= row["p99 (ms)"] <= row["max (ms)"] and 0 <= row["late (%)"] <= 100
    assert row["cpu (ms/action)"] > 0 and row["memory (MiB)"] > 10
    with open(tmp_path / "rates.csv") as file:
        assert len(list(csv.DictReader(file))) == 1


def test_of_robots_the_worst():
    measured = [
        {"rate (Hz)": 20.0, "p50 (ms)": 3.0, "max (ms)": 9.0},
        {"rate (Hz)": 19.0, "p50 (ms)": 1.0, "max (ms)": 8.0},
    ]
    assert robots.worst(measured) == {"rate (Hz)": 19.0, "p50 (ms)": 2.0, "max (ms)": 9.0}


def test_a_process_that_fails_is_not_passed_over(tmp_path):
    with pytest.raises(RuntimeError, match="ended before it was ready"):
        robots.run_team(robots.Arguments(robots=1), tmp_path / "no.onnx", 20.0)
