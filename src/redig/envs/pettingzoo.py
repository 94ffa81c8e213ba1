"""Formation navigation for one team, as a PettingZoo parallel environment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torchrl.envs import TransformedEnv
from vmas.simulator.environment.environment import Environment

from redig.envs.factory import make_env
from redig.envs.seeding import preserve_rng_state

try:
    import gymnasium
    from gymnasium.spaces import Box
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise ImportError("redig.envs.pettingzoo needs PettingZoo: pip install 'redig[pettingzoo]'") from error

if TYPE_CHECKING:
    from redig.viz.canvas import TeamCanvas

RENDER_MODES = ("rgb_array",)
Observations = dict[str, NDArray]
Infos = dict[str, dict[str, NDArray]]


class FormationNavigationParallelEnv(ParallelEnv):
    """One team of :class:`~redig.envs.FormationNavigation` behind PettingZoo's parallel API.

    It steps the TorchRL environment of :func:`~redig.envs.make_env` with one team, so observations, rewards and flags
    are that environment's, number for number. The agents are called ``agents_0``, ``agents_1``, ...: TorchRL's
    ``PettingZooWrapper`` names their group after them, ``"agents"``, which is where our policies look.

    A team begins and ends together, because an arrived robot holds its place in the formation: all agents terminate
    once the whole team has held at its goals for ``hold_steps``, and all are truncated after ``max_steps``. Where the
    return of a single robot ends is in its ``infos`` (``terminated``), as are ``arrived`` and ``collision``; the keys,
    shapes and units are those of ``docs/keys.md``.

    Starts come from a random state of the environment's own: others, and torch's global one, are never touched.

    Args:
        render_mode: ``"rgb_array"``: ``render`` returns a picture; ``None``: it does not.
        env_kwargs: of :func:`~redig.envs.make_env` but for ``num_envs`` and ``device``: ``max_steps``, ``seed``,
            ``reward_scale`` and the arguments of the scenario. One team is simulated on the CPU.

    Raises:
        ImportError: if PettingZoo is not installed.
        ValueError: for an unknown render mode, and for bad arguments of the scenario.

    Examples:
        >>> env = FormationNavigationParallelEnv(formation="line", n_robots=3)
        >>> observations, infos = env.reset(seed=0)
        >>> observations["agents_2"].shape, infos["agents_2"]["arrived"]
        ((9,), array([0.], dtype=float32))
        >>> ahead = {agent: [1.0, 0.0] for agent in env.agents}  # velocity command (m/s)
        >>> observations, rewards, terminations, truncations, infos = env.step(ahead)
        >>> rewards["agents_0"] > 0, any(terminations.values()), any(truncations.values())
        (True, False, False)
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (PettingZoo's interface)
        "name": "formation_navigation_v0",
        "render_modes": list(RENDER_MODES),
        "is_parallelizable": True,
    }

    def __init__(self, *, render_mode: str | None = None, **env_kwargs: Any) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(f"render_mode: got {render_mode!r}, allowed are {', '.join(RENDER_MODES)} and None")
        self.render_mode = render_mode
        self._random_state = list(Environment.vmas_random_state)
        with self._own_random_state():
            self._env: TransformedEnv = make_env(1, device="cpu", **env_kwargs)
        _, n, width = self._env.observation_spec["agents", "observation"].shape
        bounds = self._env.full_action_spec["agents", "action"].space
        self.possible_agents = [f"agents_{i}" for i in range(n)]
        self.agents: list[str] = []
        self._track: list[NDArray] = []
        # a space for each agent: PettingZoo seeds them one by one
        self.observation_spaces = {agent: Box(-np.inf, np.inf, (width,), np.float32) for agent in self.possible_agents}
        self.action_spaces = {
            agent: Box(low.numpy(), high.numpy(), dtype=np.float32)
            for agent, low, high in zip(self.possible_agents, bounds.low[0], bounds.high[0], strict=True)
        }
        self.state_space = Box(-np.inf, np.inf, (n * width,), np.float32)
        self.metadata = {**self.metadata, "render_fps": round(1 / self._env.scenario.dt)}

    def observation_space(self, agent: str) -> Box:
        """State of one robot: the numbers of ``docs/keys.md``."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """Velocity command of one robot (m/s), each number within ±``max_speed``."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observations, Infos]:
        """Begin an episode from a fresh start.

        Args:
            seed: of this start and those that follow; without one, the environment's random state runs on.
            options: not used.

        Returns:
            observations and infos of all agents.
        """
        with self._own_random_state():
            if seed is not None:
                self._env.set_seed(seed)
            self._data = self._env.reset()
        self.agents = self.possible_agents.copy()
        self._track = [self._positions()]
        self._canvas: TeamCanvas | None = None
        return self._observations(), self._infos()

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Move the team by one time step.

        Args:
            actions: of every agent, two numbers each.

        Returns:
            observations, rewards, terminations, truncations and infos of all agents. After the last step of an episode
            ``agents`` is empty.

        Raises:
            RuntimeError: if no episode is under way.
            ValueError: if actions are not those of the agents, or one is not finite or outside its space.
        """
        if not self.agents:
            raise RuntimeError("step: no episode is under way; call reset first")
        self._data["agents", "action"] = self._team_action(actions)
        with self._own_random_state():
            self._data = self._env.step(self._data)["next"]
        self._track.append(self._positions())
        names = self.possible_agents
        rewards = dict(zip(names, self._data["agents", "reward"].flatten().tolist(), strict=True))
        terminated, truncated = (self._data[key].item() for key in ("terminated", "truncated"))
        if terminated or truncated:
            self.agents = []
        return (
            self._observations(),
            rewards,
            dict.fromkeys(names, terminated),
            dict.fromkeys(names, truncated),
            self._infos(),
        )

    def state(self) -> NDArray:
        """The observations of all robots, one after another."""
        self._require_reset("state")
        return self._data["agents", "observation"].flatten().numpy().copy()

    def render(self) -> NDArray | None:
        """Picture ``[H, W, 3]`` (uint8) of the team, its paths since the reset, the map and the goals."""
        if self.render_mode is None:
            gymnasium.logger.warn("render: the environment was made without a render_mode, there is no picture")
            return None
        self._require_reset("render")
        # drawing is a layer above; only who asks for pictures needs it
        from redig.viz.canvas import TeamCanvas
        from redig.viz.scene import view

        scenario, track = self._env.scenario, np.stack(self._track)
        if self._canvas is None:
            goal = scenario.goal[0].numpy()
            region = view(track[:1], goal)
            self._canvas = TeamCanvas(
                region, len(goal), scenario.formation, scenario.obstacle_map, goal, scenario.radius
            )
        return self._canvas.draw(track, time=(len(track) - 1) * scenario.dt)

    def close(self) -> None:
        """Let the simulator go; a second call does nothing."""
        self.agents = []
        if not self._env.is_closed:
            self._env.close()

    @contextmanager
    def _own_random_state(self) -> Iterator[None]:
        """Draw from this environment's random state, where VMAS has one for all."""
        with preserve_rng_state():
            Environment.vmas_random_state[:] = self._random_state
            yield
            self._random_state = list(Environment.vmas_random_state)

    def _require_reset(self, method: str) -> None:
        if not self._track:
            raise RuntimeError(f"{method}: no episode has begun; call reset first")

    def _team_action(self, actions: Mapping[str, ArrayLike]) -> torch.Tensor:
        if set(actions) != set(self.agents):
            raise ValueError(
                f"actions: got those of {', '.join(map(str, actions)) or 'nobody'}, must be one for each of "
                f"{', '.join(self.agents)}"
            )
        commands = []
        for agent in self.agents:
            command, space = np.asarray(actions[agent], dtype=np.float32), self.action_spaces[agent]
            if not space.contains(command):
                raise ValueError(
                    f"actions[{agent!r}]: got {command.tolist()}, must be {space.shape[0]} finite numbers from "
                    f"{space.low.min()} to {space.high.max()} (m/s)"
                )
            commands.append(command)
        return torch.from_numpy(np.stack(commands)).unsqueeze(0)

    def _positions(self) -> NDArray:
        return self._data["agents", "info", "position"][0].numpy().copy()

    # copies: what a caller does to its arrays must not reach the simulation

    def _observations(self) -> Observations:
        return dict(zip(self.possible_agents, self._data["agents", "observation"][0].numpy().copy(), strict=True))

    def _infos(self) -> Infos:
        info = {key: value[0].numpy().copy() for key, value in self._data["agents", "info"].items()}
        return {agent: {key: value[i] for key, value in info.items()} for i, agent in enumerate(self.possible_agents)}
