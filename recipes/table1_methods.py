"""The methods of Table 1 and of the ablations: how each is trained, and where its policy is."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from classic import METHODS as PLANNERS
from config import Config
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from redig.envs.formations import FORMATIONS
from redig.files import replacing
from redig.policy import load_policy, read_header

RECIPES = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Method:
    """A row of the table."""

    title: str
    recipe: str | None = None
    """The recipe that trains it; none for a method that plans, or that another one leaves behind."""
    options: tuple[str, ...] = ()
    of: str | None = None
    """The method whose runs leave its policy behind."""
    file: str = "policy.safetensors"
    formations: tuple[str, ...] = FORMATIONS
    """Where it differs from the other methods."""


# Earlier defaults: a wedge's formation reward reaches as far as 0.5 m (circle's and line's still does); that, and the
# observed direction to obstacles jumps on midlines; that, and robots of the demonstrations drive at speeds of their own
# (of the line they still do)
LENIENT = ("--formation-tolerance", "0.5")
JUMPS = ("--direction-smoothing", "0", *LENIENT)
SLOWER = ("--demonstration-speed", "0.5", "1", *JUMPS)
WEDGE, NOT_LINE = ("wedge",), ("circle", "wedge")

# What suits PPO that starts from a clone (docs/results/ppo)
PPO_CLONED = (
    *("--method", "afor_redig_reward", "--clone-updates", "2000"),
    *("--value-rounds", "8", "--initial-std", "0.2", "--lr", "3e-4"),
)

GAUSSIAN, DETERMINISTIC = ("--actor", "gaussian"), ("--actor", "deterministic")

METHODS: dict[str, Method] = {
    "redig": Method("ReDiG", "redig_wedge.py"),
    "leader_follower": Method("L&F"),
    "dgnn": Method("DGNN (PPO)", "ppo_gnn.py", ("--method", "dgnn")),
    "afor": Method("AFOR (PPO, spring-damper)", "ppo_gnn.py", ("--method", "afor")),
    "afor_redig_reward": Method("AFOR with ReDiG's reward", "ppo_gnn.py", ("--method", "afor_redig_reward")),
    "ppo_cloned": Method("the same, from a clone", "ppo_gnn.py", PPO_CLONED),
    "redig_coordinated": Method("ReDiG, coordinated demonstrations", "redig_wedge.py", ("--coordinated",)),
    "gaussian": Method("Gaussian actor, trained as ReDiG", "redig_wedge.py", GAUSSIAN),
    "deterministic": Method("deterministic actor, trained as ReDiG", "redig_wedge.py", DETERMINISTIC),
    "cloned": Method("ReDiG before online training", of="redig", file="cloned.safetensors"),
    "cloned_coordinated": Method(
        "ReDiG, coordinated, before online training", of="redig_coordinated", file="cloned.safetensors"
    ),
    "uncoordinated": Method("planners without coordination"),
    "virtual_structure": Method("virtual structure (centralised)"),
}

SPRING = ("--formation-reward", "spring_damper_bonus")


def changed(title: str, *options: str, formations: tuple[str, ...] = FORMATIONS) -> Method:
    """The recipe with its earlier defaults and these options."""
    return Method(title, "redig_wedge.py", (*options, *SLOWER), formations=formations)


# Rows of recipes/ablations.py: the defaults, one by one, and the recipe with its earlier ones and one thing changed
ABLATIONS: dict[str, Method] = {
    "redig": METHODS["redig"],
    "redig_lenient": Method("ReDiG, tolerance 0.5 m", "redig_wedge.py", LENIENT, formations=WEDGE),
    "redig_jumps": Method("ReDiG, tolerance 0.5 m, direction that jumps", "redig_wedge.py", JUMPS),
    "redig_slower": changed("ReDiG, all earlier defaults", formations=NOT_LINE),
    "gaussian_slower": changed("Gaussian actor, all earlier defaults", *GAUSSIAN, formations=NOT_LINE),
    "deterministic_slower": changed("deterministic actor, all earlier defaults", *DETERMINISTIC, formations=NOT_LINE),
    "redig_coordinated": METHODS["redig_coordinated"],
    "coordinated_jumps": Method(
        "ReDiG, coordinated demonstrations, direction that jumps", "redig_wedge.py", ("--coordinated", *JUMPS)
    ),
    "paper": changed("the paper, as printed", "--paper"),
    "diffusion_spring": changed("diffusion, spring-damper bonus", *SPRING),
    "gaussian_spring": changed("no diffusion, spring-damper bonus", *GAUSSIAN, *SPRING),
    "gaussian_none": changed("no diffusion, no formation reward", *GAUSSIAN, "--formation-reward", "none"),
    "diffusion_none": changed("diffusion, no formation reward", "--formation-reward", "none"),
    "encoder_linear": changed("linear encoder, as printed", "--encoder", "linear"),
    "encoder_relu": changed("linear encoder with ReLU", "--encoder", "relu"),
    "edges_position": changed("messages of positions only", "--edge-features", "position"),
    "no_direction": changed("no direction to the obstacle", "--no-observe-direction"),
    "steps_10": changed("K = 10", "--diffusion-steps", "10"),
    "steps_1000": changed("K = 1000", "--diffusion-steps", "1000"),
    "refine_3": changed("three refinement steps of η/3", "--refine-steps", "3", "--refine-step-size", "0.1"),
    "eta_0.1": changed("η = 0.1", "--refine-step-size", "0.1"),
    "eta_1": changed("η = 1", "--refine-step-size", "1"),
    "no_online_demos": changed("no demonstrations online", "--demonstration-share", "0", "--final-share", "0"),
    "constant_demos": changed("half of batches demonstrations", "--final-share", "0.5"),
    "no_layer_norm": changed("critics without LayerNorm", "--no-layer-norm"),
}


def find(name: str) -> Method:
    """A method of the table or of the ablations."""
    return METHODS[name] if name in METHODS else ABLATIONS[name]


@dataclass(frozen=True)
class Job:
    """One method on one formation with one seed."""

    method: str
    formation: str
    seed: int | None
    folder: Path

    @property
    def name(self) -> str:
        """METHOD:FORMATION, and :SEED where it is trained."""
        return f"{self.method}:{self.formation}" + (f":{self.seed}" if self.seed is not None else "")

    @property
    def command(self) -> tuple[str, ...]:
        """The recipe and its options; empty for what is not trained."""
        method = find(self.method)
        if method.recipe is None:
            return ()
        return (
            method.recipe,
            "--formation",
            self.formation,
            "--seed",
            str(self.seed),
            "--threads",
            "1",
            *method.options,
        )

    @property
    def policy(self) -> Path | None:
        """The policy file; none for a method that plans."""
        return None if self.method in PLANNERS else self.folder / find(self.method).file

    @property
    def starts_file(self) -> Path:
        """The CSV file with the metrics of each start."""
        return self.folder / f"starts-{Path(find(self.method).file).stem}.csv"

    def matches(self, only: Sequence[str]) -> bool:
        """Whether one of METHOD, METHOD:FORMATION, METHOD:FORMATION:SEED names it, or nothing is asked for."""
        parts = self.name.split(":")
        return not only or any(parts[: len(wanted.split(":"))] == wanted.split(":") for wanted in only)

    def ready(self) -> bool:
        """Whether it can be evaluated: its training has ended and left a policy, or it needs neither."""
        return self.policy is None or ((self.folder / "metrics.json").exists() and self.policy.exists())

    def arguments(self, options: str) -> list[str]:
        """The command line that trains it, from the start or from its checkpoint."""
        recipe, *given = self.command
        if (self.folder / "config.json").exists():
            return [str(RECIPES / recipe), "--resume", str(self.folder)]
        return [str(RECIPES / recipe), *given, "--out", str(self.folder), *shlex.split(options)]

    def add_seconds(self, seconds: float) -> None:
        """Add to the wall clock of its training, over all interruptions."""
        with replacing(self.folder / "seconds.json") as file:
            file.write_text(json.dumps(self.seconds() + seconds))

    def seconds(self) -> float:
        """Wall clock of its training (s)."""
        path = self.folder / "seconds.json"
        return json.loads(path.read_text()) if self.command and path.exists() else 0.0

    def frames(self) -> int:
        """Steps of single teams that its training collected, without demonstrations."""
        path = self.folder / "config.json"
        if not self.command or not path.exists():
            return 0
        config = json.loads(path.read_text())
        return config.get("frames") or config["num_envs"] * (config["warmup_steps"] + config["env_steps"])

    def scenario(self, options: str) -> dict[str, Any]:
        """Arguments of the scenario that it is evaluated in: what it was trained in, or options of the recipes say."""
        if self.policy is None:
            config = tyro.cli(Config, args=["--formation", self.formation, *shlex.split(options)])
            return config.resolve().scenario("evaluation")
        scenario = read_header(self.policy)[1]
        if scenario.get("obstacle_map", "").endswith(":train"):
            scenario["obstacle_map"] = scenario["obstacle_map"].replace(":train", ":evaluation")
        return scenario


def jobs(
    formations: Sequence[str], seeds: Sequence[int], runs: Path, methods: Mapping[str, Method] = METHODS
) -> list[Job]:
    """All of a table, those first that others need."""
    found = []
    for formation in formations:
        for method, what in methods.items():
            if formation not in what.formations:
                continue
            for seed in [None] if method in PLANNERS else seeds:
                suffix = "" if seed is None else f"-seed{seed}"
                found.append(Job(method, formation, seed, runs / f"{what.of or method}-{formation}{suffix}"))
    return found


def load(job: Job, env: EnvBase) -> TensorDictModuleBase:
    """The policy of a job, for an environment."""
    return PLANNERS[job.method](env.scenario) if job.policy is None else load_policy(job.policy)
