"""What all benchmarks share: timing in alternation, ratios, a description of the machine, and tables on disk."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from redig.files import replacing, write_csv

PACKAGES = ("torch", "torchrl", "tensordict", "vmas", "torch-geometric", "diffusers", "onnxruntime")


@dataclass(frozen=True)
class Timing:
    """Seconds of one call: all repetitions, and the very first call, before anything was warm."""

    seconds: tuple[float, ...]
    first: float

    @property
    def median(self) -> float:
        """Median of the repetitions."""
        return statistics.median(self.seconds)

    @property
    def quartiles(self) -> tuple[float, float]:
        """First and third quartile of the repetitions."""
        low, _, high = statistics.quantiles(self.seconds, n=4)
        return low, high


def alternate(calls: Mapping[str, Callable[[], Any]], repeats: int = 30, seconds: float = 0.1) -> dict[str, Timing]:
    """Time several calls in turn, A B C A B C ..., so that a machine whose speed drifts is as fair to all of them.

    One repetition runs a call as often as fits into ``seconds`` (at least once) and counts the mean.

    Args:
        calls: what to time, by name.
        repeats: repetitions of each, after one that does not count.
        seconds: length of a repetition.
    """
    first, count = {}, {}
    for name, call in calls.items():
        first[name] = _once(call)
        count[name] = max(1, int(seconds / max(_once(call), 1e-9)))
    times: dict[str, list[float]] = {name: [] for name in calls}
    for repeat in range(repeats + 1):
        for name, call in calls.items():
            started = time.perf_counter()
            for _ in range(count[name]):
                call()
            if repeat:
                times[name].append((time.perf_counter() - started) / count[name])
    return {name: Timing(tuple(times[name]), first[name]) for name in calls}


def _once(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def ratio(one: Timing, other: Timing) -> float:
    """Median over repetitions of one time divided by the other, pair by pair."""
    return statistics.median(a / b for a, b in zip(one.seconds, other.seconds, strict=True))


def machine(threads: int | None = None) -> str:
    """Processor, threads, system and the versions of what was measured, in one line."""
    packages = []
    for name in PACKAGES:
        try:
            packages.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    threads = torch.get_num_threads() if threads is None else threads
    system = f"{platform.system()}, Python {platform.python_version()}"
    return f"{_processor()}, {threads} thread(s), {system}, {', '.join(packages)}"


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0]} ({len(names)} cores)" if names else platform.processor() or platform.machine()


def report(
    folder: Path, name: str, rows: Sequence[Mapping[str, Any]], notes: Sequence[str] = (), threads: int | None = None
) -> None:
    """Write rows as ``name.csv`` and, with the machine and notes, as a Markdown table ``name.md``; print the table."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    write_csv(folder / f"{name}.csv", rows, columns)
    table = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    table += [f"| {' | '.join(_cell(row.get(column, '')) for column in columns)} |" for row in rows]
    lines = [f"Machine: {machine(threads)}.", "", *table, *(f"\n{note}" for note in notes)]
    text = "\n".join(lines) + "\n"
    with replacing(folder / f"{name}.md") as path:
        path.write_text(text)
    print(f"\n{name}\n{text}")


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
