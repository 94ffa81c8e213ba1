"""All benchmarks, one after the other: ``python benchmarks``.

Each is a program of its own that runs in a fresh process with one thread; ``--help`` of each explains its options.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

BENCHMARKS = ("action", "control", "update", "collection", "team_size", "memory", "gpu", "wall_clock")


@dataclass
class Arguments:
    """Run all benchmarks, or some, with their default options."""

    only: tuple[str, ...] = BENCHMARKS
    """Which of them, in this order."""
    out: Path = Path("docs/results/speed")
    """Folder for all tables."""


def main(arguments: Arguments) -> None:
    """Run each benchmark; one that fails does not keep the others from running.

    Raises:
        ValueError: for an unknown name, before anything runs.
        SystemExit: at the end, naming those that failed.
    """
    unknown = [name for name in arguments.only if name not in BENCHMARKS]
    if unknown:
        raise ValueError(f"only: got {', '.join(unknown)}, allowed are {', '.join(BENCHMARKS)}")
    failed = [name for name in arguments.only if run(Path(__file__).with_name(f"{name}.py"), arguments.out)]
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


def run(script: Path, out: Path) -> int:
    """The exit status of a benchmark."""
    print(f"\n--- {script.stem}", flush=True)
    one_thread = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, str(script), "--out", str(out)], env=one_thread).returncode


if __name__ == "__main__":
    main(tyro.cli(Arguments))
