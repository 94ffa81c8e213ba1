"""The figures of a paper: what they hold, that they are written in their true size, what they refuse."""

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch
from PIL import Image

from redig.envs import OccupancyMap, corridor, formation_offsets
from redig.viz import plot_comparison, plot_denoising, plot_importance, plot_jerk
from redig.viz.panels import ONE_COLUMN, TWO_COLUMNS, panel_grid


@pytest.fixture
def kept(monkeypatch):
    """The figures that would have been written."""
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **_: (figures.append(self), path.write_text("")))
    return figures


def crosses(axes):
    """Where collisions are marked."""
    (marks,) = [c for c in axes.collections if c.get_zorder() == 7]
    return marks.get_offsets()


def test_comparison_shows_every_method_at_the_same_times(kept, tmp_path, squeeze):
    position = {"quick": squeeze(samples=41), "slow": squeeze(samples=71)}
    collision = {name: torch.zeros(places.shape[:2], dtype=torch.bool) for name, places in position.items()}
    collision["slow"][10:20, 3] = True  # one long contact
    collision["slow"][[30, 32], 4] = True  # two short ones
    plot_comparison(tmp_path / "a.png", position, collision, "wedge", corridor(), goal=position["quick"][-1])
    quick, slow = kept[0].axes
    assert [axes.get_title(loc="left") for axes in (quick, slow)] == ["quick", "slow"]
    assert quick.get_xlim() == slow.get_xlim()
    assert quick.get_ylim() == slow.get_ylim()
    times = [[text.get_text() for text in axes.texts if text.get_text().endswith("s")] for axes in (quick, slow)]
    assert times == [["0 s", "1 s", "2 s", "3 s", "4 s"], ["0 s", "1 s", "2 s", "3 s", "7 s"]]
    for axes, places in zip((quick, slow), position.values(), strict=True):
        for i in range(5):
            assert np.array_equal(axes.lines[i].get_xydata(), places[:, i].numpy())
        discs = [patch.center for patch in axes.patches if isinstance(patch, Circle)]
        shown = [0, 10, 20, 30, len(places) - 1]
        assert np.allclose(discs, places[shown].reshape(-1, 2))
    assert len(crosses(quick)) == 0
    places = position["slow"]
    assert np.allclose(crosses(slow), torch.stack([places[10, 3], places[30, 4], places[32, 4]]))


def test_jerk_is_on_one_scale_with_its_means(kept, tmp_path):
    calm, rough = torch.rand(30, 5), 9 * torch.rand(50, 5)
    rough[40:, 1] = torch.nan  # arrived
    rough[45:] = torch.nan
    plot_jerk(tmp_path / "a.png", {"calm": calm, "rough": rough}, dt=0.1)
    axes = kept[0].axes
    assert axes[0].get_ylim() == axes[1].get_ylim()
    for panel, values in zip(axes, (calm, rough), strict=True):
        *robots, mean, overall = panel.lines
        for robot, expected in zip(robots, values.T, strict=True):
            assert np.array_equal(robot.get_ydata(), expected, equal_nan=True)
        assert np.allclose(robots[0].get_xdata()[:2], [0.15, 0.25])
        assert np.allclose(mean.get_ydata(), values.nanmean(1), equal_nan=True)
        assert np.allclose(overall.get_ydata(), values.nanmean())
        assert len({line.get_marker() for line in robots}) == 5  # told apart without colours
    assert axes[1].get_title(loc="left") == f"rough: mean {rough.nanmean():.2f} m/s³"


def test_denoising_has_a_row_a_step_and_a_column_a_robot(kept, tmp_path):
    steps, velocity = list(range(20, -1, -1)), torch.randn(21, 30, 3, 2)
    plot_denoising(tmp_path / "a.png", steps, velocity, max_speed=2.0)
    grid = np.array(kept[0].axes).reshape(5, 3)
    assert [row[0].get_ylabel() for row in grid] == ["k = 20", "k = 15", "k = 10", "k = 5", "k = 0 (action)"]
    for row, k in zip(grid, (0, 5, 10, 15, 20), strict=True):
        for i, axes in enumerate(row):
            (cloud,) = axes.collections
            assert np.array_equal(cloud.get_offsets(), velocity[k, :, i])
            assert np.array_equal(axes.texts[0].xy, velocity[k, 0, i])
            (box,) = axes.patches
            assert box.get_bbox().bounds == (-2, -2, 4, 4)


def test_importance_widens_with_the_value_on_one_scale(kept, tmp_path):
    place = formation_offsets("wedge", 3)[None] + torch.tensor([[[-2.0, 0.0]], [[0.0, 0.0]]])
    before = torch.tensor([[9.0, 0.1, 0.0], [0.2, 9.0, 0.3], [0.4, 0.0, 9.0]]).expand(2, 3, 3)
    plot_importance(tmp_path / "a.png", {"before": before, "after": 2 * before}, place, ["far", "near"], corridor())
    grid = np.array(kept[0].axes[:8]).reshape(4, 2)
    widths = []
    for row, value in ((0, before[0]), (2, 2 * before[0])):
        arrows = [patch for patch in grid[row, 0].patches if isinstance(patch, FancyArrowPatch)]
        assert len(arrows) == 4  # none for a zero, none from a robot to itself
        widths.append([arrow.get_linewidth() for arrow in arrows])
        assert widths[-1] == sorted(widths[-1])
        numbers = {tuple(text.get_position()): text.get_text() for text in grid[row + 1, 0].texts}
        expected = {(j, i): f"{value[i, j]:.2f}" for i in range(3) for j in range(3) if i != j}
        assert numbers == expected
        assert np.allclose(arrows[-1]._posA_posB, place[0, [0, 2]])  # robot 2 hears robot 0 most
    assert np.allclose(2 * (np.array(widths[0]) - 0.3), np.array(widths[1]) - 0.3)
    assert np.allclose(grid[2, 0].get_xlim(), grid[0, 0].get_xlim())


def test_maps_may_be_grids(kept, tmp_path, squeeze):
    occupied = torch.zeros(40, 60, dtype=torch.bool)
    occupied[:10, 25:35] = True
    grid, team = OccupancyMap(occupied, 0.1, (-3.0, -2.0, 0.0), gap=1.0), squeeze()
    touching = torch.zeros(team.shape[:2], dtype=torch.bool)
    plot_comparison(tmp_path / "a.png", {"a": team, "b": team}, {"a": touching, "b": touching}, "wedge", grid)
    plot_importance(tmp_path / "b.png", {"a": torch.rand(2, 5, 5)}, team[:2], ["now", "then"], grid)
    for axes in (*kept[0].axes, *kept[1].axes[:2]):
        (picture,) = axes.images
        assert np.array_equal(picture.get_array(), occupied)
        first_cell = (picture.get_transform() - axes.transData).transform((0.05, 0.05))
        assert np.allclose(first_cell, (-2.95, -1.95))


@pytest.mark.parametrize(("width", "pixels"), [(ONE_COLUMN, 680), (TWO_COLUMNS, 1400)])
def test_written_in_its_true_size(tmp_path, width, pixels):
    profiles = {name: torch.rand(20, 3) for name in ("a", "b", "c")}
    plot_jerk(tmp_path / "jerk.png", profiles, width=width)
    with Image.open(tmp_path / "jerk.png") as image:
        assert image.width == pixels
    plot_jerk(tmp_path / "jerk.pdf", profiles, width=width)
    content = (tmp_path / "jerk.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert b"/Type3" not in content  # fonts that publishers refuse
    assert sorted(tmp_path.iterdir()) == [tmp_path / "jerk.pdf", tmp_path / "jerk.png"]


@pytest.mark.parametrize(("count", "rows"), [(1, 1), (3, 1), (4, 2), (7, 3)])
def test_panels_fill_rows(count, rows):
    figure, panels = panel_grid(count, 7.0, 2.0, 0.5)
    assert len(panels) == len(figure.axes) == count
    assert len({panel.get_subplotspec().rowspan.start for panel in panels}) == rows
    assert all(panel.xaxis.get_tick_params()["labelbottom"] for panel in panels[-min(count, 3) :])


def test_bad_input_is_named(tmp_path, squeeze):
    path, team = tmp_path / "a.png", squeeze()
    touching = torch.zeros(team.shape[:2], dtype=torch.bool)
    with pytest.raises(ValueError, match=r"got methods \['a'\] and \['b'\]"):
        plot_comparison(path, {"a": team}, {"b": touching}, "wedge", corridor())
    with pytest.raises(ValueError, match=r"collision: got shape \[11, 5\] of 'a', expected \[12, 5\]"):
        plot_comparison(path, {"a": team}, {"a": touching[1:]}, "wedge", corridor())
    with pytest.raises(ValueError, match="'a'.*same number of robots"):
        both = {"b": team[:, :3], "a": team}
        plot_comparison(path, both, {"b": touching[:, :3], "a": touching}, "wedge", corridor())
    with pytest.raises(ValueError, match=r"jerk: got shape \[0, 5\] of 'a'"):
        plot_jerk(path, {"a": torch.zeros(0, 5)})
    with pytest.raises(ValueError, match="count: got 0"):
        plot_jerk(path, {})
    with pytest.raises(ValueError, match=r"width: got 1.0 inches, a panel needs 2.0"):
        plot_jerk(path, {"a": torch.zeros(9, 5)}, width=1.0)
    with pytest.raises(ValueError, match=r"velocity: got shape \[3, 4, 5, 2\], expected \[2, L, n, 2\]"):
        plot_denoising(path, [1, 0], torch.zeros(3, 4, 5, 2))
    with pytest.raises(ValueError, match="importance: got no policy"):
        plot_importance(path, {}, torch.zeros(1, 5, 2), ["now"], corridor())
    with pytest.raises(ValueError, match=r"importance: got shape \[1, 4, 4\] of 'a', expected \[1, 5, 5\]"):
        plot_importance(path, {"a": torch.zeros(1, 4, 4)}, torch.zeros(1, 5, 2), ["now"], corridor())
    with pytest.raises(ValueError, match=r"position: got shape \[2, 5, 2\], expected \[1, n, 2\]"):
        plot_importance(path, {"a": torch.zeros(1, 5, 5)}, torch.zeros(2, 5, 2), ["now"], corridor())
    with pytest.raises(ValueError, match=r"path: got 'a.gif'"):
        plot_denoising(tmp_path / "a.gif", [1, 0], torch.zeros(2, 4, 5, 2))
    assert list(tmp_path.iterdir()) == []
