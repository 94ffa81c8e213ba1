import csv
import json
import math

import numpy as np
import pytest
import table1_report
from scipy import stats
from table1_methods import METHODS, jobs
from table1_report import COLUMNS, PAPER, bootstrap

RNG = np.random.default_rng(0)


def test_the_interval_of_one_seed_is_the_percentile_bootstrap_of_scipy():
    values = RNG.exponential(size=256)
    mean, low, high = bootstrap([values], resamples=10_000)
    other = stats.bootstrap((values,), np.mean, method="percentile", n_resamples=10_000, rng=1).confidence_interval
    assert mean == pytest.approx(values.mean())
    assert (low, high) == pytest.approx((other.low, other.high), abs=0.05 * (other.high - other.low))


def test_the_interval_of_several_seeds_has_the_spread_of_both_levels():
    runs = [RNG.normal(centre, 3.0, size=50) for centre in RNG.normal(size=40)]
    mean, low, high = bootstrap(runs, resamples=10_000)
    within = np.mean([run.var() / len(run) for run in runs])
    error = math.sqrt((np.var([run.mean() for run in runs]) + within) / len(runs))
    assert (high - low) / 2 == pytest.approx(1.96 * error, rel=0.05)
    assert mean == pytest.approx(np.concatenate(runs).mean())


def test_seeds_that_disagree_widen_the_interval_that_more_starts_would_shrink():
    together = bootstrap([np.full(100, value) for value in (1.0, 2.0, 3.0)])
    assert together[0] == pytest.approx(2.0) and (together[1], together[2]) == (1.0, 3.0)
    assert bootstrap([np.full(100, 2.0)]) == (2.0, 2.0, 2.0)


def test_starts_without_a_metric_are_left_out():
    times = np.array([7.0, math.nan, 7.0, math.nan])
    assert bootstrap([times]) == (7.0, 7.0, 7.0)
    assert bootstrap([times, np.full(4, math.nan)])[0] == 7.0
    assert all(map(math.isnan, bootstrap([np.full(4, math.nan)])))
    found = RNG.normal(size=300)
    sparse = np.concatenate([found, np.full(100, math.nan)])
    _, low, high = bootstrap([sparse], resamples=10_000)
    assert high - low == pytest.approx(2 * 1.96 * found.std() / math.sqrt(300), rel=0.06)


def fake_run(job, success, time):
    """A finished run: its cost, and four starts of which the last has no travel time."""
    job.folder.mkdir(parents=True, exist_ok=True)
    rows = [dict.fromkeys(COLUMNS, 0.5) | {"success_rate": success, "travel_time": time} for _ in range(4)]
    rows[-1]["travel_time"] = math.nan
    with open(job.starts_file, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    if job.command:
        (job.folder / "config.json").write_text(json.dumps({"frames": 217_600}))
        job.add_seconds(90.0)


@pytest.fixture
def table(tmp_path):
    """A table of all methods, of which deterministic actors are fastest but fail too often: its lines."""
    done = jobs(("circle", "wedge", "line"), (0, 1), tmp_path)
    for job in done:
        success, time = {"deterministic": (0.94, 5.0), "redig": (1.0, 6.0), "cloned": (0.5, 9.0)}.get(
            job.method, (0.96, 8.0)
        )
        fake_run(job, success, time)
    return table1_report.write_report(tmp_path / "out", done, "python recipes/table1.py --seeds 0 1").splitlines()


def test_a_table_of_all_methods_has_them_in_order_with_the_papers_numbers(table, tmp_path):
    for formation in ("circle", "wedge", "line"):
        there = [method for method in METHODS.values() if formation in method.formations]
        start = table.index(f"### {formation.capitalize()}") + 4
        rows = [
            [cell.strip() for cell in line.split("|")[1:-1]] for line in table[start : start + len(there) + len(PAPER)]
        ]
        titles = [row[0] for row in rows if "paper" not in row[0]]
        assert titles == [method.title for method in there]
        heads = [cell.strip() for cell in table[start - 2].split("|")[1:-1]]
        assert all(len(row) == len(heads) for row in rows)
        for method, numbers in PAPER.items():
            row = rows[[row[0] for row in rows].index(METHODS[method].title) + 1]
            shown = [row[heads.index(head)] for head in ("robots (%)", "TT (s)", "CFI 0.5", "CFI 0.1", "CFI 0.03")]
            assert [cell.removesuffix("</span>").rpartition(">")[2] for cell in shown] == [
                f"{number:g}" for number in numbers[formation]
            ]
    with open(tmp_path / "out" / "seeds.csv") as file:
        written = list(csv.DictReader(file))
    planned = {"leader_follower", "uncoordinated", "virtual_structure"}  # no seeds
    runs = [len(method.formations) * (1 if name in planned else 2) for name, method in METHODS.items()]
    assert len(written) == sum(runs)
    assert {row["seed"] for row in written if row["method"] == "leader_follower"} == {""}
    assert {float(row["travel_time"]) for row in written if row["method"] == "redig"} == {6.0}


def test_the_head_says_what_made_the_table(table):
    assert table[0] == "`python recipes/table1.py --seeds 0 1`"
    assert table[2].startswith("Training seeds 0, 1; 4 starts (seed 2,000,000)")


def test_the_fastest_of_those_that_arrive_is_bold(table):
    bold = [line for line in table if "**" in line]
    assert len(bold) == 3 and all(line.startswith("| ReDiG | 2 |") for line in bold)
    assert all("| **6.00 [6.00, 6.00]** |" in line for line in bold)


def test_cost_is_that_of_what_was_trained(table):
    ends = {
        line.split("|")[1].strip(): [cell.strip() for cell in line.split("|")[-3:-1]] for line in table if "|" in line
    }
    assert ends["ReDiG"] == ["217,600", "1.5"]
    assert ends["ReDiG before online training"] == ends["L&F"] == ["", ""]


def test_nothing_finished_gives_an_empty_table(tmp_path):
    assert "Training seeds none; no starts" in table1_report.write_report(tmp_path, [], "python recipes/table1.py")
