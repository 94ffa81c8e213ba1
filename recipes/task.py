"""The task that a team is trained for, and what every recipe that trains one has, with a line of help for each."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from redig.envs.random_maps import MAP_KINDS

# What suits each formation: too much weight, and a team keeps its shape rather than arrive; the bonus hurries it on.
# Robots that plan alone at one speed collide in a line, as all reach the corridor at once; at their own they do less.
SUITS: dict[str, dict[str, Any]] = {
    "wedge": {
        "formation_weight": 3.5, "formation_tolerance": 0.25, "arrival_bonus": 20.0, "demonstration_speed": (0.9, 1.0),
    },
    "line": {
        "formation_weight": 1.0, "formation_tolerance": 0.5, "arrival_bonus": 10.0, "demonstration_speed": (0.5, 1.0),
    },
    "circle": {
        "formation_weight": 2.0, "formation_tolerance": 0.5, "arrival_bonus": 20.0, "demonstration_speed": (0.9, 1.0),
    },
}  # fmt: skip

# What runs were trained with whose configuration, from before there was a choice, says nothing of it
BEFORE: dict[str, Any] = {"direction_smoothing": 0.0, "formation_tolerance": 0.5}


@dataclass
class Task:
    """What every recipe that trains a team has: its run, the task, the reward and the evaluation."""

    out: Path | None = None
    """Folder of the run; default runs/FORMATION-seedSEED."""
    seed: int = 0
    """Seed of everything: demonstrations, networks, training and evaluation starts."""
    resume: Path | None = None
    """Continue the run in this folder with its own configuration; all other options are ignored."""
    smoke: bool = False
    """Do everything at toy size, in under a minute."""
    logger: str = "csv"
    """csv, tensorboard or wandb (set WANDB_MODE=offline to log without a network)."""
    threads: int | None = None
    """Threads of PyTorch; default: its own choice. Results are bit-exact for a given number."""

    # the task
    formation: str = "wedge"
    """wedge, line or circle."""
    n_robots: int = 5
    """Robots in the team."""
    formation_width: float = 2.0
    """Width of the formation (m)."""
    map: str = "corridor"
    """corridor (of the next two sizes), another kind of redig.envs.MAP_KINDS, of which every team gets its own random
    map, or the path of a YAML file as ROS map servers write it, with gap and route."""
    corridor_width: float = 1.1
    """Width of the corridor (m)."""
    corridor_length: float = 2.0
    """Length of the corridor (m)."""
    max_speed: float = 1.0
    """Speed limit (m/s)."""
    max_acceleration: float = 2.0
    """Acceleration limit (m/s²)."""
    max_steps: int = 200
    """Steps of 0.1 s until a team's episode is cut; a longer map may need more."""
    observe_direction: bool = True
    """Observe the direction to the nearest obstacle; without it the state is the paper's seven numbers."""
    direction_smoothing: float = 0.05
    """How far to either side of where the nearest obstacle changes that direction turns (m); 0: it jumps there, and
    robots tremble on the midline of a corridor."""

    # the reward
    formation_reward: str = "scaled"
    """scaled, slanted, integrity (tau of the CFI), spring_damper_bonus, spring_damper (Eq. 29) or none."""
    formation_weight: float | None = None
    """Weight of the formation reward against progress in m/s; default: what suits the formation."""
    formation_tolerance: float | None = None
    """How far from its place in the formation a robot's bonus is gone (m), of scaled and slanted; default: what suits
    the formation."""
    omega: float = 0.8
    """Balance of spring and damper in the spring-damper forms (paper: 0.5)."""
    navigation_reward: str = "progress"
    """progress or goal_speed (Eq. 30)."""
    time_cost: float = 0.0
    """What each step costs a robot until it arrives, against progress in m/s: it hurries a team. Keep it well below
    the formation's weight, or a robot gains by ending it all in a collision (paper: none)."""
    arrival_bonus: float | None = None
    """Paid once to a robot on arrival (paper: 15); default: what suits the formation."""
    collision_penalty: float = 20.0
    """Penalty of a collision (paper: 1.5)."""
    proximity_penalty: float = 0.5
    """Ramp within 0.1 m of contact (paper: none)."""
    collision_terminates: bool = True
    """A collision ends the robot's return: its value is not bootstrapped."""
    arrival_terminates: bool = False
    """An arrival ends the robot's return; otherwise it holds and goes on earning the formation reward."""
    reward_scale: float = 0.1
    """Scale of the reward (paper: 0.01)."""

    # demonstrations
    num_trajectories: int = 5000
    """Trajectories of single robots."""
    demonstration_speed: tuple[float, float] | None = None
    """Lowest and highest speed of a demonstrating robot, or coordinated team (m/s); default: what suits the
    formation."""

    # what robots hear of each other
    encoder: str = "edgeconv"
    """edgeconv; linear as printed in the paper; or relu, the same with a ReLU behind W^z."""
    edge_features: str = "state"
    """What a message says of the difference between two robots: all of their state, or position only."""
    radius: float = 2.0
    """Communication range (m)."""

    # evaluation
    evaluation_interval: int = 200
    """Steps of all teams between evaluations and checkpoints."""
    evaluation_starts: int = 128
    """Starts of an evaluation during training; the best policy is chosen on these."""
    num_starts: int = 256
    """Starts of the final evaluation, never trained on and never used for a choice."""

    def scenario(self, split: str = "train") -> dict[str, Any]:
        """Arguments of :func:`redig.envs.make_env` that make the task; random maps are those of a split."""
        names = (
            "formation", "n_robots", "formation_width", "corridor_width", "corridor_length", "max_speed",
            "max_acceleration", "observe_direction", "direction_smoothing", "formation_reward", "formation_weight",
            "formation_tolerance", "omega", "navigation_reward", "time_cost", "arrival_bonus", "collision_penalty",
            "proximity_penalty", "collision_terminates", "arrival_terminates",
        )  # fmt: skip
        arguments = {name: getattr(self, name) for name in names}
        if self.max_steps != Task.max_steps:  # files from before there was a choice say nothing of it
            arguments["max_steps"] = self.max_steps
        if self.map != "corridor":
            arguments["obstacle_map"] = f"{self.map}:{split}" if self.map in MAP_KINDS else self.map
        return arguments

    def plans(self) -> dict[str, Any]:
        """Arguments of :func:`redig.planning.demonstrations` that make the demonstrations, beside the planner."""
        return {
            "num_trajectories": self.num_trajectories,
            "speed": self.demonstration_speed,
            "max_steps": self.max_steps,
            "seed": self.seed,
        }

    def ends_of_policy(self, observation_dim: int) -> dict[str, Any]:
        """What every policy of the task has: the encoder that its observations go into, and the bounds of commands."""
        return {
            "observation_dim": observation_dim,
            "action_low": (-self.max_speed,) * 2,
            "action_high": (self.max_speed,) * 2,
            "encoder": "linear" if self.encoder == "relu" else self.encoder,
            "encoder_activation": None if self.encoder == "linear" else "relu",
            "edge_features": self.edge_features,
            "radius": self.radius,
        }

    def saved(self) -> Self:
        """The configuration of the run in the folder to resume.

        Raises:
            FileNotFoundError: if the folder holds no run.
        """
        path = self.resume / "config.json" if self.resume else None
        if path is None or not path.is_file():
            raise FileNotFoundError(f"resume: {self.resume} holds no run (no config.json)")
        return dataclasses.replace(
            self, **{**BEFORE, **json.loads(path.read_text()), "resume": self.resume, "out": None}
        )

    def filled(self, defaults: dict[str, Any]) -> Self:
        """This configuration with ``defaults`` in place of what is None."""
        missing = {name: value for name, value in defaults.items() if getattr(self, name) is None}
        return dataclasses.replace(self, **missing)

    def check_positive(self, *names: str) -> None:
        """Raise a ValueError that names the first of these options that is less than 1."""
        for name in names:
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: got {getattr(self, name)}, must be at least 1")
