from itertools import pairwise

import imageio.v3 as imageio
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from redig.envs import corridor
from redig.viz import animate
from redig.viz.scene import PALETTE


def centre_of(frame, colour) -> tuple[float, float]:
    """Mean column and row (pixels) of a colour."""
    rows, columns = np.nonzero(np.abs(frame.astype(float) - 255 * np.array(to_rgb(colour))).max(-1) < 24)
    return float(columns.mean()), float(rows.mean())


def test_gif_has_a_frame_a_sample_and_the_team_moves(tmp_path, squeeze):
    path = tmp_path / "team.gif"
    position = squeeze(samples=8)
    animate(path, position, "wedge", corridor(), goal=position[-1], fps=5)
    with Image.open(path) as image:
        assert image.format == "GIF"
        assert image.n_frames == 8
        assert image.info["duration"] == 200  # ms
    frames = imageio.imread(path)
    assert frames.shape[0] == 8
    columns = [centre_of(frame[..., :3], PALETTE[0])[0] for frame in frames]
    assert all(later > earlier + 10 for earlier, later in pairwise(columns))
    assert list(tmp_path.iterdir()) == [path]


def test_mp4_is_readable_and_divisible_by_16(tmp_path, squeeze):
    path = tmp_path / "team.mp4"
    animate(path, squeeze(samples=6), "wedge", corridor())
    frames = imageio.imread(path)
    count, height, width, _ = frames.shape
    assert count == 6
    assert height % 16 == width % 16 == 0
    assert frames[0].min() < 60
    assert frames[0].max() > 230  # ink on paper
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["team.png", "team", "team.avi"])
def test_bad_suffix(tmp_path, squeeze, name):
    with pytest.raises(ValueError, match=rf"path: got '{name}'.*\.gif, \.mp4"):
        animate(tmp_path / name, squeeze(), "wedge", corridor())
    assert list(tmp_path.iterdir()) == []


def test_bad_arguments(tmp_path, squeeze):
    with pytest.raises(ValueError, match="fps: got 0"):
        animate(tmp_path / "team.gif", squeeze(), "wedge", corridor(), fps=0)
    with pytest.raises(ValueError, match="position: got shape"):
        animate(tmp_path / "team.gif", squeeze()[0], "wedge", corridor())
    assert list(tmp_path.iterdir()) == []
