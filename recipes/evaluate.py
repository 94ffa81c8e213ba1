"""Evaluate a policy file: ``python recipes/evaluate.py recipes/policies/wedge.safetensors --starts 256``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType

from redig.checkpoint import load_checkpoint
from redig.envs.factory import make_env
from redig.envs.map_batch import map_at
from redig.envs.maps import ObstacleMap
from redig.envs.occupancy import OccupancyMap
from redig.envs.random_maps import MAP_KINDS
from redig.evaluation import evaluate, format_table, rollout_trajectories, write_metrics
from redig.modules import BestOfN, DiffusionActor
from redig.policy import build_policy, build_sampler, load_policy, read_header
from redig.viz import animate, plot_trajectories


@dataclass
class Arguments:
    """Drive teams from fresh starts with a trained policy, and measure what they do."""

    policy: Annotated[Path, tyro.conf.Positional]
    """The policy file."""
    starts: int = 256
    """Number of starts."""
    seed: int = 2_000_000
    """Seed of the starts; the recipe trains and validates on other ones."""
    out: Path = Path("evaluation")
    """Folder for metrics.json and the pictures."""
    formation: str | None = None
    """Another formation than the one that the policy was trained for."""
    n_robots: int | None = None
    """Another number of robots."""
    corridor_width: float | None = None
    """Another width of the corridor (m)."""
    map: str | None = None
    """Another map: a kind of redig.envs.MAP_KINDS, whose evaluation maps the teams get in turn, or a YAML file."""
    sampler: Literal["ddpm", "ddim", "dpmsolver"] | None = None
    """Another sampler than the one that the policy was trained with."""
    sampling_steps: int | None = None
    """Steps of that sampler."""
    eta: float | None = None
    """Noise of ddim, from 0 to 1; has an effect with --stochastic only."""
    noise_ratio: float | None = None
    """Noise of ddpm, from 0 to 1; has an effect with --stochastic only."""
    stochastic: bool = False
    """Sample actions: a random latent and the sampler's noise at each step, instead of a zero latent and none."""
    fixed_latent: bool = False
    """One random latent for each robot and episode, instead of a zero latent."""
    warm_start: int | None = None
    """Begin each chain at this diffusion step, with the action before."""
    best_of_n: int = 1
    """Take the best of N sampled actions by min Q; 1: off. It is stated in all that is written."""
    critics: Path | None = None
    """The run whose critics choose among the N."""
    animation: bool = True
    """Draw the first start as a figure and as an animation."""


def main(arguments: Arguments) -> dict[str, float]:
    """Evaluate, print the table, write ``metrics.json`` and the pictures."""
    if arguments.starts < 1:
        raise ValueError(f"starts: got {arguments.starts}, must be at least 1")
    _, scenario = read_header(arguments.policy)
    changes = {name: getattr(arguments, name) for name in ("formation", "n_robots", "corridor_width")}
    scenario |= {name: value for name, value in changes.items() if value is not None}
    scenario = on_evaluation_maps(scenario, arguments.map)
    env = make_env(arguments.starts, **scenario)
    policy = load(arguments, env.observation_spec["agents", "observation"].shape[-1])
    driver: TensorDictModuleBase = policy
    if arguments.best_of_n > 1:
        if arguments.critics is None:
            raise ValueError("critics: --best-of-n needs the run whose critics choose, --critics RUN")
        driver = BestOfN(policy, load_critics(arguments.critics), arguments.best_of_n)
        print(f"best of {arguments.best_of_n} actions by min Q, critics of {arguments.critics}: not the policy alone")
    kind = ExplorationType.RANDOM if arguments.stochastic else ExplorationType.DETERMINISTIC
    metrics = evaluate(driver, with_memory(env, policy), seed=arguments.seed, exploration_type=kind)
    if arguments.best_of_n > 1:
        metrics["best_of_n"] = arguments.best_of_n
    print(format_table(metrics))
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_metrics(arguments.out / "metrics.json", metrics)
    if arguments.animation:
        draw_crossing(arguments.out, driver, with_memory(make_env(1, **scenario), policy), arguments.seed)
    print(f"written to {arguments.out}")
    return metrics


def on_evaluation_maps(scenario: dict[str, Any], place: str | None = None) -> dict[str, Any]:
    """A scenario with the evaluation maps of the kind that it was trained on, or of another kind, or in another place.

    What has neither map nor place is as it was.
    """
    place = place or scenario.get("obstacle_map")
    if place is None:
        return scenario
    kind = place.removesuffix(":train")
    return {**scenario, "obstacle_map": f"{kind}:evaluation" if kind in MAP_KINDS else place}


def load(arguments: Arguments, observation_dim: int) -> TensorDictSequential:
    """The policy with the sampler and the options that the command line asks for."""
    config, _ = read_header(arguments.policy)
    given = {name: getattr(arguments, name) for name in ("sampler", "sampling_steps", "eta", "noise_ratio")}
    given = {name: value for name, value in given.items() if value is not None}
    sampler = None
    if config.kind == "diffusion":
        c = replace(config, **given)
        sampler = build_sampler(c.sampler, c.sampling_steps, c.noise_ratio, c.early_stop, c.eta)
    elif given:
        raise ValueError(f"{', '.join(given)}: {arguments.policy} holds a {config.kind} policy, which has no chain")
    return load_policy(
        arguments.policy,
        observation_dim,
        sampler=sampler,
        fixed_latent=arguments.fixed_latent,
        warm_start=arguments.warm_start,
    )


def with_memory(env: TransformedEnv, policy: TensorDictSequential) -> TransformedEnv:
    """The environment, with what a policy with a fixed latent or a warm start keeps from step to step."""
    if not isinstance(policy[-1], DiffusionActor):
        return env
    shape = env.full_action_spec_unbatched["agents", "action"].shape
    return env.append_transform(policy[-1].make_tensordict_primer(shape))


def load_critics(folder: Path) -> Callable[[TensorDictBase], Tensor]:
    """Values of actions by the critics of a run, from its configuration and checkpoint."""
    from redig_wedge import Config, make_loss, policy_architecture  # it imports this file for its final figures

    checkpoint = folder / "checkpoint.pt"
    if not checkpoint.is_file():
        raise FileNotFoundError(f"critics: {folder} holds no run with a checkpoint ({checkpoint})")
    config = Config(resume=folder).resolve()
    width = make_env(1, **config.scenario()).observation_spec["agents", "observation"].shape[-1]
    architecture = policy_architecture(config, width)
    loss = make_loss(config, architecture, build_policy(architecture))
    loss.load_state_dict(load_checkpoint(checkpoint)["loss"])
    return loss.value


def draw_crossing(
    folder: Path, policy: TensorDictModuleBase, env: TransformedEnv, seed: int, name: str = "trajectories.gif"
) -> None:
    """One crossing of the only team in ``env`` as an animation of this name, and as a figure beside it."""
    rollout = rollout_trajectories(policy, env, seed)
    position = rollout["position"][0, rollout["mask"][0]]
    world = env.base_env.scenario
    draw_team(folder / name, position, world.formation, map_at(world.obstacle_map, 0), world.goal[0])


def draw_team(
    film: Path, position: Tensor, formation: str, obstacle_map: ObstacleMap | OccupancyMap, goal: Tensor
) -> None:
    """The way of a team ``[T, n, 2]`` (m) as an animation, and as a figure beside it."""
    plot_trajectories(film.with_suffix(".png"), position, formation, obstacle_map, goal)
    animate(film, position, formation, obstacle_map, goal)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
