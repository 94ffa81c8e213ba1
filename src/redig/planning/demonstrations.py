"""Demonstrations in the real environment: uncoordinated, each robot by its own plan, or all by one for the team."""

from __future__ import annotations

import hashlib
import math
import os
import warnings
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, pad
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from tqdm import tqdm

from redig.envs.seeding import preserve_rng_state
from redig.files import replacing
from redig.planning.plans import plan_alone, plan_together

PLANNERS = ("astar", "rrt", "virtual_structure")
VERSION = 4  # part of the cache's hash: raise it whenever this package would make different demonstrations
KEYS = (
    ("agents", "observation"),
    ("agents", "action"),
    ("agents", "info", "arrived"),
    ("next", "agents", "observation"),
    ("next", "agents", "reward"),
    ("next", "agents", "info", "collision"),
    ("next", "agents", "info", "arrived"),
    ("next", "agents", "info", "terminated"),
    ("next", "done"),
    ("next", "terminated"),
    ("next", "truncated"),
)


def demonstrations(
    env: EnvBase,
    num_trajectories: int = 5000,
    planner: str = "astar",
    speed: tuple[float, float] = (0.9, 1.0),
    noise: float = 0.05,
    max_steps: int = 200,
    seed: int = 0,
    cache_dir: str | os.PathLike | None = None,
) -> TensorDict:
    """Trajectories of robots that each track their own plan, as transitions of ``env``.

    With ``planner="virtual_structure"`` the team's plan is one, see
    :class:`~redig.planning.virtual_structure.StructurePlanner`, and ``speed`` is that of its fastest robot.

    A trajectory is one robot's, so ``ceil(num_trajectories / n_robots)`` team episodes are run, ``env.batch_size[0]``
    at a time. The same arguments give the same demonstrations; the random states of the caller are left untouched, and
    the environment must be reset before it is used again.

    Args:
        env: ``VmasEnv(FormationNavigation(), ...)``, with or without transforms that leave the observation as it is.
        num_trajectories: number of trajectories of single robots.
        planner: ``"astar"`` or ``"rrt"``, or ``"virtual_structure"`` for teams that are coordinated.
        speed: lowest and highest speed of a robot (m/s); each robot (or coordinated team) draws its own for an episode.
        noise: standard deviation of the Gaussian noise added to the commands (m/s).
        max_steps: limit on the steps of an episode.
        seed: of starts, goals, speeds, noise and RRT.
        cache_dir: folder for a file named after the hash of everything that made it; ``None`` keeps nothing.

    Returns:
        TensorDict ``[episodes, T]`` with the environment's keys for observation, action, arrived, next observation,
        next reward, next ``collision``, ``arrived`` and ``terminated``, next ``done``, ``terminated`` and ``truncated``
        (where the environment has them), and ``mask``: True up to and including the step in which a team is done; what
        follows is padding.

    Raises:
        ValueError: for an unknown planner, an argument out of range, or a goal that no plan reaches.
        RuntimeError: if RRT finds no path.

    Examples:
        >>> from torchrl.envs import VmasEnv
        >>> from redig.envs import FormationNavigation
        >>> env = VmasEnv(FormationNavigation(), num_envs=2, n_robots=3)
        >>> data = demonstrations(env, num_trajectories=6, max_steps=10)
        >>> data.batch_size, data["agents", "action"].shape
        (torch.Size([2, 10]), torch.Size([2, 10, 3, 2]))
    """
    scenario = _base_env(env).scenario
    if planner not in PLANNERS:
        raise ValueError(f"planner: got {planner!r}, allowed are {', '.join(PLANNERS)}")
    for name, value in (("num_trajectories", num_trajectories), ("max_steps", max_steps)):
        if value < 1:
            raise ValueError(f"{name}: got {value}, must be at least 1")
    if not 0 < speed[0] <= speed[1] <= scenario.max_speed:
        raise ValueError(f"speed: got {speed}, must satisfy 0 < low <= high <= max_speed = {scenario.max_speed} m/s")
    if not noise >= 0:
        raise ValueError(f"noise: got {noise}, must not be negative")

    settings: dict[str, Any] = {
        "num_trajectories": num_trajectories,
        "planner": planner,
        "speed": tuple(speed),
        "noise": noise,
        "max_steps": max_steps,
        "seed": seed,
    }
    cache = None if cache_dir is None else Path(cache_dir) / f"demonstrations-{_fingerprint(env, settings)}.pt"
    if cache is not None and cache.exists():
        data = _load(cache)
        if data is not None:
            return data.to(env.device)
    with preserve_rng_state():
        data = _make(env, **settings)
    if cache is not None:
        _save(data, cache)
    return data


def _make(
    env: EnvBase,
    num_trajectories: int,
    planner: str,
    speed: tuple[float, float],
    noise: float,
    max_steps: int,
    seed: int,
) -> TensorDict:
    scenario = _base_env(env).scenario
    generator = torch.Generator(env.device).manual_seed(seed)
    env.set_seed(seed)
    num_envs, n = env.batch_size[0], scenario.n_robots
    episodes = math.ceil(num_trajectories / n)
    batches = []
    with tqdm(total=episodes, desc=f"demonstrations ({planner})", unit="team", disable=None) as progress:
        for done in range(0, episodes, num_envs):
            tensordict = env.reset()
            observation = tensordict["agents", "observation"]
            start = observation[..., :2]
            goal = start + observation[..., 4:6]
            report = partial(_report, progress, episodes - done)
            if planner == "virtual_structure":
                command = plan_together(scenario, start, goal, speed, generator, report)
            else:
                command = plan_alone(scenario, start, goal, planner, speed, generator, seed + done * n, report)
            batches.append(_rollout(env, tensordict, command, noise, max_steps, generator))
    longest = max(batch.shape[1] for batch in batches)
    return torch.cat([pad(batch, [0, 0, 0, longest - batch.shape[1]]) for batch in batches])[:episodes].contiguous()


def _report(progress: tqdm, wanted: int, team: int) -> None:
    progress.update(int(team < wanted))


def _rollout(
    env: EnvBase,
    tensordict: TensorDictBase,
    tracker: Callable[[Tensor], Tensor],
    noise: float,
    max_steps: int,
    generator: torch.Generator,
) -> TensorDict:
    """One episode in each environment, until all teams are done: the kept keys and the mask ``[num_envs, T]``."""
    limit = _base_env(env).scenario.max_speed

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        command = tracker(tensordict["agents", "observation"][..., :2])
        disturbance = noise * torch.randn(command.shape, device=command.device, generator=generator)
        return tensordict.set(("agents", "action"), (command + disturbance).clamp(-limit, limit))

    data = env.rollout(
        max_steps, policy, tensordict=tensordict, auto_reset=False, break_when_any_done=False, break_when_all_done=True
    )
    done = data["next", "done"].squeeze(-1).int()
    kept = data.select(*KEYS, strict=False)
    kept.names = None
    return kept.set("mask", done.cumsum(-1) == done)


def _base_env(env: EnvBase) -> EnvBase:
    """The environment without its transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def _fingerprint(env: EnvBase, settings: dict[str, Any]) -> str:
    """Hash over everything that decides what the demonstrations are."""
    scenario = _base_env(env).scenario
    transforms = env.transform.modules() if isinstance(env, TransformedEnv) else []
    parts = (
        VERSION,
        sorted(settings.items()),
        tuple(env.batch_size),
        type(scenario).__qualname__,
        sorted(_plain_attributes(scenario).items()),
        scenario.offsets.tolist(),
        _plain_map(scenario.obstacle_map),
        [(type(t).__name__, sorted(_plain_attributes(t).items())) for t in transforms],
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def _plain_map(value: Any) -> Any:
    """Everything that a map consists of, its kind included, as numbers, lists and tuples."""
    if isinstance(value, Tensor):
        return value.tolist()
    if isinstance(value, tuple):
        return tuple(map(_plain_map, value))
    if is_dataclass(value):
        return type(value).__qualname__, *(_plain_map(getattr(value, field.name)) for field in fields(value))
    return value


def _plain_attributes(thing: object) -> dict:
    """Attributes that are plain values; a list of them, as JSON has tuples, counts as the tuple."""
    plain = (bool, int, float, str)
    listed = {k: tuple(v) if _is_list_of(v, plain) else v for k, v in vars(thing).items()}
    return {k: v for k, v in listed.items() if isinstance(v, (*plain, tuple)) and k != "training"}


def _is_list_of(value: object, kinds: tuple[type, ...]) -> bool:
    return isinstance(value, list) and all(isinstance(each, kinds) for each in value)


def _save(data: TensorDict, path: Path) -> None:
    flat: dict[str, Tensor] = data.cpu().flatten_keys("/").to_dict()
    with replacing(path) as file:
        torch.save(flat, file)


def _load(path: Path) -> TensorDict | None:
    """The demonstrations in a file, or None and a warning if it cannot be read."""
    try:
        flat = torch.load(path, weights_only=True, map_location="cpu")
        data = TensorDict(flat, batch_size=flat["mask"].shape).unflatten_keys("/")
        for group in ("agents", ("next", "agents"), ("next", "agents", "info")):
            data.get(group).batch_size = flat["agents/action"].shape[:-1]  # a flat file does not keep it
        return data
    except Exception as error:  # whatever is wrong with the file, the remedy is the same
        warnings.warn(f"{path.name} cannot be read ({error}); the demonstrations are made again", stacklevel=3)
        return None
