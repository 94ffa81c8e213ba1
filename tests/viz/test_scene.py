import math

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from redig.envs import FORMATIONS, ObstacleMap, OccupancyMap, formation_offsets
from redig.viz.scene import PALETTE, draw_map, formation_outline, robot_style, view


@pytest.mark.parametrize("name", FORMATIONS)
@pytest.mark.parametrize("n", [3, 4, 5, 8])
def test_outline_joins_neighbours(name, n):
    outline = formation_outline(name, n)
    place = formation_offsets(name, n)[outline]
    edges = (place[1:] - place[:-1]).norm(dim=-1)
    assert set(outline) == set(range(n))
    assert torch.allclose(edges, edges[0].expand_as(edges))  # no edge skips a robot
    assert (outline[0] == outline[-1]) == (name == "circle")


@pytest.mark.parametrize(
    "box", [[0.3, -0.2, 1.0, 0.4, 0.7, 0.0], [0.3, -0.2, 1.0, 0.4, 0.7, 0.3], [1, 1, 0, 0, 0, 0.5]]
)
def test_drawn_outline_lies_on_the_zero_of_the_signed_distance(box):
    obstacle_map = ObstacleMap(torch.tensor([box]), gap=1.0, bounds=(-3, -3, 3, 3))
    axes = Figure().add_subplot()
    draw_map(axes, obstacle_map, (-3, 3, -2, 2))
    (patch,) = axes.patches
    outline = torch.as_tensor(patch.get_xy(), dtype=torch.float32)
    assert obstacle_map.signed_distance(outline).abs().max() < 1e-5
    x, y = np.asarray(outline, dtype=float).T
    area = abs(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) / 2
    a, b, r = box[2], box[3], box[5]
    assert area == pytest.approx(4 * (a * b + (a + b) * r) + math.pi * r**2, rel=5e-3)
    assert axes.get_xlim() == (-3, 3)
    assert axes.get_ylim() == (-2, 2)


def test_cells_are_drawn_where_the_signed_distance_is_negative():
    cells = torch.zeros(6, 8, dtype=torch.bool)
    cells[1, 6] = cells[4, 2] = True
    grid = OccupancyMap(cells, 0.5, (-1.0, -2.0, 0.6), gap=1.0)
    figure = Figure(figsize=(4, 4), dpi=100)
    axes = figure.add_subplot()
    draw_map(axes, grid, (-4, 4, -4, 4))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    shade = np.asarray(canvas.buffer_rgba())[::-1, :, 0]
    across, up = torch.meshgrid(torch.arange(0.05, 4.0, 0.1), torch.arange(0.05, 3.0, 0.1), indexing="ij")
    cos, sin = math.cos(0.6), math.sin(0.6)
    points = torch.stack([-1 + cos * across - sin * up, -2 + sin * across + cos * up], -1).reshape(-1, 2)
    distance = grid.signed_distance(points)
    pixels = axes.transData.transform(points.numpy()).round().astype(int)
    dark = torch.from_numpy(shade[pixels[:, 1], pixels[:, 0]] < 250)
    clear = distance.abs() > 0.16
    assert dark[clear & (distance < 0)].all()
    assert not dark[clear & (distance > 0)].any()
    assert (clear & (distance < 0)).any()


def test_view_holds_motion_and_goals():
    position = np.array([[[0.0, 0.0]], [[6.0, 0.0]]])
    assert view(position, None) == (-0.5, 6.5, -3.5 / 3, 3.5 / 3)  # not thinner than a third
    x_min, x_max, y_min, y_max = view(position, np.array([[6.0, 9.0]]))
    assert (x_min, x_max, y_min, y_max) == (-0.5, 6.5, -0.5, 9.5)


def test_styles_of_robots_differ():
    styles = [robot_style(i) for i in range(2 * len(PALETTE))]
    assert len(set(styles)) == len(styles)
