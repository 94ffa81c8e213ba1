import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from PIL import Image

from redig.envs import OccupancyMap, corridor, formation_offsets
from redig.viz import animate_denoising

PLACE = formation_offsets("wedge", 5) + torch.tensor([-2.0, 0.0])


def test_gif_has_a_frame_a_step_and_holds_the_last(tmp_path):
    torch.manual_seed(0)
    velocity = torch.randn(4, 8, 5, 2)
    animate_denoising(tmp_path / "a.gif", [3, 2, 1, 0], velocity, PLACE, corridor(), fps=10, hold=1.0)
    with Image.open(tmp_path / "a.gif") as film:
        durations = [film.seek(k) or film.info["duration"] for k in range(film.n_frames)]
    assert len(durations) == 4
    assert durations == [100, 100, 100, 1000]
    first, *_, last = imageio.imread(tmp_path / "a.gif")
    assert np.abs(first.astype(int) - last.astype(int)).max() > 50  # arrows turn


def test_mp4_is_readable(tmp_path):
    animate_denoising(tmp_path / "a.mp4", [1, 0], torch.zeros(2, 8, 5, 2), PLACE, corridor(), hold=0.1)
    frames = imageio.imread(tmp_path / "a.mp4")
    assert frames.shape[0] == 2
    assert frames.shape[1] % 16 == frames.shape[2] % 16 == 0


def test_a_grid_looks_like_the_boxes_that_it_was_made_from(tmp_path):
    centres = 0.05 * torch.arange(160) - 3.975
    boxes, cells = corridor(), torch.cartesian_prod(centres, centres).flip(-1)
    occupied = (boxes.signed_distance(cells) < 0).reshape(160, 160)
    grid = OccupancyMap(occupied, 0.05, (-4.0, -4.0, 0.0), gap=1.1)
    free = OccupancyMap(torch.zeros_like(occupied), 0.05, (-4.0, -4.0, 0.0), gap=1.1)
    frames = []
    for place in (boxes, grid, free):
        animate_denoising(tmp_path / "a.gif", [0], torch.zeros(1, 8, 5, 2), PLACE, place, hold=0.1)
        frames.append(imageio.imread(tmp_path / "a.gif")[0].astype(int))
    assert np.abs(frames[1] - frames[0]).mean() < 0.1 * np.abs(frames[2] - frames[0]).mean()


def test_bad_input_is_named(tmp_path):
    velocity = torch.zeros(2, 8, 5, 2)
    with pytest.raises(ValueError, match="position: got 3 robots, velocity has 5"):
        animate_denoising(tmp_path / "a.gif", [1, 0], velocity, PLACE[:3], corridor())
    with pytest.raises(ValueError, match=r"velocity: got shape \[2, 8, 5, 2\], expected \[3, L, n, 2\]"):
        animate_denoising(tmp_path / "a.gif", [2, 1, 0], velocity, PLACE, corridor())
    with pytest.raises(ValueError, match="path: got 'a.png'"):
        animate_denoising(tmp_path / "a.png", [1, 0], velocity, PLACE, corridor())
    with pytest.raises(ValueError, match="fps: got 0"):
        animate_denoising(tmp_path / "a.gif", [1, 0], velocity, PLACE, corridor(), fps=0)
    assert list(tmp_path.iterdir()) == []
