"""The paper's figures for policy files, and baselines that plan, that cross the same map.

``python recipes/figures.py --policy "ReDiG=recipes/policies/wedge.safetensors" --policy "L&F=leader_follower"``
draws trajectories side by side (Figs. 2 and 4) and the jerk (Fig. 7) of all, the importance of messages (Fig. 6) for
policies that were trained, and the denoising (Fig. 3) for diffusion policies.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import torch
import tyro
from classic import METHODS
from evaluate import on_evaluation_maps
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.envs import FormationNavigation
from redig.envs.factory import make_env
from redig.envs.map_batch import MapBatch, map_at
from redig.envs.occupancy import OccupancyMap
from redig.evaluation import denoising_path, jerk, message_importance, rollout_trajectories
from redig.modules import DDIM
from redig.policy import ACTION, EMBEDDING, KINDS, OBSERVATION, load_policy, read_header
from redig.viz import animate_denoising, plot_comparison, plot_denoising, plot_importance, plot_jerk
from redig.viz.panels import ONE_COLUMN, TWO_COLUMNS

SUFFIXES = (".pdf", ".png")
WIDTHS = {"one": ONE_COLUMN, "two": TWO_COLUMNS}
MOMENTS = {"before (20 % of the way)": 0.2, "inside (50 %)": 0.5, "behind (80 %)": 0.8}
ENTRANCE = 0.35  # share of the way at which the denoising is shown: a wedge enters the default corridor
FRAMES, FILM_CHAINS = 21, 64  # of a film, at most


@dataclass
class Arguments:
    """Draw the paper's figures for policies that cross the same map."""

    policy: tyro.conf.UseAppendAction[tuple[str, ...]]
    """NAME=FILE or NAME=METHOD, a method of classic.py, which drives in the scenario of the first file; once for each
    policy, in the order of the panels. Denoising and messages are looked at in the situations that the first one comes
    to, so name the one that crosses best first."""
    out: Path = Path("figures")
    """Folder for the figures."""
    starts: int = 64
    """Starts that every policy drives; the importance of messages is a mean over them."""
    start: int = 0
    """Which of the starts is drawn, on its own map if there are several."""
    seed: int = 2_000_000
    """Seed of the starts and of the latents."""
    latents: int = 128
    """Chains in the figures of the denoising."""
    columns: Literal["one", "two"] = "two"
    """Width of trajectories and jerk: one or two columns of a page (3.4 or 7 inches); the others take two."""


@dataclass
class Crossing:
    """What one policy did from all starts."""

    kind: str  # of PolicyConfig, or a method of classic.py
    policy: TensorDictModuleBase
    scenario: FormationNavigation
    rollout: TensorDictBase

    def team(self, start: int) -> TensorDictBase:
        """One team until it is done, ``[T]``."""
        return self.rollout[start][self.rollout["mask"][start]]

    @property
    def network(self) -> TensorDictSequential:
        """Encoder and actor; for policies that were trained."""
        return cast(TensorDictSequential, self.policy)

    def observe(self, state: dict[str, Tensor], position: Tensor) -> Tensor:
        """Observations ``[E, n, F]`` of the teams of ``state``, moved to ``position``; differentiable."""
        self.scenario.load_state_dict({**state, "position": position})
        return self.scenario.quantities["observation"]

    def act(self, observation: Tensor) -> Tensor:
        """Commands ``[E, n, 2]`` (m/s) without randomness."""
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return self.policy(TensorDict({OBSERVATION: observation}, observation.shape[:1]))[ACTION]


def main(arguments: Arguments) -> None:
    """Drive every policy and draw all figures."""
    crossings = drive(arguments)
    print(f"drove {arguments.starts} starts with {', '.join(crossings)}")
    draw_trajectories(arguments, crossings)
    draw_jerk(arguments, crossings)
    draw_importance(arguments, crossings)
    draw_denoising(arguments, crossings)
    print(f"written to {arguments.out}")


def drive(arguments: Arguments) -> dict[str, Crossing]:
    """Every policy in the scenario that it was trained in, on evaluation maps, from the same starts."""
    if not 0 <= arguments.start < arguments.starts:
        raise ValueError(f"start: got {arguments.start}, must be from 0 to starts - 1 = {arguments.starts - 1}")
    sources: dict[str, str] = {}
    for entry in arguments.policy:
        name, equals, source = entry.partition("=")
        if not (name and equals and source) or name in sources:
            raise ValueError(f"policy: got {entry!r}, expected NAME=FILE or NAME=METHOD with a name of its own")
        sources[name] = source
    headers = {name: read_header(source) for name, source in sources.items() if source not in METHODS}
    shared = next((scenario for _, scenario in headers.values()), {})
    crossings: dict[str, Crossing] = {}
    for name, source in sources.items():
        scenario = headers[name][1] if name in headers else shared
        env = make_env(arguments.starts, **on_evaluation_maps(scenario))
        policy: TensorDictModuleBase
        if name in headers:
            kind, policy = headers[name][0].kind, load_policy(source, env.observation_spec[OBSERVATION].shape[-1])
        else:
            kind, policy = source, METHODS[source](env.scenario)
        rollout = rollout_trajectories(policy, env, arguments.seed)
        crossings[name] = Crossing(kind, policy, env.scenario, rollout)
        if task(crossings[name]) != task(next(iter(crossings.values()))):
            raise ValueError(f"policy: {name!r} was trained in another scenario than {next(iter(crossings))!r}")
    return crossings


def task(crossing: Crossing) -> tuple[object, ...]:
    """What policies must have in common to be compared: formation, map, starts and goals."""
    world = crossing.scenario
    here = world.obstacle_map
    grid = (here.resolution, here.origin) if isinstance(here, OccupancyMap) else ()
    walls = here.occupied if isinstance(here, OccupancyMap) else here.obstacles
    places = (walls, crossing.rollout["position"][:, 0], world.goal)
    return world.formation, grid, *(place.tolist() for place in places)


def only(crossings: dict[str, Crossing], kinds: Sequence[str], figure: str) -> dict[str, Crossing]:
    """The policies of some kinds; for each of the others a line that says that it is left out."""
    for name, crossing in crossings.items():
        if crossing.kind not in kinds:
            print(f"{figure}: left out {name} ({crossing.kind}), as it is of {', '.join(kinds)} policies only")
    return {name: crossing for name, crossing in crossings.items() if crossing.kind in kinds}


def draw_trajectories(arguments: Arguments, crossings: dict[str, Crossing]) -> None:
    """One start by every policy, Figs. 2 and 4."""
    teams = {name: crossing.team(arguments.start) for name, crossing in crossings.items()}
    world = next(iter(crossings.values())).scenario
    for path in files(arguments, "trajectories"):
        plot_comparison(
            path,
            {name: team["position"] for name, team in teams.items()},
            {name: team["collision"] for name, team in teams.items()},
            world.formation,
            map_at(world.obstacle_map, arguments.start),
            world.goal[arguments.start],
            world.radius,
            world.dt,
            WIDTHS[arguments.columns],
        )


def draw_jerk(arguments: Arguments, crossings: dict[str, Crossing]) -> None:
    """Jerk of the same teams, each robot until its arrival, Fig. 7."""
    profiles = {}
    for name, crossing in crossings.items():
        team, dt = crossing.team(arguments.start), crossing.scenario.dt
        # the environment steers a robot that has arrived, so what follows is not the policy's
        profiles[name] = jerk(team["position"], dt).masked_fill(team["arrived"][2:-1], torch.nan)
    for path in files(arguments, "jerk"):
        plot_jerk(path, profiles, dt, WIDTHS[arguments.columns])


def draw_importance(arguments: Arguments, crossings: dict[str, Crossing]) -> None:
    """Importance of messages in the first policy's situations, mean over the starts, Fig. 6.

    Drawn at the mean places, or, where every start has a map of its own, at those of the start that is drawn.
    """
    asked = only(crossings, KINDS, "importance")
    if not asked:
        return
    first = next(iter(crossings.values()))
    world = first.scenario
    situations = [situation(first, share) for share in MOMENTS.values()]
    for (_, reached), moment in zip(situations, MOMENTS, strict=True):
        print(f"importance, {moment}: {int(reached.sum())} of {len(reached)} teams come there")
        if not reached.any():
            raise ValueError(f"policy: no team of {next(iter(crossings))!r} gets there; name one that crosses first")
    if isinstance(world.obstacle_map, MapBatch):
        position = torch.stack([place_of_start(arguments, crossings, *found) for found in situations])
    else:
        position = torch.stack([state["position"][reached].mean(0) for state, reached in situations])
    means: dict[str, Tensor] = {}
    for name, crossing in asked.items():
        means[name] = torch.stack([ask(crossing, state)[reached].mean(0) for state, reached in situations])
        # beside it, the paper's own measure
        norms = torch.stack([message_norms(crossing, state)[reached].mean(0) for state, reached in situations])
        print(f"{name}: mean importance {others(means[name]):.3f} 1/s, mean norm of a message {others(norms):.2f}")
    here = map_at(world.obstacle_map, arguments.start)
    for path in files(arguments, "importance"):
        plot_importance(path, means, position, list(MOMENTS), here, world.radius)


def draw_denoising(arguments: Arguments, crossings: dict[str, Crossing]) -> None:
    """Every step of the chain of every diffusion policy, in the first one's situation, Fig. 3 as figures and films."""
    denoised = only(crossings, ("diffusion",), "denoising")
    if not denoised:
        return
    state, reached = situation(next(iter(crossings.values())), ENTRANCE)
    place = place_of_start(arguments, crossings, state, reached)
    for name, crossing in denoised.items():
        encoder, actor = crossing.network[0], crossing.network[-1]
        observation = crossing.observe(state, state["position"])[arguments.start]
        with torch.no_grad():
            embedding = encoder(TensorDict({OBSERVATION: observation}, []))[EMBEDDING]
        torch.manual_seed(arguments.seed)
        latent = torch.randn(arguments.latents, *place.shape)
        # all steps of the flow whose states are distributed as the noised actions are, and noise at its start only
        steps, velocity = denoising_path(actor, embedding.expand(len(latent), *embedding.shape), latent, DDIM())
        label = "denoising-" + re.sub(r"[^\w.]+", "-", name)
        world = crossing.scenario
        for path in files(arguments, label):
            plot_denoising(path, steps, velocity, world.max_speed)
        shown = torch.linspace(0, len(steps) - 1, min(FRAMES, len(steps))).round().int().tolist()
        film = arguments.out / f"{label}.gif"
        moving = velocity[shown, :FILM_CHAINS]
        here = map_at(world.obstacle_map, arguments.start)
        animate_denoising(film, [steps[k] for k in shown], moving, place, here, world.radius)


def situation(crossing: Crossing, share: float) -> tuple[dict[str, Tensor], Tensor]:
    """State of the scenario when each team's centroid has covered a share of its way; which teams ``[E]`` get there."""
    position, velocity = crossing.rollout["position"], crossing.rollout["velocity"]
    centroid = position.mean(-2)  # [E, T, 2]
    way = crossing.scenario.goal.mean(-2) - centroid[:, 0]
    covered = ((centroid - centroid[:, :1]) * way[:, None]).sum(-1) / way.square().sum(-1, keepdim=True)
    there = covered >= share
    team, sample = torch.arange(len(position)), there.int().argmax(-1)  # of equal values, argmax gives the first
    state = {
        **crossing.scenario.state_dict(),
        "position": position[team, sample],
        "velocity": velocity[team, sample],
        "arrived": crossing.rollout["arrived"][team, sample],
    }
    return state, there.any(-1)


def place_of_start(
    arguments: Arguments, crossings: dict[str, Crossing], state: dict[str, Tensor], reached: Tensor
) -> Tensor:
    """Robots' places ``[n, 2]`` (m) of the start that is drawn."""
    if not reached[arguments.start]:
        raise ValueError(f"start: got {arguments.start}, from which {next(iter(crossings))!r} does not come far enough")
    return state["position"][arguments.start]


def ask(crossing: Crossing, state: dict[str, Tensor]) -> Tensor:
    """Importance of every message ``[E, n, n]`` (1/s)."""
    return message_importance(lambda p: crossing.act(crossing.observe(state, p)), state["position"])


def message_norms(crossing: Crossing, state: dict[str, Tensor]) -> Tensor:
    """Norm of every message ``[E, n, n]``."""
    with torch.no_grad():
        return crossing.network[0].module.message_norms(crossing.observe(state, state["position"]))


def others(value: Tensor) -> float:
    """Mean over all pairs of different robots, ``[*B, n, n]``."""
    n = value.shape[-1]
    return value[..., ~torch.eye(n, dtype=torch.bool)].mean().item()


def files(arguments: Arguments, name: str) -> Sequence[Path]:
    """The files of one figure."""
    return [arguments.out / f"{name}{suffix}" for suffix in SUFFIXES]


if __name__ == "__main__":
    main(tyro.cli(Arguments))
