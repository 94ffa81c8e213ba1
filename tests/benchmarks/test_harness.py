import csv
import math
import re

import harness
import pytest
import torch
from harness import Timing, alternate, machine, ratio, report
from hypothesis import given
from hypothesis import strategies as st


class Clock:
    """A clock that only moves when a call says how long it took."""

    def __init__(self, monkeypatch):
        self.now, self.order = 0.0, []
        monkeypatch.setattr(harness.time, "perf_counter", lambda: self.now)

    def call(self, name, *seconds):
        """Takes the given times in turn; the last one for ever after."""
        left = list(seconds)

        def run():
            self.order.append(name)
            self.now += left.pop(0) if len(left) > 1 else left[0]

        return run


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


def test_calls_alternate_and_short_ones_repeat(clock):
    timings = alternate({"a": clock.call("a", 5.0, 0.25), "b": clock.call("b", 1.0)}, repeats=2, seconds=1.0)
    once = ["a"] * 4 + ["b"]  # four calls of a fit into a second, one of b
    assert clock.order == ["a", "a", "b", "b", *once, *once, *once]  # the first round does not count
    assert timings["a"] == Timing((0.25, 0.25), first=5.0)
    assert timings["b"] == Timing((1.0, 1.0), first=1.0)


def test_a_call_longer_than_a_repetition_runs_once(clock):
    assert alternate({"long": clock.call("long", 30.0)}, repeats=3, seconds=0.1)["long"].seconds == (30.0,) * 3
    assert len(clock.order) == 2 + 4


def test_the_first_repetition_does_not_count(clock):
    slow_at_first = clock.call("a", 1.0, 1.0, 9.0, 1.0)
    assert alternate({"a": slow_at_first}, repeats=2, seconds=1.0)["a"].seconds == (1.0, 1.0)


def test_a_failing_call_is_not_hidden():
    with pytest.raises(ZeroDivisionError):
        alternate({"bad": lambda: 1 / 0}, repeats=1)


def test_the_ratio_is_taken_pair_by_pair():
    drifting, twice = Timing((1.0, 10.0, 100.0), 0.0), Timing((2.0, 20.0, 200.0), 0.0)
    assert ratio(drifting, twice) == 0.5
    other = Timing((1.0, 2.0, 400.0), 0.0)
    assert ratio(drifting, other) == 1.0  # the median of 1, 5 and 1/4; that of the medians would be 5


@given(st.lists(st.floats(1e-6, 1e3), min_size=1), st.floats(0.1, 10))
def test_the_ratio_of_a_machine_that_drifts(seconds, factor):
    one = Timing(tuple(s * factor for s in seconds), 0.0)
    assert math.isclose(ratio(one, Timing(tuple(seconds), 0.0)), factor)


def test_timings_of_different_length_have_no_ratio():
    with pytest.raises(ValueError, match="shorter"):
        ratio(Timing((1.0, 2.0), 0.0), Timing((1.0,), 0.0))


def test_quartiles():
    timing = Timing((4.0, 1.0, 2.0, 3.0, 5.0, 6.0, 7.0), 0.0)
    assert (timing.median, timing.quartiles) == (4.0, (2.0, 6.0))


def test_report_writes_both_files(tmp_path, capsys):
    rows = [{"form": "eager", "ms": 12.345678}, {"form": "graph", "ms": 0.5, "gain": 24}]
    report(tmp_path / "new", "speed", rows, notes=["First.", "Second."], threads=3)
    with open(tmp_path / "new" / "speed.csv") as file:
        read = list(csv.DictReader(file))
    assert read == [{"form": "eager", "ms": "12.345678", "gain": ""}, {"form": "graph", "ms": "0.5", "gain": "24"}]
    text = (tmp_path / "new" / "speed.md").read_text()
    table = "| form | ms | gain |\n|---|---|---|\n| eager | 12.35 |  |\n| graph | 0.5 | 24 |\n"
    assert text.startswith(f"Machine: {machine(3)}.\n\n{table}")
    assert text.endswith("\n\nFirst.\n\nSecond.\n")
    assert text in capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["speed.csv", "speed.md"]


def test_the_machine_is_described():
    assert re.search(rf"\d+ thread\(s\), .*Python 3.*, torch {re.escape(torch.__version__)}", machine())
    assert ", 7 thread(s), " in machine(7)
