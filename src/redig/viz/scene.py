"""What every picture of a team shares: colours, the map, the shape of the formation, the view and the file."""

from __future__ import annotations

import os
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray
from torch import Tensor

from redig.envs.formations import formation_offsets
from redig.envs.maps import ObstacleMap
from redig.envs.occupancy import OccupancyMap
from redig.files import replacing

# Okabe and Ito's palette for colour-blind readers, without its black (walls, text) and its yellow (too pale in print)
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
INK, WALL, SHAPE = "#222222", "#B8B8B8", "#666666"
IMAGE_SUFFIXES = (".png", ".pdf", ".svg")
VIDEO_SUFFIXES = (".gif", ".mp4")


def robot_style(robot: int) -> tuple[str, str]:
    """Colour and line style of a robot; where the colours repeat, the next line style begins.

    Examples:
        >>> robot_style(0), robot_style(6)
        (('#0072B2', '-'), ('#0072B2', '--'))
    """
    return PALETTE[robot % len(PALETTE)], ("-", "--", ":")[robot // len(PALETTE) % 3]


def formation_outline(formation: str, n: int) -> list[int]:
    """Order of the robots along the line that draws a formation: arm to arm, end to end, or once around.

    Examples:
        >>> formation_outline("wedge", 5), formation_outline("circle", 3)
        ([3, 1, 0, 2, 4], [0, 1, 2, 0])
    """
    left = formation_offsets(formation, n)[:, 1]
    if formation == "circle":
        return [*range(n), 0]
    return left.argsort(descending=formation == "wedge").tolist()


def check_trajectory(position: Tensor, goal: Tensor | None) -> tuple[NDArray, NDArray | None]:
    """Positions ``[T, n, 2]`` and goals ``[n, 2]`` (m) as arrays.

    Raises:
        ValueError: if a shape is wrong.

    Examples:
        >>> track, goals = check_trajectory(torch.zeros(7, 5, 2), goal=None)
        >>> track.shape, goals
        ((7, 5, 2), None)
    """
    position = torch.as_tensor(position).detach().cpu()
    if position.ndim != 3 or 0 in position.shape or position.shape[-1] != 2:
        raise ValueError(f"position: got shape {list(position.shape)}, expected [T, n, 2] of one team")
    if goal is None:
        return position.numpy(), None
    goal = torch.as_tensor(goal).detach().cpu()
    if goal.shape != position.shape[1:]:
        raise ValueError(f"goal: got shape {list(goal.shape)}, expected {list(position.shape[1:])}")
    return position.numpy(), goal.numpy()


def view(position: NDArray, goal: NDArray | None, margin: float = 0.5) -> tuple[float, float, float, float]:
    """Region ``(x_min, x_max, y_min, y_max)`` (m) around the motion and the goals, never very long and thin.

    Examples:
        >>> view(np.array([[[0.0, 0.0]], [[5.0, 0.0]]]), goal=None)  # one robot, two samples
        (-0.5, 5.5, -1.0, 1.0)
    """
    points = position.reshape(-1, 2) if goal is None else np.concatenate([position.reshape(-1, 2), goal])
    low, high = points.min(0), points.max(0)
    half = (high - low) / 2 + margin
    half = np.maximum(half, half.max() / 3)
    centre = (low + high) / 2
    (x_min, y_min), (x_max, y_max) = centre - half, centre + half
    return float(x_min), float(x_max), float(y_min), float(y_max)


def draw_map(axes: Axes, obstacle_map: ObstacleMap | OccupancyMap, region: tuple[float, float, float, float]) -> None:
    """Fill the obstacles and set up axes in metres that show ``region``.

    Examples:
        >>> from matplotlib.figure import Figure
        >>> from redig.envs import corridor
        >>> axes = Figure().add_subplot()
        >>> draw_map(axes, corridor(), region=(-3.0, 3.0, -2.0, 2.0))
        >>> len(axes.patches)  # a wall on either side
        2
    """
    if isinstance(obstacle_map, OccupancyMap):
        _draw_cells(axes, obstacle_map)
    else:
        _draw_boxes(axes, obstacle_map)
    axes.set(xlim=region[:2], ylim=region[2:], aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.tick_params(labelsize=8)


def _draw_cells(axes: Axes, grid: OccupancyMap) -> None:
    x, y, yaw = grid.origin
    height, width = grid.occupied.shape
    picture = axes.imshow(
        grid.occupied.cpu().numpy(),
        cmap=ListedColormap(["none", WALL]),
        origin="lower",
        extent=(0, width * grid.resolution, 0, height * grid.resolution),
        interpolation="none",
        vmin=0,
        vmax=1,
        zorder=1,
    )
    picture.set_transform(Affine2D().rotate(yaw).translate(x, y) + axes.transData)


def _draw_boxes(axes: Axes, obstacle_map: ObstacleMap) -> None:
    quarter = np.linspace(0, np.pi / 2, 17)
    turn = np.concatenate([quarter + k * np.pi / 2 for k in range(4)])
    corner = np.repeat([[1, 1], [-1, 1], [-1, -1], [1, -1]], len(quarter), axis=0)
    for x, y, half_length, half_breadth, heading, radius in obstacle_map.obstacles.tolist():
        local = corner * (half_length, half_breadth) + radius * np.stack([np.cos(turn), np.sin(turn)], -1)
        cos, sin = np.cos(heading), np.sin(heading)
        outline = local @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
        axes.add_patch(Polygon(outline, facecolor=WALL, edgecolor=SHAPE, linewidth=0.8, zorder=1))


def check_suffix(path: str | os.PathLike, allowed: tuple[str, ...]) -> Path:
    """The path, whose suffix must be one of ``allowed``.

    Raises:
        ValueError: if it is not.

    Examples:
        >>> check_suffix("curve.png", (".png", ".pdf")).name
        'curve.png'
    """
    path = Path(path)
    if path.suffix.lower() not in allowed:
        raise ValueError(f"path: got {path.name!r}, its suffix must be one of {', '.join(allowed)}")
    return path


def save_figure(figure: Figure, path: str | os.PathLike) -> None:
    """Write a figure in its true size, as PNG, PDF or SVG by the suffix; an existing file is replaced at once.

    PDF files hold their fonts as TrueType, as publishers ask.

    Raises:
        ValueError: if the suffix is not one of those allowed.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_figure(Figure(figsize=(3.4, 2.0)), f"{folder}/empty.pdf")
        ...     os.listdir(folder)
        ['empty.pdf']
    """
    with mpl.rc_context({"pdf.fonttype": 42}), replacing(check_suffix(path, IMAGE_SUFFIXES)) as unfinished:
        figure.savefig(unfinished, dpi=200)
