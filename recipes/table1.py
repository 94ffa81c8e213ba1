"""Table 1: every method on every formation, trained, evaluated and written down by one command.

Run ``python recipes/table1.py``. Runs that are finished are kept, interrupted ones continue; ``--only redig:wedge``
does a part, ``--no-train`` trains nothing, ``--help`` explains each option.
"""

from __future__ import annotations

import fcntl
import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import torch
import tyro
from finish import TEST_SEED
from table1_methods import METHODS, Job, Method, jobs, load
from table1_report import write_report
from tqdm import tqdm

from redig.envs import FORMATIONS
from redig.envs.factory import make_env
from redig.evaluation import evaluate_teams
from redig.files import replacing, write_csv


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


def main(arguments: Arguments, methods: Mapping[str, Method] = METHODS, script: str = "recipes/table1.py") -> int:
    """Do what is missing and write the table of ``methods``; returns 1 if a run failed, else 0."""
    check(arguments)
    everything = jobs(arguments.formations, arguments.seeds, arguments.runs, methods)
    for part in arguments.only:
        if not any(job.matches([part]) for job in everything):
            raise ValueError(
                f"only: got {part}, must be METHOD, METHOD:FORMATION or METHOD:FORMATION:SEED (no seed where nothing "
                f"is trained) with a method of {', '.join(methods)} and one of the formations and seeds asked for"
            )
    wanted = [job for job in everything if job.matches(arguments.only)]
    failed = train_all([job for job in wanted if job.command], arguments) if arguments.train else {}
    torch.set_num_threads(1)
    for job in tqdm(wanted, desc="evaluate", unit="run", disable=None):
        try:
            if job.ready():
                evaluate_job(job, arguments)
            elif not job.starts_file.exists() and job not in failed:
                print(f"not trained yet: {job.name}, {job.folder} has no metrics.json or no policy", file=sys.stderr)
        except (OSError, ValueError) as error:
            failed[job] = str(error)
    print(
        write_report(arguments.out, [job for job in everything if job.starts_file.exists()], command(arguments, script))
    )
    for job, reason in failed.items():
        print(f"failed: {job.name}, {reason}", file=sys.stderr)
    return 1 if failed else 0


def check(arguments: Arguments) -> None:
    """Raise a ValueError for an option out of its range."""
    for name, allowed in (("seeds", "at least one seed"), ("formations", f"of {', '.join(FORMATIONS)}")):
        values = getattr(arguments, name)
        unknown = set(values) - set(FORMATIONS) if name == "formations" else None
        if not values or len(set(values)) < len(values) or unknown:
            raise ValueError(f"{name}: got {' '.join(map(str, values)) or 'nothing'}, must be {allowed}, each once")
    for name in ("parallel", "starts"):
        if getattr(arguments, name) < 1:
            raise ValueError(f"{name}: got {getattr(arguments, name)}, must be at least 1")


def command(arguments: Arguments, script: str) -> str:
    """The command that makes the whole table from nothing."""
    default, words = type(arguments)(), ["python", script]
    for name in ("seeds", "formations"):
        if (values := getattr(arguments, name)) != getattr(default, name):
            words += [f"--{name}", *map(str, values)]
    words += [] if arguments.starts == default.starts else ["--starts", str(arguments.starts)]
    return shlex.join(words + [f"--options={arguments.options}"] * bool(arguments.options))


def train_all(wanted: list[Job], arguments: Arguments) -> dict[Job, str]:
    """Train what is not finished, several runs side by side; returns those that failed, and why.

    A run of which only the results were kept, without its policy, counts as finished.

    On Ctrl-C or SIGTERM the runs are told to stop; each writes a checkpoint, from which the next call goes on.
    """
    missing = [job for job in wanted if not job.ready() and not job.starts_file.exists()]
    running: set[subprocess.Popen] = set()
    stop = threading.Event()

    def interrupt(*_: object) -> None:
        stop.set()
        for process in list(running):
            process.send_signal(signal.SIGTERM)

    def train(job: Job) -> str | None:
        if stop.is_set():
            return None
        job.folder.mkdir(parents=True, exist_ok=True)
        started = time.perf_counter()
        with open(job.folder / "output.txt", "a") as output:
            if not lock(
                output
            ):  # the recipe inherits the lock: it is held while it runs, even if this process is killed
                return f"another process is training it in {job.folder}"
            if job.ready():  # one that has just ended
                return None
            process = subprocess.Popen(
                [sys.executable, *job.arguments(arguments.options)],
                stdout=output,
                stderr=output,
                start_new_session=True,  # Ctrl-C reaches it through ``interrupt`` only, and once
            )
            running.add(process)
            if stop.is_set():  # between the question above and here
                process.send_signal(signal.SIGTERM)
            code = process.wait()
            running.discard(process)
        job.add_seconds(time.perf_counter() - started)
        progress.update()
        return None if code == 0 else f"see {job.folder / 'output.txt'}"

    previous = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with (
            tqdm(total=len(missing), desc="train", unit="run", disable=None) as progress,
            ThreadPoolExecutor(arguments.parallel) as pool,
        ):
            reasons = list(pool.map(train, missing))
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if stop.is_set():
        raise SystemExit("stopped; the same command goes on from here")
    return {job: reason for job, reason in zip(missing, reasons, strict=True) if reason is not None}


def lock(file: IO, patience: float = 5.0) -> bool:
    """Lock a file, if its holder lets go within ``patience`` (s): what a recipe has started can outlive it a moment."""
    end = time.monotonic() + patience
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.monotonic() > end:
                return False
            time.sleep(0.1)


def evaluate_job(job: Job, arguments: Arguments) -> None:
    """Metrics of each start, as CSV in the folder of the run, and the scenario; kept if they are those asked for."""
    scenario, path = job.scenario(arguments.options), job.starts_file
    if up_to_date(job, scenario, arguments.starts):
        return
    env = make_env(arguments.starts, **scenario)
    metrics = {key: value.tolist() for key, value in evaluate_teams(load(job, env), env, TEST_SEED).items()}
    write_csv(path, [dict(zip(metrics, start, strict=True)) for start in zip(*metrics.values(), strict=True)])
    with replacing(job.folder / "scenario.json") as unfinished:
        unfinished.write_text(json.dumps(scenario, indent=2) + "\n")


def up_to_date(job: Job, scenario: dict[str, Any], num_starts: int) -> bool:
    """Whether a run is evaluated in this scenario, on this number of starts, after its policy was written."""
    path, saved = job.starts_file, job.folder / "scenario.json"
    if not path.exists() or not saved.exists() or json.loads(saved.read_text()) != json.loads(json.dumps(scenario)):
        return False
    if job.policy is not None and path.stat().st_mtime < job.policy.stat().st_mtime:
        return False
    with open(path) as file:
        return sum(1 for _ in file) == num_starts + 1


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
