import json
import math

import pytest

from redig.evaluation import format_table, write_metrics

METRICS = {"success_rate": 0.5, "travel_time": math.nan, "jerk_peak": 12.3456, "num_starts": 64.0}


def test_table_has_values_and_units_in_columns():
    lines = format_table(METRICS).splitlines()
    assert [line.split() for line in lines] == [
        ["success_rate", "0.500"],
        ["travel_time", "-", "s"],
        ["jerk_peak", "12.346", "m/s³"],
        ["num_starts", "64"],
    ]
    ends = {line.index(value) + len(value) for line, value in zip(lines, ("0.500", "-", "12.346", "64"), strict=True)}
    assert len(ends) == 1  # right-aligned


def test_table_of_nothing():
    assert format_table({}) == ""


def test_json_round_trip_with_nan_as_null(tmp_path):
    path = tmp_path / "new" / "metrics.json"
    write_metrics(path, METRICS)
    assert json.loads(path.read_text()) == {**METRICS, "travel_time": None}
    write_metrics(str(path), {"success_rate": 1.0})
    assert json.loads(path.read_text()) == {"success_rate": 1.0}
    assert list(path.parent.iterdir()) == [path]


def test_failed_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "metrics.json"
    write_metrics(path, METRICS)
    before = path.read_text()
    with pytest.raises(ValueError):
        write_metrics(path, {"success_rate": math.inf})
    assert path.read_text() == before
    assert list(tmp_path.iterdir()) == [path]
