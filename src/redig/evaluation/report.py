"""Metrics for people and for programs: a table for the terminal, JSON for the rest."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

from redig.files import replacing

UNITS = {"travel_time": "s", "jerk_mean": "m/s³", "jerk_peak": "m/s³"}


def format_table(metrics: Mapping[str, float]) -> str:
    """Align metrics by name, value and unit, one a line; NaN is shown as ``-``.

    Examples:
        >>> print(format_table({"success_rate": 1.0, "travel_time": 7.25, "num_starts": 64.0}))
        success_rate  1.000
        travel_time   7.250  s
        num_starts       64
    """
    texts = {key: _number(value) for key, value in metrics.items()}
    names = max(map(len, texts), default=0)
    numbers = max(map(len, texts.values()), default=0)
    lines = (f"{key:<{names}}  {text:>{numbers}}  {UNITS.get(key, '')}".rstrip() for key, text in texts.items())
    return "\n".join(lines)


def write_metrics(path: str | Path, metrics: Mapping[str, float]) -> None:
    """Write metrics as JSON, NaN as ``null``; a reader sees the old file or the new one, never half of it.

    Args:
        path: of the file; its folder is made if it is missing.
        metrics: such as those of :func:`~redig.evaluation.evaluate.evaluate`.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_metrics(f"{folder}/metrics.json", {"success_rate": 0.0, "travel_time": math.nan})
        ...     json.loads(Path(f"{folder}/metrics.json").read_text())
        {'success_rate': 0.0, 'travel_time': None}
    """
    clean = {key: None if math.isnan(value) else value for key, value in metrics.items()}
    with replacing(path) as file:
        file.write_text(json.dumps(clean, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _number(value: float) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.0f}" if float(value).is_integer() and abs(value) > 1 else f"{value:.3f}"
