"""Panels side by side: one for each method, as many in a row as the width of the page has room for."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

ONE_COLUMN, TWO_COLUMNS = 3.4, 7.0  # widths of a figure in a paper of two columns (inches)
LEGEND: dict[str, Any] = {
    "loc": "outside upper center",
    "frameon": False,
    "fontsize": 7,
    "handletextpad": 0.5,
    "columnspacing": 1.2,
}


def panel_grid(count: int, width: float, least_width: float, ratio: float) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` panels that share their axes.

    Args:
        count: number of panels.
        width: of the figure (inches), such as :data:`ONE_COLUMN` or :data:`TWO_COLUMNS`.
        least_width: of a panel (inches), which decides how many are in a row.
        ratio: height of a panel to its width.

    Raises:
        ValueError: if there is no panel, or the figure is narrower than one.

    Examples:
        >>> figure, panels = panel_grid(4, TWO_COLUMNS, least_width=2.0, ratio=0.5)
        >>> len(panels), [panel.get_subplotspec().is_last_row() for panel in panels]
        (4, [False, False, False, True])
    """
    if count < 1:
        raise ValueError(f"count: got {count}, must be at least 1")
    if not width >= least_width:
        raise ValueError(f"width: got {width} inches, a panel needs {least_width}")
    columns = min(count, int(width / least_width))
    rows = -(-count // columns)
    height = rows * (ratio * (width - 0.5) / columns + 0.25) + 0.7
    figure = Figure(figsize=(width, height), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat
    for unused in grid[count:]:
        unused.remove()
    panels = list(grid[:count])
    for panel in panels[max(count - columns, 0) :]:
        panel.tick_params(labelbottom=True)  # also above a place that is empty
    return figure, panels
