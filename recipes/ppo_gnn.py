"""DGNN and AFOR: PPO with a decentralised Gaussian policy on a graph encoder, at equal frames with ReDiG.

Run ``python recipes/ppo_gnn.py --method dgnn``, ``afor`` or ``afor_redig_reward``; the folder that it leaves is like
that of ``redig_wedge.py``. ``--clone-updates 3000`` starts from the same demonstrations, ``--help`` explains each
option.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import torch
import tyro
from finish import finish, score
from ppo_config import PPOConfig
from redig_wedge import VALIDATION_SEED, learning_rate
from run import Run, check_logger
from task import Task
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from redig.baselines import gaussian_policy, state_value
from redig.checkpoint import collection_state, set_collection_state
from redig.envs.factory import make_env
from redig.evaluation import evaluate
from redig.planning import demonstrations
from redig.policy import ACTION, OBSERVATION, PolicyConfig, build_encoder, save_policy

ARRIVED, ACTIVE, ADVANTAGE = ("agents", "info", "arrived"), ("agents", "active"), ("agents", "advantage")


def train(config: PPOConfig, end: Callable[[Run, Task], dict[str, float]] = finish) -> dict[str, float]:
    """Collect, estimate advantages, update, and ``end`` with a final evaluation; returns what that returns."""
    config = config.resolve()
    check_logger(config.logger)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    scenario = config.scenario()
    env = make_env(config.num_envs, seed=config.seed, reward_scale=config.reward_scale, **scenario)
    validation_env = make_env(config.evaluation_starts, **scenario)
    architecture = policy_architecture(config, env.observation_spec[OBSERVATION].shape[-1])
    policy = make_policy(config, architecture)
    loss = make_loss(config, architecture, policy)
    optimizer = torch.optim.Adam(loss.parameters(), config.lr, eps=1e-5, fused=True)
    folder = config.resume or config.out or Path("runs") / f"{config.method}-{config.formation}-seed{config.seed}"
    run = Run(folder, config, config.logger, resume=config.resume is not None)
    demos = demonstrated(config, folder.parent / "demonstrations") if config.clone_updates else TensorDict()
    env.set_seed(config.seed)  # VMAS has one random state for all environments: seed after the last is built
    collector = Collector(
        env,
        policy,
        frames_per_batch=config.num_envs * config.horizon,
        total_frames=-1,
        postproc=partial(robot_by_robot, team_share=config.team_share),
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=False,
    )
    experience = iter(collector)

    def validate(phase: str, updates: int) -> None:
        metrics = evaluate(policy, validation_env, seed=VALIDATION_SEED + config.seed)
        run.evaluation(metrics, phase=phase, updates=updates)
        better = score(metrics) > run.best
        run.best = max(run.best, score(metrics))
        for name in ["cloned" if phase == "clone" else "last", *(["policy"] if better else [])]:
            save_policy(folder / f"{name}.safetensors", policy, architecture, scenario)

    run.track(loss=loss, optimizer=optimizer)
    run.track_state(
        "collection", partial(collection_state, env, collector), partial(set_collection_state, env, collector)
    )
    run.restore()

    # A warm start: the mean action of the demonstrations
    for i in run.loop("clone", config.clone_updates):
        learning_rate(optimizer, config.clone_lr * (1 - 0.9 * i / config.clone_updates))
        run.step(
            cloning_loss(policy, demos[torch.randint(len(demos), (config.clone_batch,))]), optimizer, 2.0, "loss_pi"
        )
        if i + 1 == config.clone_updates:
            validate("clone", 0)

    for _ in run.loop("start", 0 if config.clone_updates else 1):
        validate("start", 0)

    rounds = config.frames // (config.num_envs * config.horizon)
    interval = max(1, config.evaluation_interval // config.horizon)
    updates = config.epochs * -(-config.num_envs * config.horizon // config.batch_size)
    for i in run.loop("online", rounds, checkpoint_every=interval):
        started = time.perf_counter()
        data = next(experience)
        learning_rate(optimizer, config.lr * (config.final_lr + (1 - config.final_lr) * (1 - i / rounds)))
        for batch in minibatches(advantages(loss, data), config.epochs, config.batch_size):
            losses = loss_terms(loss, batch)
            wanted = ("loss_critic",) if i < config.value_rounds else ("loss_objective", "loss_entropy", "loss_critic")
            run.step(torch.stack([losses[name] for name in wanted]).sum(), optimizer, config.grad_norm, "loss")
        run.figures |= {name: value.item() for name, value in losses.items()}
        run.figures["frames/s"] = len(data) * config.horizon / (time.perf_counter() - started)
        run.log(run.figures, i + 1, "train/")
        if (i + 1) % interval == 0 or i + 1 == rounds:
            validate("online", (i + 1) * updates)
    return end(run, config)


def robot_by_robot(data: TensorDictBase, team_share: float = 0.0) -> TensorDictBase:
    """What PPO needs of trajectories ``[E, T]``, with the ends of each robot's return beside its reward.

    ``team_share`` of a robot's reward is the mean of its team's.

    A robot's return ends at a collision (where that terminates) without a bootstrap, and at the end of the team's
    episode with one. A robot that has arrived is steered by the environment, so its actions are not the actor's to
    learn.
    """
    terminated = data["next", "agents", "info", "terminated"] > 0  # [E, T, n, 1]
    ended = data["next", "done"].unsqueeze(-1).expand_as(terminated)
    active = data[ARRIVED] < 0.5
    data = data.select(
        OBSERVATION,
        ACTION,
        ("agents", "action_log_prob"),
        ("next", *OBSERVATION),
        ("next", "agents", "reward"),
    )
    reward = data["next", "agents", "reward"]
    data["next", "agents", "reward"] = torch.lerp(reward, reward.mean(-2, keepdim=True), team_share)
    data["next", "agents", "terminated"] = terminated
    data["next", "agents", "done"] = terminated | ended
    data[ACTIVE] = active
    return data


def advantages(loss: ClipPPOLoss, data: TensorDictBase) -> TensorDictBase:
    """Trajectories ``[E, T]`` with advantages (GAE), standardised over the robots that act, as a flat batch."""
    with torch.no_grad():
        loss.value_estimator(data, params=loss.critic_network_params, target_params=loss.target_critic_network_params)
    data = data.reshape(-1)
    acting = data[ADVANTAGE][data[ACTIVE]]
    data[ADVANTAGE] = (data[ADVANTAGE] - acting.mean()) / acting.std().clamp_min(1e-6)
    return data


def minibatches(data: TensorDictBase, epochs: int, batch_size: int) -> Iterator[TensorDictBase]:
    """The data in random order and in pieces, once an epoch."""
    for _ in range(epochs):
        yield from data[torch.randperm(len(data))].split(batch_size)


def loss_terms(loss: ClipPPOLoss, batch: TensorDictBase) -> dict[str, Tensor]:
    """The terms of PPO's loss: of the actor over robots that act, of the value over all."""
    losses, active = loss(batch), batch[ACTIVE].squeeze(-1).float()  # [N, n]
    share = active / active.sum().clamp_min(1)
    return {
        "loss_objective": (losses["loss_objective"] * share).sum(),
        "loss_entropy": (losses["loss_entropy"] * share).sum(),
        "loss_critic": losses["loss_critic"].mean(),
    }


def cloning_loss(policy: TensorDictModule, batch: TensorDictBase) -> Tensor:
    """Squared error of the squashed mean against the demonstrated actions of robots on their way."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        predicted = policy(batch.select(OBSERVATION))[ACTION]
    active = batch[ACTIVE].float()
    return ((predicted - batch[ACTION]).square() * active).sum() / active.sum().clamp_min(1)


def demonstrated(config: PPOConfig, cache: Path) -> TensorDictBase:
    """The demonstrations of the default recipe, as a flat batch of teams."""
    env = make_env(min(250, config.num_trajectories), reward_scale=config.reward_scale, **config.scenario())
    episodes = demonstrations(env, **config.plans(), cache_dir=cache)
    data = episodes[episodes["mask"]]
    data[ACTIVE] = data[ARRIVED] < 0.5
    return data.select(OBSERVATION, ACTION, ACTIVE)


def policy_architecture(config: PPOConfig, observation_dim: int) -> PolicyConfig:
    """The policy that a configuration describes."""
    return PolicyConfig(
        **config.ends_of_policy(observation_dim),
        encoder_hidden=config.message_width,
        hidden=(config.hidden,) * 2,
        activation=config.activation,
        kind="ppo",
    )


def make_policy(config: PPOConfig, architecture: PolicyConfig) -> ProbabilisticTensorDictSequential:
    """The policy at its start."""
    bounds = torch.tensor(architecture.action_low), torch.tensor(architecture.action_high)
    encoder, width = build_encoder(architecture), architecture.embedding_dim
    return gaussian_policy(
        encoder, width, *bounds, architecture.hidden, architecture.activation, initial_std=config.initial_std
    )


def make_loss(config: PPOConfig, architecture: PolicyConfig, policy: ProbabilisticTensorDictSequential) -> ClipPPOLoss:
    """PPO's loss around a policy and a value on its own encoder, robot by robot."""
    encoder = build_encoder(architecture)
    encoder.out_keys = [("agents", "value_embedding")]
    width = architecture.embedding_dim
    critic = state_value(encoder, width, architecture.hidden, architecture.activation, config.centralised)
    loss = ClipPPOLoss(
        policy,
        critic,
        clip_epsilon=config.clip,
        entropy_coeff=config.entropy,
        critic_coeff=config.critic_coeff,
        reduction="none",
    )
    names = ("advantage", "value_target", "reward", "done", "terminated")
    loss.set_keys(
        action=ACTION,
        sample_log_prob=("agents", "action_log_prob"),
        value=("agents", "state_value"),
        **{name: ("agents", name) for name in names},
    )
    loss.make_value_estimator(ValueEstimators.GAE, gamma=config.gamma, lmbda=config.gae_lambda)
    return loss


if __name__ == "__main__":
    train(tyro.cli(PPOConfig))
