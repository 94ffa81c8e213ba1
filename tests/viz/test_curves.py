import math

import numpy as np
import pytest
from PIL import Image

from redig.viz import plot_learning_curves


def row(updates: float, travel_time: float | None = 9.0) -> dict:
    level = 1 - math.exp(-updates / 1000)
    metrics = {
        "success_rate": level,
        "team_success_rate": level**2,
        "cfi_0.5": 0.7 + 0.2 * level,
        "jerk_mean": 1 + level,
    }
    return {"updates": updates, "travel_time": travel_time, **metrics}


def test_curves_with_gaps(tmp_path):
    path = tmp_path / "curves.png"
    rows = [row(0, None), row(500, math.nan), *(row(500.0 * k) for k in range(2, 8))]
    plot_learning_curves(path, rows)
    with Image.open(path) as image:
        assert image.size == (1400, 840)
        assert np.asarray(image.convert("L")).min() < 60
    assert list(tmp_path.iterdir()) == [path]


def test_one_row_is_enough(tmp_path):
    plot_learning_curves(tmp_path / "curves.pdf", [row(0)])
    assert (tmp_path / "curves.pdf").read_bytes().startswith(b"%PDF")


def test_lines_hold_the_data(monkeypatch, tmp_path):
    from matplotlib.figure import Figure

    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **_: (figures.append(self), path.write_text("")))
    rows = [row(0, 11.0), row(1000), row(2000)]
    plot_learning_curves(tmp_path / "curves.png", rows)
    drawn = {axes.get_title(loc="left"): axes.lines for axes in figures[0].axes}
    (curve, reference) = drawn["travel time (s)"]
    assert list(curve.get_xdata()) == [0, 1000, 2000]
    assert list(curve.get_ydata()) == [11.0, 9.0, 9.0]
    assert list(reference.get_ydata()) == [11.0, 11.0]  # the cloned policy
    assert reference.get_linestyle() == "--"
    robots, _, teams, _ = drawn["success rate"]
    assert list(robots.get_ydata()) == [r["success_rate"] for r in rows]
    assert list(teams.get_ydata()) == [r["team_success_rate"] for r in rows]


def test_bad_rows_and_suffix(tmp_path):
    with pytest.raises(ValueError, match="runs: got none"):
        plot_learning_curves(tmp_path / "curves.png", [])
    with pytest.raises(ValueError, match="runs: they were evaluated after different numbers of updates"):
        plot_learning_curves(tmp_path / "curves.png", [row(0), row(500)], [row(0), row(600)])
    with pytest.raises(ValueError, match=r"path: got 'curves.mp4'"):
        plot_learning_curves(tmp_path / "curves.mp4", [row(0)])
    with pytest.raises(KeyError, match="jerk_mean"):
        plot_learning_curves(tmp_path / "curves.png", [{k: v for k, v in row(0).items() if k != "jerk_mean"}])
    assert list(tmp_path.iterdir()) == []


def test_several_runs_are_drawn_with_their_mean(monkeypatch, tmp_path):
    from matplotlib.figure import Figure

    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **_: (figures.append(self), path.write_text("")))
    plot_learning_curves(tmp_path / "curves.png", [row(0, 9.0), row(500, 8.0)], [row(0, 11.0), row(500, 6.0)])
    lines = [list(line.get_ydata()) for line in figures[0].axes[1].lines]
    assert [9.0, 8.0] in lines and [11.0, 6.0] in lines and [10.0, 7.0] in lines
