"""A team in a picture: the paths of its robots, its formation at an instant, their numbers."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.patches import Circle
from numpy.typing import NDArray

from redig.viz.scene import SHAPE, robot_style


def draw_paths(axes: Axes, track: NDArray, linewidth: float = 1.4) -> None:
    """Draw the path of every robot: ``track`` ``[T, n, 2]`` (m).

    Examples:
        >>> import numpy as np
        >>> from matplotlib.figure import Figure
        >>> axes = Figure().add_subplot()
        >>> draw_paths(axes, np.zeros((7, 5, 2)))
        >>> len(axes.lines)
        5
    """
    for i in range(track.shape[1]):
        colour, line = robot_style(i)
        axes.plot(*track[:, i].T, color=colour, linestyle=line, linewidth=linewidth, zorder=3)


def draw_formation(axes: Axes, place: NDArray, outline: Sequence[int], radius: float, filled: bool = False) -> None:
    """Draw the robots at ``place`` ``[n, 2]`` (m) in their true size, joined along ``outline``.

    Examples:
        >>> import numpy as np
        >>> from matplotlib.figure import Figure
        >>> axes = Figure().add_subplot()
        >>> draw_formation(axes, np.zeros((3, 2)), outline=[1, 0, 2], radius=0.1)
        >>> len(axes.lines), len(axes.patches)
        (1, 3)
    """
    axes.plot(*place[list(outline)].T, color=SHAPE, linewidth=0.9, zorder=2)
    for i, at in enumerate(place):
        colour, _ = robot_style(i)
        face = colour if filled else "white"
        axes.add_patch(Circle(at, radius, facecolor=face, edgecolor=colour, linewidth=1.1, zorder=4))


def number_robots(axes: Axes, place: NDArray, size: float = 7, colour: str = "white") -> None:
    """Write the number of each robot at ``place`` ``[n, 2]`` (m).

    Examples:
        >>> import numpy as np
        >>> from matplotlib.figure import Figure
        >>> axes = Figure().add_subplot()
        >>> number_robots(axes, np.zeros((3, 2)))
        >>> [text.get_text() for text in axes.texts]
        ['0', '1', '2']
    """
    for i, (x, y) in enumerate(place):
        axes.text(x, y, str(i), color=colour, size=size, weight="bold", ha="center", va="center", zorder=6)
