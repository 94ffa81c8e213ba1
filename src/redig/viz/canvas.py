"""One picture of a team after another, as arrays."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from redig.envs.maps import ObstacleMap
from redig.envs.occupancy import OccupancyMap
from redig.viz.scene import INK, SHAPE, draw_map, formation_outline, robot_style

DPI = 128
WIDTH = 832  # pixels
BLOCK = 16  # video codecs want both sides of a frame to be multiples of it


class TeamCanvas:
    """Draws robots in their true size, their paths so far and the formation's outline.

    What stands still is drawn once, and only the team is drawn anew in each picture.

    Args:
        region: ``(x_min, x_max, y_min, y_max)`` (m), see :func:`redig.viz.scene.view`.
        n: number of robots.
        formation: name, see :func:`redig.envs.formations.formation_offsets`.
        obstacle_map: the map.
        goal: ``[n, 2]`` (m), drawn as crosses.
        radius: of a robot (m).

    Examples:
        >>> import numpy as np
        >>> from redig.envs.maps import corridor
        >>> canvas = TeamCanvas((-3.0, 3.0, -1.5, 1.5), 2, "line", corridor())
        >>> canvas.draw(np.array([[[-2.0, 0.5], [-2.0, -0.5]]]), time=0.0).shape
        (464, 832, 3)
    """

    def __init__(
        self,
        region: tuple[float, float, float, float],
        n: int,
        formation: str,
        obstacle_map: ObstacleMap | OccupancyMap,
        goal: NDArray | None = None,
        radius: float = 0.1,
    ) -> None:
        self.outline = formation_outline(formation, n)
        height = BLOCK * round(WIDTH * (region[3] - region[2]) / (region[1] - region[0]) / BLOCK) + 3 * BLOCK
        self.figure = Figure(figsize=(WIDTH / DPI, height / DPI), dpi=DPI, layout="constrained")
        self.canvas = FigureCanvasAgg(self.figure)
        self.axes = self.figure.add_subplot()
        draw_map(self.axes, obstacle_map, region)
        if goal is not None:
            self.axes.scatter(goal[:, 0], goal[:, 1], marker="x", s=20, color=INK, linewidths=1.0, zorder=2)
        self.canvas.draw()
        self.background = self.canvas.copy_from_bbox(self.figure.bbox)

        (self.shape,) = self.axes.plot([], [], color=SHAPE, linewidth=1.0)
        styles = [robot_style(i) for i in range(n)]
        self.paths = [self.axes.plot([], [], color=colour, linestyle=line, linewidth=1.2)[0] for colour, line in styles]
        self.robots = [Circle((0, 0), radius, color=colour) for colour, _ in styles]
        for robot in self.robots:
            self.axes.add_patch(robot)
        self.clock = self.axes.text(0.01, 0.98, "", transform=self.axes.transAxes, size=8, color=INK, va="top")

    def draw(self, track: NDArray, time: float) -> NDArray:
        """Picture ``[H, W, 3]`` (uint8) of a team at the end of its ``track`` ``[T, n, 2]`` (m), at ``time`` (s)."""
        self.canvas.restore_region(self.background)
        self.shape.set_data(*track[-1][self.outline].T)
        for i, (path, robot) in enumerate(zip(self.paths, self.robots, strict=True)):
            path.set_data(*track[:, i].T)
            robot.set_center(track[-1, i])
        self.clock.set_text(f"t = {time:.1f} s")
        for artist in (*self.paths, self.shape, *self.robots, self.clock):
            self.axes.draw_artist(artist)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()
