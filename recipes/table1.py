"""Table 1: every method on every formation, trained, evaluated and written down by one command.

Run ``python recipes/table1.py``. Runs that are finished are kept, interrupted ones continue; ``--only redig:wedge``
trains a part, ``--train`` nothing at all, ``--help`` explains each option.
"""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from finish import TEST_SEED
from table1_methods import METHODS, Job, jobs, load
from table1_report import write_report
from tqdm import tqdm

from redig.envs.factory import make_env
from redig.evaluation import evaluate_teams
from redig.files import replacing


@dataclass
class Arguments:
    """Train (or load), evaluate and compare all methods on all formations."""

    only: tuple[str, ...] = ()
    """Parts to do, as METHOD, METHOD:FORMATION or METHOD:FORMATION:SEED; default: everything. The table is made of
    all that is finished."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Training seeds."""
    formations: tuple[str, ...] = ("circle", "wedge", "line")
    """Formations."""
    runs: Path = Path("runs/table1")
    """Folder of the runs, one folder each: METHOD-FORMATION-seedSEED."""
    out: Path = Path("docs/results/table1")
    """Folder for the table and the CSV files."""
    parallel: int = max(1, os.cpu_count() or 1)
    """Training runs side by side, each with one thread."""
    train: bool = True
    """Train what is missing; --no-train: make the table of what is there."""
    starts: int = 256
    """Starts of the evaluation, never trained on and never used for a choice."""
    options: str = ""
    """Options passed on to every training recipe, in one string, such as --options="--smoke"."""


def main(arguments: Arguments) -> int:
    """Do what is missing and write the table; returns the number of runs that failed."""
    wanted = [job for job in jobs(arguments.formations, arguments.seeds, arguments.runs) if job.matches(arguments.only)]
    if not wanted:
        raise ValueError(f"only: got {' '.join(arguments.only)}, allowed are {', '.join(METHODS)}, :FORMATION, :SEED")
    failed = train_all([job for job in wanted if job.command], arguments) if arguments.train else []
    torch.set_num_threads(1)
    for job in tqdm(wanted, desc="evaluate", unit="run", disable=None):
        if job.ready():
            evaluate_job(job, arguments.starts)
    everything = jobs(arguments.formations, arguments.seeds, arguments.runs)
    print(write_report(arguments.out, [job for job in everything if (job.folder / job.starts_file).exists()]))
    for job in failed:
        print(f"failed: {job.name}, see {job.folder / 'output.txt'}", file=sys.stderr)
    return len(failed)


def train_all(wanted: list[Job], arguments: Arguments) -> list[Job]:
    """Train what is not finished, several runs side by side; returns those that failed.

    On Ctrl-C or SIGTERM the runs are told to stop; each writes a checkpoint, from which the next call goes on.
    """
    missing = [job for job in wanted if not job.finished()]
    running: set[subprocess.Popen] = set()
    stop = threading.Event()

    def interrupt(*_: object) -> None:
        stop.set()
        for process in list(running):
            process.send_signal(signal.SIGTERM)

    def train(job: Job) -> bool:
        if stop.is_set():
            return True
        job.folder.mkdir(parents=True, exist_ok=True)
        started = time.perf_counter()
        with open(job.folder / "output.txt", "a") as output:
            process = subprocess.Popen(
                [sys.executable, *job.arguments(arguments.options)],
                stdout=output,
                stderr=output,
                start_new_session=True,  # Ctrl-C reaches it through ``interrupt`` only, and once
            )
            running.add(process)
            code = process.wait()
            running.discard(process)
        job.add_seconds(time.perf_counter() - started)
        progress.update()
        return code == 0

    previous = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with (
            tqdm(total=len(missing), desc="train", unit="run", disable=None) as progress,
            ThreadPoolExecutor(arguments.parallel) as pool,
        ):
            succeeded = list(pool.map(train, missing))
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if stop.is_set():
        raise SystemExit("stopped; the same command goes on from here")
    return [job for job, good in zip(missing, succeeded, strict=True) if not good]


def evaluate_job(job: Job, num_starts: int) -> None:
    """Metrics of each start, as CSV in the folder of the run; kept if they are there and newer than the policy."""
    path = job.folder / job.starts_file
    if path.exists() and (job.policy is None or path.stat().st_mtime >= job.policy.stat().st_mtime):
        with open(path) as file:
            if sum(1 for _ in file) == num_starts + 1:
                return
    scenario = job.scenario()
    env = make_env(num_starts, **scenario)
    metrics = {key: value.tolist() for key, value in evaluate_teams(load(job, env), env, TEST_SEED).items()}
    with replacing(path) as unfinished, open(unfinished, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(metrics)
        writer.writerows(zip(*metrics.values(), strict=True))
    with replacing(job.folder / "scenario.json") as unfinished:
        unfinished.write_text(json.dumps(scenario, indent=2) + "\n")


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
