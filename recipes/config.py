"""Options of the recipe beside those of its task, with a line of help for each."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from task import SUITS, Task

PAPER: dict[str, Any] = {  # Table 3 and Sec. 3 as printed, as far as the code still has it; docs/paper.md
    "encoder": "linear", "observe_direction": False, "shared_encoder": True, "formation_reward": "spring_damper",
    "formation_weight": 1.0, "omega": 0.5, "navigation_reward": "goal_speed", "arrival_bonus": 15.0,
    "collision_penalty": 1.5, "proximity_penalty": 0.0, "arrival_terminates": True, "collision_terminates": False,
    "reward_scale": 0.01, "gamma": 0.99, "n_steps": 1, "block": 1, "tau": 0.005, "critic_lr": 3e-4, "final_lr": 1.0,
    "hidden": 256, "layer_norm": False, "critic_activation": "mish", "act_with_target": False, "noise_ratio": 1.0,
    "sampling_steps": 100, "refine_from": "policy", "refine_max_norm": None, "exploration_noise": 0.0,
    "warmup_noise": 0.0, "demonstration_share": 0.9, "final_share": 0.3, "share_steps": 3200,
}  # fmt: skip
COORDINATED: dict[str, Any] = {  # what suits demonstrations worth keeping to: small steps away from them
    "planner": "virtual_structure", "demonstration_speed": (1.0, 1.0), "formation_reward": "integrity",
    "formation_weight": 2.0, "arrival_bonus": 20.0, "proximity_penalty": 2.0, "refine_max_norm": 0.05,
    "final_share": 0.5,
}  # fmt: skip
SMOKE: dict[str, Any] = {  # the whole program in under a minute; it learns nothing
    "num_trajectories": 20, "clone_updates": 20, "critic_updates": 20, "warmup_steps": 10, "env_steps": 20,
    "collect_steps": 10, "evaluation_interval": 10, "evaluation_starts": 8, "num_starts": 8, "num_envs": 8,
    "hidden": 32, "max_steps": 50,
}  # fmt: skip


@dataclass
class Config(Task):
    """Train ReDiG on a team that crosses a narrow corridor in formation. Defaults differ from the paper's Table 3 where
    its plain recipe does not survive online training; docs/paper.md says what and why.
    """

    paper: bool = False
    """The method as printed, as far as the code still has it: sets all options that docs/paper.md names for it, over
    what the command line gives for them."""

    coordinated: bool = False
    """Demonstrations of one plan for the team instead of one a robot, and what suits them: sets all options of
    recipes/config.py: COORDINATED, over what the command line gives for them."""

    # what differs from robot to robot and from step to step in training and validation, not in the final evaluation;
    # of these, demonstrations have the wheels only
    action_delay: tuple[int, int] = (0, 0)
    """Smallest and largest delay of commands (steps), drawn for each team and episode."""
    observation_noise: float = 0.0
    """Standard deviation of noise on what robots sense (m, m/s)."""
    acceleration_range: tuple[float, float] = (1.0, 1.0)
    """Smallest and largest factor on the acceleration limit, drawn for each team and episode."""
    turn_gain: tuple[float, float] | None = None
    """Robots have wheels, and turn towards commands at a rate between these two (1/s), drawn for each team and
    episode; None: they move in any direction at once."""

    # demonstrations and cloning
    planner: str = "astar"
    """astar or rrt: each robot plans alone; virtual_structure: teams that are coordinated by one plan."""
    clone_updates: int = 3000
    """Updates of the diffusion loss on demonstrations before online training."""
    clone_batch: int = 128
    """Teams in a batch of cloning."""
    clone_lr: float = 1e-3
    """Learning rate of cloning, annealed to a tenth."""

    # online training
    num_envs: int = 64
    """Teams simulated in parallel."""
    warmup_steps: int = 200
    """Steps of all teams with the cloned policy before the actor moves."""
    critic_updates: int = 2500
    """Updates of the critics alone before the actor moves."""
    env_steps: int = 3200
    """Steps of all teams during online training."""
    collect_steps: int = 20
    """Steps of all teams between updates."""
    updates_per_step: int = 4
    """Critic updates for each step of all teams; the actor is updated half as often."""
    batch_size: int = 52
    """Teams in a batch."""
    block: int = 4
    """Critic updates whose TD targets are computed at once, and actions refined; then the target networks step once.
    1: for each update anew, as printed; tau is then 0.01."""
    buffer_size: int = 250_000
    """Capacity of the replay buffer, in team transitions."""
    buffer_on_disk: bool = False
    """Keep the replay buffer in the folder of the run (about 0.7 GB for a million teams of five), not in memory."""
    n_steps: int = 5
    """Length of n-step returns."""
    gamma: float = 0.98
    """Discount factor (paper: 0.99)."""
    tau: float = 0.04
    """Rate of the target networks, once a block (paper: 0.005, at each update)."""
    critic_lr: float = 5e-4
    """Learning rate of the critics (paper: 3e-4)."""
    actor_lr: float = 3e-4
    """Learning rate of encoder and denoiser."""
    final_lr: float = 0.1
    """Share of both learning rates that is left at the end; they fall linearly."""
    grad_norm: float = 2.0
    """Limit on the norm of gradients."""
    refine_steps: int = 1
    """Gradient steps on each action."""
    refine_step_size: float = 0.3
    """Eta of the action refinement."""
    refine_max_norm: float | None = 0.1
    """Limit on how far refinement moves an action (m/s)."""
    refine_from: str = "stored"
    """Refine the stored action (DIPO) or one freshly sampled from the policy (Algorithm 1 as printed)."""
    act_with_target: bool = True
    """Act and evaluate with the target policy, the Polyak average of the one that learns."""
    exploration_noise: float = 0.15
    """Standard deviation of the noise on executed commands (m/s)."""
    warmup_noise: float = 0.3
    """The same during warm-up."""
    demonstration_share: float = 0.5
    """Share of demonstrations in a critic batch at first; half of it in an actor batch."""
    final_share: float = 0.02
    """Share of demonstrations in all batches after share_steps."""
    share_steps: int = 1500
    """Steps over which the share falls."""
    shared_encoder: bool = False
    """One encoder for actor and critics, trained by both losses as in the paper, instead of one each."""
    detach_encoder: bool = False
    """Keep the critics' loss from a shared encoder."""

    # networks and sampling
    actor: str = "diffusion"
    """diffusion; or gaussian or deterministic, trained in exactly the same way, to compare with."""
    hidden: int = 128
    """Width of the three hidden layers of denoiser and critics (paper: 256)."""
    activation: str = "mish"
    """Nonlinearity of the denoiser: mish, silu (much cheaper on a CPU, but teams learn more slowly), relu or tanh."""
    layer_norm: bool = True
    """LayerNorm in the critics."""
    critic_activation: str = "relu"
    """Nonlinearity of the critics (paper: mish, which costs a quarter more time)."""
    diffusion_steps: int = 100
    """K."""
    schedule: str = "cosine"
    """cosine, linear or vp."""
    sampling_steps: int = 5
    """Steps of the strided sampling chain."""
    noise_ratio: float = 0.0
    """Noise added within the chain (ddpm): 0 follows the posterior mean, 1 is Table 3's."""
    sampler: str = "ddpm"
    """ddpm, ddim or dpmsolver."""
    eta: float = 0.0
    """Noise of ddim, from 0 to 1."""
    best_of_n: int = 1
    """Collect with the best of N sampled actions by min Q; 1: off. Evaluations are of the policy itself."""

    # several machines
    ray: str | None = None
    """Collect on the Ray cluster at this address (HOST:PORT or auto), or on a new one on this machine (local)."""
    ray_workers: int = 2
    """Workers there, of one CPU each, which share num_envs equally."""

    def randomisation(self) -> dict[str, Any]:
        """Arguments of :func:`redig.envs.make_env` for the teams that train, beside those of the scenario."""
        scaled = tuple(self.acceleration_range) != (1, 1)
        return {
            "action_delay": self.action_delay,
            "observation_noise": self.observation_noise,
            "acceleration_range": self.acceleration_range if scaled else None,
            "turn_gain": self.turn_gain,
        }

    def resolve(self) -> Config:
        """The configuration to run: that of a run to resume, or this one at toy size, checked.

        Raises:
            FileNotFoundError: if the folder to resume holds no run.
            ValueError: for an option out of its range.
        """
        if self.resume is not None:
            return self.saved()
        if self.paper and self.coordinated:
            raise ValueError("paper: its robots are not coordinated by one plan, so not with coordinated")
        preset = (PAPER if self.paper else COORDINATED if self.coordinated else {}) | (SMOKE if self.smoke else {})
        config = dataclasses.replace(self, **preset).filled(SUITS.get(self.formation, SUITS["wedge"]))
        config.check_positive(
            "num_trajectories", "clone_updates", "clone_batch", "num_envs", "collect_steps", "updates_per_step",
            "batch_size", "buffer_size", "max_steps", "evaluation_interval", "evaluation_starts", "num_starts",
            "hidden", "best_of_n", "ray_workers",
        )  # fmt: skip
        round_updates = config.collect_steps * config.updates_per_step
        if config.block < 1 or round_updates % config.block:
            raise ValueError(
                f"block: got {config.block}, must divide collect_steps * updates_per_step = {round_updates} updates"
            )
        if config.ray is not None and config.num_envs % config.ray_workers:
            raise ValueError(f"ray_workers: got {config.ray_workers}, must divide num_envs = {config.num_envs}")
        if config.ray is not None and config.best_of_n > 1:
            raise ValueError("best_of_n: with ray it must be 1, the critics do not travel to the workers")
        for name in ("demonstration_share", "final_share"):
            if not 0 <= getattr(config, name) <= 1:
                raise ValueError(f"{name}: got {getattr(config, name)}, must be in [0, 1]")
        return config
