"""One robot of ``benchmarks/robots.py``: acts at a rate on what four neighbours sent, and prints what it measured.

Of this project it imports what a robot does, without torch for an exported policy.
"""

from __future__ import annotations

import json
import os
import sys
import time
from importlib import import_module
from pathlib import Path

STARTED = time.perf_counter()

import numpy as np  # noqa: E402

from redig.deploy import RobotPolicy, RobotState  # noqa: E402

import_module("redig.deploy.runtime" if sys.argv[1].endswith(".onnx") else "redig.deploy.module")
IMPORTED = time.perf_counter()


def states(team: int, seed: int) -> list[RobotState]:
    """A team within each other's range, somewhere before the corridor."""
    generator = np.random.default_rng(seed)
    places = generator.uniform(-1, 1, (team, 2)) - (2.5, 0.0)
    return [
        RobotState(f"robot_{i}", 0.0, (x, y), (0.3, 0.0), (2.5, y), 1.0, (1.0, 0.0)) for i, (x, y) in enumerate(places)
    ]


def main(policy: str, rate: float, seconds: float) -> dict[str, float]:
    """Load, say so, wait for a line, then act on every tick of the rate (Hz)."""
    loading = time.perf_counter()
    robot = RobotPolicy(policy)
    loaded = time.perf_counter()
    own, *mates = states(5, seed=os.getpid())
    print("ready", flush=True)
    sys.stdin.readline()
    durations, late, ticks, used = [], 0, int(seconds * rate), time.process_time()
    first = time.perf_counter()
    for tick in range(ticks):
        due = first + tick / rate
        time.sleep(max(0.0, due - time.perf_counter()))
        robot(own, mates)
        done = time.perf_counter()
        durations.append(done - due)
        late += done > due + 1 / rate
    ended, used = time.perf_counter(), time.process_time() - used
    p50, p99 = np.percentile(durations, [50, 99])
    return {
        "import (s)": IMPORTED - STARTED,
        "start (s)": loaded - loading,
        "rate (Hz)": ticks / max(ended - first, seconds),
        "p50 (ms)": 1e3 * p50,
        "p99 (ms)": 1e3 * p99,
        "max (ms)": 1e3 * max(durations),
        "late (%)": 100 * late / ticks,
        "cpu (ms/action)": 1e3 * used / ticks,
        "memory (MiB)": memory(),
    }


def memory() -> float:
    """Most resident memory of this process so far (MiB)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], *map(float, sys.argv[2:]))))
