"""Options of the PPO baselines, with a line of help for each."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from task import SUITS, Task

# What each method is paid for; all else, and what is not given on the command line, is as in the default recipe.
METHODS: dict[str, dict[str, Any]] = {
    "dgnn": {"formation_reward": "none"},
    "afor": {"formation_reward": "spring_damper_bonus", "formation_weight": 0.1},  # as printed, nobody arrives
    "afor_redig_reward": {},
}
SMOKE: dict[str, Any] = {  # the whole program in under a minute; it learns nothing
    "num_trajectories": 20, "clone_updates": 4, "frames": 640, "horizon": 20, "epochs": 1, "num_envs": 8,
    "evaluation_interval": 40, "evaluation_starts": 8, "num_starts": 8, "hidden": 32,
    "max_steps": 50,
}  # fmt: skip


@dataclass
class PPOConfig(Task):
    """Train a decentralised Gaussian policy on a graph encoder with PPO: DGNN, AFOR, or AFOR with ReDiG's reward."""

    method: str = "dgnn"
    """dgnn: navigation and collisions only; afor: and the spring-damper reward; afor_redig_reward: the reward of the
    default recipe."""
    formation_reward: str | None = None  # type: ignore[assignment]
    """As in the default recipe: scaled, spring_damper_bonus, spring_damper (Eq. 29), none, …; default: the method's."""

    # a warm start
    clone_updates: int = 0
    """Updates that clone the demonstrations of the default recipe before PPO; 0: start from nothing."""
    clone_batch: int = 128
    """Teams in a batch of cloning."""
    clone_lr: float = 1e-3
    """Learning rate of cloning, annealed to a tenth."""
    value_rounds: int = 0
    """Rounds of collection in which only the value is learned, so that PPO does not follow a random one."""

    # PPO
    frames: int = 217_600
    """Steps of single teams, collection and warm-up together: those of the default recipe."""
    num_envs: int = 64
    """Teams simulated in parallel."""
    horizon: int = 50
    """Steps of all teams in a round of collection."""
    epochs: int = 5
    """Passes over the data of a round."""
    batch_size: int = 400
    """Teams in a minibatch."""
    lr: float = 5e-4
    """Learning rate of Adam."""
    final_lr: float = 0.1
    """Share of the learning rate that is left at the end; it falls linearly."""
    gamma: float = 0.98
    """Discount factor."""
    gae_lambda: float = 0.95
    """Lambda of the generalised advantage estimate."""
    team_share: float = 0.0
    """Share of the team's mean in a robot's reward, from 0 to 1. With their own rewards alone, robots that stand in
    formation stay there: leaving alone costs each one what leaving together would not."""
    clip: float = 0.2
    """Range of the clipped probability ratio."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    critic_coeff: float = 1.0
    """Weight of the value loss."""
    grad_norm: float = 1.0
    """Limit on the norm of gradients."""
    initial_std: float = 0.5
    """Standard deviation of the Gaussian before squashing, at first."""
    centralised: bool = False
    """Give the value the mean embedding of the whole team."""

    # networks
    message_width: int = 128
    """Width of the messages between robots."""
    hidden: int = 128
    """Width of the two hidden layers of policy and value."""
    activation: str = "tanh"
    """Nonlinearity of policy and value: tanh, relu, mish or silu."""

    def resolve(self) -> PPOConfig:
        """The configuration to run: that of a run to resume, or this one with the method's defaults, checked.

        Raises:
            FileNotFoundError: if the folder to resume holds no run.
            ValueError: for an option out of its range.
        """
        if self.resume is not None:
            return self.saved()
        if self.method not in METHODS:
            raise ValueError(f"method: got {self.method!r}, allowed are {', '.join(METHODS)}")
        config = dataclasses.replace(self, **SMOKE) if self.smoke else self
        config = config.filled(METHODS[config.method]).filled(SUITS.get(config.formation, SUITS["wedge"]))
        config = config.filled({"formation_reward": Task.formation_reward})
        config.check_positive(
            "num_envs", "horizon", "epochs", "batch_size", "hidden", "num_trajectories", "clone_batch",
            "max_steps", "evaluation_interval", "evaluation_starts", "num_starts",
        )  # fmt: skip
        if not 0 <= config.team_share <= 1:
            raise ValueError(f"team_share: got {config.team_share}, must be in [0, 1]")
        if config.frames < config.num_envs * config.horizon:
            raise ValueError(
                f"frames: got {config.frames}, must be at least one round, num_envs * horizon = "
                f"{config.num_envs * config.horizon}"
            )
        return config
