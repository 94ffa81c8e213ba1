import sys

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image

from redig.envs import FORMATIONS, corridor
from redig.viz import plot_trajectories
from redig.viz.scene import PALETTE, WALL


def share(path, colour) -> float:
    """Share of the pixels that have a colour."""
    pixels = np.asarray(Image.open(path).convert("RGB"), dtype=float)
    return float((np.abs(pixels - 255 * np.array(to_rgb(colour))).max(-1) < 3).mean())


@pytest.mark.parametrize("formation", FORMATIONS)
def test_picture_shows_walls_and_every_robot(tmp_path, squeeze, formation):
    path = tmp_path / "new" / "team.png"
    position = squeeze(formation)
    plot_trajectories(path, position, formation, corridor(), goal=position[-1])
    with Image.open(path) as image:
        image.verify()
        assert image.format == "PNG"
        assert image.width == 1400
        assert 500 < image.height < 1400
    assert share(path, WALL) > 0.05
    assert all(share(path, PALETTE[i]) > 5e-4 for i in range(5))
    assert share(path, PALETTE[5]) == 0  # there is no sixth robot
    assert list(path.parent.iterdir()) == [path]


def test_lines_hold_the_data(monkeypatch, tmp_path, squeeze):
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **_: (figures.append(self), path.write_text("")))
    position = squeeze("wedge", samples=61)
    goal = position[-1] + 0.05
    plot_trajectories(tmp_path / "team.png", position, "wedge", corridor(), goal=goal)
    (axes,) = figures[0].axes
    paths, shapes = axes.lines[:5], axes.lines[5:]
    for i in range(5):
        assert np.array_equal(paths[i].get_xydata(), position[:, i].numpy())
    # the centroid moves evenly, so six instants are twelve samples apart; the outline goes from arm to arm
    assert len(shapes) == 6
    for k, shape in enumerate(shapes):
        assert np.allclose(shape.get_xydata(), position[12 * k, [3, 1, 0, 2, 4]].numpy(), atol=0.1)
    discs = [patch for patch in axes.patches if isinstance(patch, Circle)]
    assert len(discs) == 30
    assert {disc.radius for disc in discs} == {0.1}
    (crosses,) = axes.collections
    assert np.allclose(crosses.get_offsets(), goal.numpy())


@pytest.mark.parametrize(("suffix", "magic"), [("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_vector_formats(tmp_path, squeeze, suffix, magic):
    path = tmp_path / f"team.{suffix}"
    plot_trajectories(path, squeeze(), "wedge", corridor())
    assert path.read_bytes().startswith(magic)


def test_team_that_stands_still(tmp_path, squeeze):
    path = tmp_path / "team.png"
    plot_trajectories(path, squeeze()[:1].expand(4, 5, 2), "wedge", corridor())
    with Image.open(path) as image:
        assert image.width == 1400


def test_drawing_does_not_touch_the_interactive_backend(tmp_path, squeeze):
    before = "matplotlib.pyplot" in sys.modules
    plot_trajectories(tmp_path / "team.png", squeeze(), "wedge", corridor())
    assert ("matplotlib.pyplot" in sys.modules) == before


@pytest.mark.parametrize("name", ["team.gif", "team", "team.txt"])
def test_bad_suffix(tmp_path, squeeze, name):
    with pytest.raises(ValueError, match=rf"path: got '{name}'.*\.png, \.pdf, \.svg"):
        plot_trajectories(tmp_path / name, squeeze(), "wedge", corridor())
    assert list(tmp_path.iterdir()) == []


def test_bad_shapes_and_names(tmp_path, squeeze):
    path = tmp_path / "team.png"
    with pytest.raises(ValueError, match=r"position: got shape \[2, 12, 5, 2\]"):
        plot_trajectories(path, torch.stack([squeeze(), squeeze()]), "wedge", corridor())
    with pytest.raises(ValueError, match=r"goal: got shape \[4, 2\], expected \[5, 2\]"):
        plot_trajectories(path, squeeze(), "wedge", corridor(), goal=torch.zeros(4, 2))
    with pytest.raises(ValueError, match="'star'"):
        plot_trajectories(path, squeeze(), "star", corridor())
    assert not path.exists()
