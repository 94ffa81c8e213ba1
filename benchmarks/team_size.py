"""Growth with the size of a team at constant density, dense against sparse: ``python benchmarks/team_size.py``.

Writes ``team_size.csv``, ``team_size.md`` and ``team_size.png``.
"""

from __future__ import annotations

import json
import math
import statistics
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
import tyro
from harness import Timing, alternate, ratio, report
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torch.profiler import ProfilerActivity, profile
from torchrl.data import Bounded
from torchrl.objectives import SoftUpdate

from redig.files import replacing
from redig.modules import DDPM, DenoisingMLP, DiffusionActor, GraphEncoder, QNetwork
from redig.objectives import DIPOLoss

RADIUS, NEIGHBOURS, WIDTH, EMBEDDING, HIDDEN = 2.0, 4.0, 9, 64, 128
Case = tuple[str, int]  # form and robots of a team
FORMS = {"dense": None, "sparse": 0}  # as sparse_above
BATCH = 1024  # robots in the batch of an update
OPERATIONS = {"encoder": "Embeddings", "action": "Action, five steps", "update": f"Update, {BATCH} robots"}
MEASURES = {"per team (ms)": "Time a team (ms)", "memory (MiB)": "Peak memory (MiB)"}


@dataclass
class Arguments:
    """Measure the time and memory of embeddings, actions and updates for teams of growing size."""

    out: Path = Path("docs/results/speed")
    """Folder for the table and the figure."""
    sizes: tuple[int, ...] = (5, 8, 16, 32, 64, 256, 1024)
    """Robots of a team."""
    fit_from: int = 64
    """Smallest team for the slope of the sparse form."""
    repeats: int = 5
    """Repetitions of each measurement."""
    seconds: float = 0.05
    """Length of a repetition."""
    limit: float = 2.0
    """Memory (GiB) beyond which the dense form is left out."""


def main(arguments: Arguments) -> None:
    """Measure and write the table and the figure."""
    torch.set_num_threads(1)
    rows, slopes = [], []
    for operation in OPERATIONS:
        calls, memory = prepare_all(arguments, operation)
        times = alternate(calls, arguments.repeats, arguments.seconds)  # all sizes in turn, so that slopes are fair
        rows += [row(operation, n, times, memory) for n in arguments.sizes]
        large = {n: times["sparse", n] for n in arguments.sizes if n >= arguments.fit_from}
        slopes.append(f"{operation} {slope(operation, large):.2f}")
    report(arguments.out, "team_size", rows, notes(arguments, slopes))
    figure(arguments.out / "team_size.png", rows)


def teams_of(operation: str, n: int) -> int:
    """Teams in a batch: one that acts, or as many as make about ``BATCH`` robots to learn from."""
    return max(1, BATCH // n) if operation == "update" else 1


def states(teams: int, n: int) -> Tensor:
    """Random states ``[teams, n, 9]`` of robots uniform in a square with ``NEIGHBOURS`` to a disc of ``RADIUS``."""
    torch.manual_seed(0)
    side = math.sqrt(n * math.pi * RADIUS**2 / NEIGHBOURS)
    return torch.cat([side * torch.rand(teams, n, 2), torch.randn(teams, n, WIDTH - 2)], -1)


def prepare(operation: str, n: int, above: int | None) -> Callable[[], Any]:
    """The operation as a function without arguments."""
    teams = teams_of(operation, n)
    observation = states(teams, n)
    graph = GraphEncoder(WIDTH, EMBEDDING, HIDDEN, RADIUS, sparse_above=above)
    if operation == "encoder":
        return torch.no_grad()(lambda: graph(observation))
    encoder = TensorDictModule(graph, ["observation"], ["embedding"])
    denoiser = DenoisingMLP(2, EMBEDDING, (HIDDEN,) * 3)
    actor = DiffusionActor(denoiser, Bounded(-1, 1, (2,)), ["embedding"], ["action"], sampler=DDPM(5))
    if operation == "action":
        policy = TensorDictSequential(encoder, actor)
        return torch.no_grad()(lambda: policy(TensorDict({"observation": observation}, [teams])))
    qvalue = TensorDictModule(QNetwork(EMBEDDING, 2, (HIDDEN,) * 3), ["embedding", "action"], ["state_action_value"])
    loss = DIPOLoss(encoder, actor, qvalue, refine_steps=1)
    loss.make_value_estimator(gamma=0.98)
    target = SoftUpdate(loss, tau=0.005)
    flag = torch.zeros(teams, n, 1, dtype=torch.bool)
    following = {"observation": observation.clone(), "reward": torch.randn(teams, n, 1)}
    following |= {"done": flag, "terminated": flag}
    action = 2 * torch.rand(teams, n, 2) - 1
    data = TensorDict({"observation": observation, "action": action, "next": following}, [teams])

    def update() -> None:
        loss.zero_grad()
        losses = loss(data)
        (losses["loss_qvalue"] + losses["loss_actor"]).backward()
        target.step()

    return update


def prepare_all(arguments: Arguments, operation: str) -> tuple[dict[Case, Callable[[], Any]], dict[Case, float]]:
    """The operation by form and size, and the memory of each (MiB), without what would need too much."""
    calls: dict[Case, Callable[[], Any]] = {}
    memory: dict[Case, float] = {}
    per_pair = 0.0  # of the dense form
    for n in arguments.sizes:
        pairs = teams_of(operation, n) * n**2
        for form, above in FORMS.items():
            if form == "dense" and per_pair * pairs > 1024 * arguments.limit:
                continue
            calls[form, n] = prepare(operation, n, above)
            calls[form, n]()  # what is set up once is not counted
            memory[form, n] = peak_memory(calls[form, n])
            if form == "dense":
                per_pair = memory[form, n] / pairs
    return calls, memory


def row(operation: str, n: int, times: Mapping[Case, Timing], memory: Mapping[Case, float]) -> dict[str, Any]:
    """One row of the table; empty cells for a form that is left out."""
    teams = teams_of(operation, n)
    dense, sparse = (times.get((form, n)) for form in FORMS)
    assert sparse is not None
    return {
        "operation": operation,
        "robots": n,
        "teams": teams,
        "dense per team (ms)": 1e3 * dense.median / teams if dense else "",
        "sparse per team (ms)": 1e3 * sparse.median / teams,
        "dense / sparse": ratio(dense, sparse) if dense else "",
        "sparse per robot (µs)": 1e6 * sparse.median / teams / n,
        **{f"{form} memory (MiB)": memory.get((form, n), "") for form in FORMS},
    }


def slope(operation: str, times: Mapping[int, Timing]) -> float:
    """Exponent of the number of robots in the time of a team, the median of fits to single repetitions."""
    size = [math.log(n) for n in times]
    repetitions = zip(*(timing.seconds for timing in times.values()), strict=True)
    per_team = ([math.log(t / teams_of(operation, n)) for n, t in zip(times, one, strict=True)] for one in repetitions)
    return statistics.median(statistics.linear_regression(size, time).slope for time in per_team)


def peak_memory(call: Callable[[], Any]) -> float:
    """Most that PyTorch's allocator holds at a time during a call, beyond what it held before (MiB)."""
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as run:
        call()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trace.json"
        run.export_chrome_trace(str(path))
        events = [event for event in json.loads(path.read_text())["traceEvents"] if event["name"] == "[memory]"]
    held = [event["args"] for event in sorted(events, key=lambda event: event["ts"])]
    before = held[0]["Total Allocated"] - held[0]["Bytes"]
    return (max(event["Total Allocated"] for event in held) - before) / 2**20


def notes(arguments: Arguments, slopes: list[str]) -> list[str]:
    """What was measured."""
    return [
        f"Robots are uniform in a square that grows with the team: a disc of {RADIUS:g} m holds {NEIGHBOURS:g} of them "
        f"on average (fewer at the rim). Encoder {WIDTH}-{HIDDEN}-{EMBEDDING}, maximum; denoiser and critics "
        f"3 x {HIDDEN}; chain of 5 steps. Encoder and action: one team, no gradients. Update: `DIPOLoss`, both losses "
        f"forward and backward, one refinement step, soft update of the targets, as many teams as make {BATCH} robots.",
        "Medians; the ratio is taken pair by pair. Memory: the most that the allocator holds at a time during one "
        "call, beyond what it held before, from the memory events of `torch.profiler`. Dense is left out where its "
        f"memory at the size before, scaled by teams x robots², is more than {arguments.limit:g} GiB.",
        f"Exponent of n in the sparse time of a team, n >= {arguments.fit_from}: {', '.join(slopes)}.",
    ]


def figure(path: Path, rows: list[dict[str, Any]]) -> None:
    """Time a team and memory against the size of the team, both axes logarithmic."""
    styles = {"dense": {"color": "#D55E00", "marker": "o", "ls": "--"}, "sparse": {"color": "#0072B2", "marker": "s"}}
    fig, axes = plt.subplots(2, 3, figsize=(9, 5), sharex=True, sharey="row", layout="constrained")
    for column, (operation, title) in enumerate(OPERATIONS.items()):
        for ax, (measure, label) in zip(axes[:, column], MEASURES.items(), strict=True):
            for form, style in styles.items():
                key = f"{form} {measure}"
                shown = [row for row in rows if row["operation"] == operation and row[key] not in ("", 0.0)]
                ax.loglog([row["robots"] for row in shown], [row[key] for row in shown], label=form, ms=4, **style)
            ax.grid(alpha=0.3)
            if column == 0:
                ax.set_ylabel(label)
        axes[0, column].set_title(title)
        axes[1, column].set_xlabel("robots in a team")
    ticks = sorted({row["robots"] for row in rows})
    axes[1, 0].set_xticks(ticks, [str(tick) for tick in ticks])
    axes[1, 0].minorticks_off()
    axes[0, 0].legend()
    with replacing(path) as unfinished:
        fig.savefig(unfinished, dpi=150, format="png")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
