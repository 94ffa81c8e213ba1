"""Files that are never half written: a reader sees the old file or the new one."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path with the same suffix, which becomes ``path`` if the block succeeds and is removed if not.

    The folder is made if it is missing, and the content reaches the disk before the name does.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with replacing(Path(folder) / "metrics.json") as file:
        ...         _ = file.write_text("{}")
        ...     (Path(folder) / "metrics.json").read_text()
        '{}'
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield unfinished
        with open(unfinished, "rb") as file:
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def write_csv(path: str | Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> None:
    """Write rows as CSV, in place of what was there.

    Args:
        path: of the file.
        rows: with the keys of the first, unless ``columns`` are given; what a row does not have is left empty.
        columns: heads, in order.

    Raises:
        ValueError: if a row has another key.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_csv(f"{folder}/seeds.csv", [{"seed": 0, "robots": 1.0}, {"seed": 1, "robots": 0.5}])
        ...     print(Path(f"{folder}/seeds.csv").read_text())
        seed,robots
        0,1.0
        1,0.5
        <BLANKLINE>
    """
    heads = list(rows[0] if rows else ()) if columns is None else columns
    with replacing(path) as unfinished, open(unfinished, "w", newline="") as file:
        writer = csv.DictWriter(file, heads)
        writer.writeheader()
        writer.writerows(rows)
