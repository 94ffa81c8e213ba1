"""ReDiG (Algorithm 1): demonstrations, cloning, online training and evaluation of a team that crosses a corridor.

Run ``python recipes/redig_wedge.py``; everything goes into one folder under ``runs/``. ``--formation line`` or
``circle`` trains the other formations (as ``redig_line.py`` and ``redig_circle.py`` do), ``--ray ADDRESS`` collects on
a Ray cluster, ``--help`` explains each option.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

import torch
import tyro
from config import Config
from finish import finish, score
from run import Run, check_logger
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import SoftUpdate

from redig.checkpoint import collection_state, set_collection_state
from redig.disk_storage import DiskStorage
from redig.envs.factory import make_env
from redig.evaluation import evaluate
from redig.modules import BestOfN, QNetwork
from redig.objectives import DIPOLoss, MultiStep
from redig.planning import demonstrations
from redig.policy import ACTION, EMBEDDING, OBSERVATION, PolicyConfig, build_encoder, build_policy, save_policy
from redig.ray_collection import RayCollection

ARRIVED = ("agents", "info", "arrived")
BASE_ACTION = ("agents", "policy_action")  # the policy's action before exploration noise
REFINED_ACTION = ("agents", "refined_action")
VALIDATION_SEED = 1_000_000  # starts to choose the best policy on; training and final evaluation use others


def train(config: Config) -> dict[str, float]:
    """Algorithm 1, line by line; returns the metrics of the policy that it leaves."""
    config = config.resolve()
    check_logger(config.logger)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    scenario = config.scenario()
    trained = scenario | config.randomisation()
    env = make_env(config.num_envs, seed=config.seed, reward_scale=config.reward_scale, **trained)
    validation_env = make_env(config.evaluation_starts, **trained)

    # Line 1: initialise phi, psi, Q1 and Q2
    policy_config = policy_architecture(config, env.observation_spec[OBSERVATION].shape[-1])
    learner = build_policy(policy_config)
    loss = make_loss(config, policy_config, learner)
    target = SoftUpdate(loss, tau=config.tau)
    policy = averaged_policy(loss, policy_config) if config.act_with_target else learner
    actor_optimizer, critic_optimizer = make_optimizers(config, loss)
    folder = config.resume or config.out or Path("runs") / f"{config.formation}-seed{config.seed}"
    run = Run(folder, config, config.logger, resume=config.resume is not None)

    # Line 2: individual planners fill the buffer with uncoordinated trajectories
    multi_step = MultiStep(config.n_steps, config.gamma, keep=[OBSERVATION, ACTION, BASE_ACTION, ARRIVED])
    same_robots = {**scenario, "turn_gain": config.turn_gain}  # but no delay, noise or weak motors
    demo_env = make_env(min(250, config.num_trajectories), reward_scale=config.reward_scale, **same_robots)
    cache = folder.parent / "demonstrations"
    episodes = demonstrations(demo_env, planner=config.planner, **config.plans(), cache_dir=cache)
    demos = transitions(multi_step(episodes)[episodes["mask"]], demonstration=True)
    on_disk = config.buffer_on_disk
    storage = DiskStorage(config.buffer_size, folder / "buffer") if on_disk else LazyTensorStorage(config.buffer_size)
    buffer = TensorDictReplayBuffer(storage=storage)

    env.set_seed(config.seed)  # VMAS has one random state for all environments: seed after the last is built
    bounds = env.full_action_spec_unbatched[ACTION]  # of one team: workers may drive other numbers of them
    noise = AdditiveGaussianModule(bounds, config.warmup_noise, config.warmup_noise, action_key=ACTION)
    keep_base = TensorDictModule(torch.clone, in_keys=[ACTION], out_keys=[BASE_ACTION])
    behaviour = BestOfN(policy, loss.value, config.best_of_n) if config.best_of_n > 1 else policy
    collector = make_collector(config, env, TensorDictSequential(behaviour, keep_base, noise), multi_step, run)
    experience = iter(collector)

    def batch(updates: int, share: float) -> TensorDictBase:
        """What a number of updates learn from: uniform samples of the buffer, a share of each batch demonstrations."""
        of_demos = round(config.batch_size * share)
        imitated = demos[torch.randint(len(demos), (updates, of_demos))]
        lived = buffer.sample(updates * (config.batch_size - of_demos)).select(*demos.keys(True, True))
        return torch.cat([lived.reshape(updates, -1), imitated], 1)

    def update_critics(updates: int, share: float) -> None:
        for data in loss.write_targets(batch(updates, share)):
            value, _ = loss.td_loss(data)
            run.step(value, critic_optimizer, config.grad_norm, "loss_q")
        target.step()

    def update_actor(data: TensorDictBase) -> None:
        for piece in data:
            value, _ = loss.diffusion_loss(piece)
            run.step(value, actor_optimizer, config.grad_norm, "loss_pi")

    def validate(phase: str, step: int) -> None:
        metrics = evaluate(policy, validation_env, seed=VALIDATION_SEED + config.seed)
        run.evaluation(metrics, phase=phase, updates=step * config.collect_steps * config.updates_per_step)
        better = score(metrics) > run.best
        run.best = max(run.best, score(metrics))
        for name in ["cloned" if phase == "clone" else "last", *(["policy"] if better else [])]:
            save_policy(folder / f"{name}.safetensors", policy, policy_config, scenario)

    run.track(loss=loss, actor_optimizer=actor_optimizer, critic_optimizer=critic_optimizer, buffer=buffer)
    if isinstance(collector, Collector):  # the state of Ray's workers stays with them
        run.track_state(
            "collection", partial(collection_state, env, collector), partial(set_collection_state, env, collector)
        )
    run.restore()

    # Clone the demonstrations, so that online training starts from a policy that reaches most goals
    for i in run.loop("clone", config.clone_updates):
        learning_rate(actor_optimizer, config.clone_lr * (1 - 0.9 * i / config.clone_updates))
        imitated = demos[torch.randint(len(demos), (1, config.clone_batch))]
        update_actor(imitated.set(REFINED_ACTION, imitated[ACTION]))
        if i + 1 == config.clone_updates:
            copy_to_targets(loss)
            validate("clone", 0)

    # Let the critics learn the value of the cloned policy before the actor follows them
    for _ in run.loop("warm-up", config.warmup_steps // config.collect_steps):
        buffer.extend(transitions(next(experience)))
    for _ in run.loop("critic", config.critic_updates // config.block):
        update_critics(config.block, config.demonstration_share)

    # Line 3: for each episode
    noise.sigma.fill_(config.exploration_noise)
    rounds = config.env_steps // config.collect_steps
    interval = max(1, config.evaluation_interval // config.collect_steps)
    for i in run.loop("online", rounds, checkpoint_every=interval):
        # Lines 4, 5 and 8: embed the team, sample actions, act, store the transitions
        started = time.perf_counter()
        buffer.extend(transitions(next(experience)))
        left = 1 - i / rounds
        learning_rate(actor_optimizer, config.actor_lr * (config.final_lr + (1 - config.final_lr) * left))
        learning_rate(critic_optimizer, config.critic_lr * (config.final_lr + (1 - config.final_lr) * left))
        share = config.demonstration_share * max(0.0, 1 - i * config.collect_steps / config.share_steps)
        share, actor_share = max(share, config.final_share), max(share / 2, config.final_share)
        for done in range(0, config.collect_steps * config.updates_per_step, config.block):
            # Lines 9, 10 and 13: batches, the critic loss (Eq. 2), a step of Q1 and Q2 for each
            update_critics(config.block, share)
            # Lines 11, 6, 7 and 12: refined actions, the diffusion loss on them (Eq. 1), a step of psi and phi for each
            if actor_updates := (done + config.block) // 2 - done // 2:
                update_actor(loss.write_refined(batch(actor_updates, actor_share)))
        if config.best_of_n > 1:
            run.figures["best_of_n"] = config.best_of_n
        run.figures["frames/s"] = config.num_envs * config.collect_steps / (time.perf_counter() - started)
        run.log(run.figures, i + 1, "train/")
        if (i + 1) % interval == 0 or i + 1 == rounds:
            validate("online", i + 1)

    # Line 15: return the policy
    return finish(run, config)


def make_collector(
    config: Config, env: EnvBase, policy: TensorDictSequential, multi_step: MultiStep, run: Run
) -> Collector | RayCollection:
    """What collects n-step transitions: this process, or workers on a Ray cluster."""
    if config.ray is not None:
        return RayCollection(
            partial(make_env, reward_scale=config.reward_scale, **config.scenario(), **config.randomisation()),
            policy,
            num_envs=config.num_envs,
            num_steps=config.collect_steps,
            num_workers=config.ray_workers,
            address=config.ray,
            seed=config.seed + sum(run.counters.values()),  # a run that goes on meets other starts
            postproc=multi_step,
        )
    return Collector(
        env,
        policy,
        frames_per_batch=config.num_envs * config.collect_steps,
        total_frames=-1,
        postproc=multi_step,
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=False,
    )


def transitions(data: TensorDictBase, demonstration: bool = False) -> TensorDictBase:
    """N-step transitions as a flat batch of teams, marked as demonstrations or not.

    A robot that has arrived is steered by the environment, so its actions are not the actor's to learn.
    """
    data = data.reshape(-1)
    data = data.select(OBSERVATION, ACTION, BASE_ACTION, ARRIVED, "next", "steps_to_next_obs", strict=False)
    data["agents", "active"] = data[ARRIVED] < 0.5
    if demonstration:
        data[BASE_ACTION] = data[ACTION].clone()
    data["demonstration"] = torch.full((len(data), 1), demonstration)
    return data.exclude(("agents", "info"))


def policy_architecture(config: Config, observation_dim: int) -> PolicyConfig:
    """The policy that a configuration describes."""
    return PolicyConfig(
        **config.ends_of_policy(observation_dim),
        hidden=(config.hidden,) * 3,
        activation=config.activation,
        diffusion_steps=config.diffusion_steps,
        schedule=config.schedule,
        sampling_steps=config.sampling_steps,
        noise_ratio=config.noise_ratio,
        sampler=config.sampler,
        eta=config.eta,
        kind=config.actor,
    )


def make_loss(config: Config, architecture: PolicyConfig, learner: TensorDictSequential) -> DIPOLoss:
    """Twin critics and the DIPO loss around the policy that learns."""
    value = ("agents", "state_action_value")
    critic = QNetwork(architecture.embedding_dim, 2, architecture.hidden, config.layer_norm, config.critic_activation)
    loss = DIPOLoss(
        learner[0],
        learner[1],
        TensorDictModule(critic, in_keys=[EMBEDDING, ACTION], out_keys=[value]),
        critic_encoder=None if config.shared_encoder else build_encoder(architecture),
        detach_encoder=config.detach_encoder,
        refine_steps=config.refine_steps,
        refine_step_size=config.refine_step_size,
        refine_max_norm=config.refine_max_norm,
        refine_from=config.refine_from,
    )
    names = ("reward", "done", "terminated", "refined_action", "actor_mask", "priority")
    keys = ("reward", "done", "terminated", "refined_action", "active", "td_error")
    loss.set_keys(
        action=ACTION,
        base_action=BASE_ACTION,
        state_action_value=value,
        **{name: ("agents", key) for name, key in zip(names, keys, strict=True)},
    )
    return loss.make_value_estimator(gamma=config.gamma)


def make_optimizers(config: Config, loss: DIPOLoss) -> tuple[torch.optim.Optimizer, torch.optim.Optimizer]:
    """Adam for encoder and actor, and for the critics with their encoder (the shared one, where there is one)."""
    critic_encoder = "encoder_network" if config.shared_encoder else "critic_encoder_network"

    def adam(rate: float, *networks: str) -> torch.optim.Optimizer:
        wanted = tuple(f"{network}_params" for network in networks)
        return torch.optim.Adam([p for name, p in loss.named_parameters() if name.startswith(wanted)], rate, fused=True)

    return (
        adam(config.actor_lr, "encoder_network", "actor_network"),
        adam(config.critic_lr, critic_encoder, "qvalue_network"),
    )


def learning_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of an optimizer."""
    for group in optimizer.param_groups:
        group["lr"] = rate


def averaged_policy(loss: DIPOLoss, architecture: PolicyConfig) -> TensorDictSequential:
    """The policy with the target networks' weights: the Polyak average of the learner, which swings less."""
    policy = build_policy(architecture)
    loss.target_encoder_network_params.to_module(policy[0])
    loss.target_actor_network_params.to_module(policy[1])
    return policy


def copy_to_targets(loss: DIPOLoss) -> None:
    """Make the target actor equal to the cloned one."""
    for name in ("encoder_network", "actor_network"):
        getattr(loss, f"target_{name}_params").data.update_(getattr(loss, f"{name}_params").data)


if __name__ == "__main__":
    train(tyro.cli(Config))
