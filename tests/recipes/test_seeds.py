import csv
import json
import shutil

import pytest
import seeds


@pytest.fixture
def runs(smoke, tmp_path):
    """Two runs whose metrics differ by a known amount."""
    folders = []
    for seed, shift in ((0, 0.0), (1, 0.5)):
        folder = tmp_path / f"run{seed}"
        folder.mkdir()
        shutil.copy(smoke[0] / "evaluations.csv", folder)
        config = json.loads((smoke[0] / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps({**config, "seed": seed}))
        metrics = json.loads((smoke[0] / "metrics.json").read_text())
        metrics |= {"success_rate": 0.25 + shift, "cloned_travel_time": None}
        (folder / "metrics.json").write_text(json.dumps(metrics))
        folders.append(folder)
    return folders


def test_summary_of_two_seeds(runs, tmp_path):
    table = seeds.main(seeds.Arguments(tuple(runs), out=tmp_path / "summary"))
    assert "| success_rate | " in table and "| 0.500 ± 0.354 |" in table  # sd of 0.25 and 0.75
    assert "| travel_time | - |" in table
    with open(tmp_path / "summary" / "seeds.csv") as file:
        assert [row["seed"] for row in csv.DictReader(file)] == ["0", "1"]
    with open(tmp_path / "summary" / "curves.csv") as file:
        assert [row["seed"] for row in csv.DictReader(file)] == ["0", "0", "0", "1", "1", "1"]
    assert (tmp_path / "summary" / "curves.png").stat().st_size > 10_000
