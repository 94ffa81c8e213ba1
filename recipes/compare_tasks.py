"""The tasks of the comparison: environments, budgets, and the options of one run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, GymEnv, SerialEnv, StepCounter, TransformedEnv, VmasEnv

GYM = {"pendulum": "Pendulum-v1"}
VMAS: dict[str, dict[str, Any]] = {
    "navigation": {"scenario": "navigation", "n_agents": 3},
    "reverse_transport": {"scenario": "reverse_transport", "n_agents": 3},
}
SINGLE_AGENT: dict[str, Any] = {  # TorchRL's SAC and TD3: one update a frame, batches of 256, gamma 0.99
    "frames": 6000, "num_envs": 1, "frames_per_batch": 50, "random_frames": 1000, "updates_per_batch": 50,
    "batch_size": 256, "gamma": 0.99, "episode_steps": 200, "evaluation_frames": 500, "episodes": 10,
}  # fmt: skip
TEAM: dict[str, Any] = {  # TorchRL's MADDPG and MASAC: gamma 0.9; smaller batches, and a replay of all frames
    "frames": 60_000, "num_envs": 50, "frames_per_batch": 1000, "random_frames": 5000, "updates_per_batch": 25,
    "batch_size": 256, "gamma": 0.9, "episode_steps": 100, "evaluation_frames": 5000, "episodes": 64,
}  # fmt: skip
BUDGETS = {name: SINGLE_AGENT for name in GYM} | {name: TEAM for name in VMAS}


@dataclass(frozen=True)
class Config:
    """One run. A frame is a step of one environment, whatever the number of its agents."""

    task: str
    method: str
    seed: int
    frames: int
    """Frames to collect, random ones included."""
    num_envs: int
    frames_per_batch: int
    """Frames collected between updates."""
    random_frames: int
    """Frames of uniformly random actions at first, without updates."""
    updates_per_batch: int
    batch_size: int
    """Transitions in a batch; a transition is that of a whole team."""
    gamma: float
    episode_steps: int
    """Steps after which an episode is truncated; its last value is bootstrapped."""
    evaluation_frames: int
    """Frames between evaluations."""
    episodes: int
    """Episodes of an evaluation, always the same starts."""
    lr: float = 3e-4
    """Learning rate of all networks."""
    hidden: int = 256
    """Width of the two hidden layers of every network."""
    tau: float = 0.005
    """Rate of the target networks."""
    alpha_init: float = 1.0
    """SAC: first weight of the entropy, which is then learned."""


@dataclass(frozen=True)
class Keys:
    """Where an environment keeps what a method reads: at the root, or in the group of the agents."""

    observation: NestedKey
    action: NestedKey
    reward: NestedKey
    done: NestedKey
    terminated: NestedKey
    state_action_value: NestedKey

    @classmethod
    def of(cls, env: EnvBase) -> Keys:
        """The keys of an environment; done flags are where its reward is, see :func:`transitions`."""
        group = env.reward_key[:-1] if isinstance(env.reward_key, tuple) else ()
        names = ("observation", "action", "reward", "done", "terminated", "state_action_value")
        return cls(*((*group, name) if group else name for name in names))


def make_env(task: str, num_envs: int, episode_steps: int, seed: int) -> EnvBase:
    """Environments of a task, truncated after ``episode_steps``; batch size ``[num_envs]``, or none for one Gym."""
    if task in VMAS:
        env: EnvBase = VmasEnv(num_envs=num_envs, seed=seed, **VMAS[task])
    elif num_envs == 1:
        env = GymEnv(GYM[task])
    else:
        env = SerialEnv(num_envs, lambda: GymEnv(GYM[task]))
    env = TransformedEnv(env, StepCounter(episode_steps))
    env.set_seed(seed)
    return env


def transitions(data: TensorDictBase, keys: Keys) -> TensorDictBase:
    """What the replay buffer keeps of collected frames, flat; a team's done flags are given to each of its agents."""
    data = data.reshape(-1)
    kept = data.select(keys.observation, keys.action, ("next", keys.observation), ("next", keys.reward))
    reward = kept["next", keys.reward]
    for name, key in (("done", keys.done), ("terminated", keys.terminated)):
        flag = data["next", name]
        kept["next", key] = flag.reshape(len(data), *[1] * (reward.ndim - 1)).expand_as(reward).clone()
    return kept
