"""Ablations: the recipe with its earlier defaults, one thing changed at a time, in a table like Table 1.

Run ``python recipes/ablations.py``; ``--only encoder_linear:wedge`` does a part, ``--help`` explains each option.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import table1
import tyro
from table1_methods import ABLATIONS


@dataclass
class Arguments(table1.Arguments):
    """Train (or load), evaluate and compare the recipe with its earlier defaults, one thing changed at a time."""

    formations: tuple[str, ...] = ("wedge",)
    """Formations."""
    out: Path = Path("docs/results/ablations/table")
    """Folder for the table and the CSV files."""


if __name__ == "__main__":
    sys.exit(table1.main(tyro.cli(Arguments), ABLATIONS, "recipes/ablations.py"))
