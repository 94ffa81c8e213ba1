"""The folder of one training run: configuration, log, checkpoints, progress bar, and stopping without loss."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.record.loggers import get_logger
from tqdm import tqdm

from redig.checkpoint import (
    buffer_state,
    load_checkpoint,
    rng_state,
    save_checkpoint,
    set_buffer_state,
    set_rng_state,
)
from redig.files import replacing, write_csv

LOGGERS = ("csv", "tensorboard", "wandb")


class Run:
    """Keeps what a run must not lose.

    Args:
        folder: where everything goes; it must not hold another run, unless ``resume`` is true.
        config: a dataclass instance, written as ``config.json``.
        logger: one of ``csv``, ``tensorboard``, ``wandb``.
        resume: continue from the checkpoint in the folder, or from the start if there is none yet.

    Raises:
        ValueError: for an unknown logger.
        ImportError: if the logger's package is missing; the message names the extra to install.
        FileExistsError: if the folder already holds a run.
    """

    def __init__(self, folder: Path, config: Any, logger: str, resume: bool = False) -> None:
        check_logger(logger)
        if not resume and (folder / "config.json").exists():
            raise FileExistsError(
                f"out: {folder} already holds a run; continue it with --resume {folder}, or choose another"
            )
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        checkpoint = folder / "checkpoint.pt"  # a run killed before its first one starts again
        self.saved: dict[str, Any] | None = load_checkpoint(checkpoint) if resume and checkpoint.exists() else None
        if not resume:
            with replacing(folder / "config.json") as file:
                file.write_text(json.dumps(asdict(config), indent=2, default=str) + "\n")
        self.counters: dict[str, int] = dict(self.saved["counters"]) if self.saved else {}
        self.evaluations: list[dict[str, Any]] = list(self.saved["evaluations"]) if self.saved else []
        self.best = self.saved["best"] if self.saved else -math.inf
        self.figures: dict[str, float] = {}
        self._tracked: dict[str, tuple[Callable[[], Any], Callable[[Any], object]]] = {}
        self._stop = threading.Event()
        options = {"wandb_kwargs": {"project": "redig", "offline": os.environ.get("WANDB_MODE") == "offline"}}
        self.logger = get_logger(logger, str(folder / "log"), folder.name, **(options if logger == "wandb" else {}))

    def track(self, **parts: Any) -> None:
        """Keep the state of modules, optimisers and replay buffers in the checkpoint."""
        for name, part in parts.items():
            if isinstance(part, ReplayBuffer):
                self.track_state(name, partial(buffer_state, part), partial(set_buffer_state, part))
            else:
                self.track_state(name, partial(_plain_state, part), part.load_state_dict)

    def track_state(self, name: str, get: Callable[[], Any], put: Callable[[Any], object]) -> None:
        """Keep in the checkpoint what ``get`` returns; ``put`` restores it."""
        self._tracked[name] = (get, put)

    def restore(self) -> None:
        """Bring everything that is tracked, and the random numbers, to where the checkpoint left them."""
        if self.saved is not None:
            for name, (_, put) in self._tracked.items():
                put(self.saved[name])
            set_rng_state(self.saved["rng"])
            self.saved = None

    def step(self, loss: Tensor, optimizer: torch.optim.Optimizer, max_norm: float, name: str) -> None:
        """One step of an optimiser, with clipped gradients; a loss or gradient that is not finite stops the run.

        Raises:
            FloatingPointError: naming the loss; the weights are untouched and the last good checkpoint is kept.
        """
        optimizer.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], max_norm)
        for what, value in ((name, loss.item()), (f"the gradient of {name}", norm.item())):
            if not math.isfinite(value):
                raise FloatingPointError(
                    f"{what} is {value} after {self.counters}; the last good checkpoint is kept in "
                    f"{self.folder / 'checkpoint.pt'}. Lower the learning rates or refine_step_size and start again"
                )
        optimizer.step()
        self.figures[name] = loss.item()

    def loop(self, phase: str, total: int, checkpoint_every: int | None = None) -> Iterator[int]:
        """Count ``phase`` up to ``total`` from where the checkpoint left it, with a progress bar.

        A checkpoint is written every ``checkpoint_every`` steps and at the end. On Ctrl-C or SIGTERM the current step
        is finished, a checkpoint is written and the program exits.
        """
        previous = {s: signal.signal(s, lambda *_: self._stop.set()) for s in (signal.SIGINT, signal.SIGTERM)}
        bar = tqdm(
            total=total, initial=self.counters.get(phase, 0), desc=phase, unit="it", disable=None, dynamic_ncols=True
        )
        try:
            while (step := self.counters.get(phase, 0)) < total:
                yield step
                self.counters[phase] = step + 1
                bar.update()
                bar.set_postfix({k: f"{v:.3g}" for k, v in self.figures.items()}, refresh=False)
                due = checkpoint_every is not None and (step + 1) % checkpoint_every == 0
                if due or self._stop.is_set() or step + 1 == total:
                    self.checkpoint()
                if self._stop.is_set():
                    raise SystemExit(f"stopped at {phase} {step + 1}; continue with --resume {self.folder}")
        finally:
            bar.close()
            for number, handler in previous.items():
                signal.signal(number, handler)

    def log(self, figures: dict[str, float], step: int, prefix: str = "") -> None:
        """Send figures to the logger."""
        for name, value in figures.items():
            self.logger.log_scalar(f"{prefix}{name}", value, step=step)

    def evaluation(self, metrics: dict[str, float], phase: str, updates: int) -> None:
        """Remember the result of an evaluation, and write all of them as ``evaluations.csv``."""
        self.evaluations.append({"phase": phase, "updates": updates, **metrics})
        self.log(metrics, updates, "evaluation/")
        self.figures |= {
            "SR": metrics["success_rate"],
            "TT": metrics["travel_time"],
            "CFI": metrics["cfi_0.5"],
        }
        shown = ("success_rate", "team_success_rate", "travel_time", "cfi_0.5", "jerk_mean")
        tqdm.write(f"{phase}, {updates} updates: " + ", ".join(f"{name} {metrics[name]:.3f}" for name in shown))
        write_csv(self.folder / "evaluations.csv", self.evaluations)

    def checkpoint(self) -> None:
        """Write the state of the run; a checkpoint is complete or not there at all."""
        progress = {"counters": self.counters, "evaluations": self.evaluations, "best": self.best}
        state = {name: get() for name, (get, _) in self._tracked.items()}
        save_checkpoint(self.folder / "checkpoint.pt", {**progress, **state, "rng": rng_state()})


def _plain_state(part: Any) -> dict[str, Any]:
    return dict(part.state_dict())


def check_logger(logger: str) -> None:
    """Raise at once if a logger is unknown or its package is not installed."""
    if logger not in LOGGERS:
        raise ValueError(f"logger: got {logger!r}, allowed are {', '.join(LOGGERS)}")
    if logger != "csv" and importlib.util.find_spec(logger) is None:
        raise ImportError(f"logger: {logger} is not installed; install it with: pip install 'redig[{logger}]'")
