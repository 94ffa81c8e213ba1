"""A team in MuJoCo that others drive: states go out to the robots' computers, and velocity commands come in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from redig.deploy.messages import RobotState
from redig.deploy.transport import BodyVelocity, Sensed
from redig.envs.direction import observed_obstacle
from redig.envs.maps import ObstacleMap
from redig.physics.world import PhysicsWorld


class _Network(Protocol):
    """The robots' network, seen from the world; over ROS 2 a :class:`redig.deploy.dds.DDSWorld`."""

    def publish(self, sensed: Sensed) -> None:
        """Say to a robot what it senses."""

    def commands(self) -> dict[str, BodyVelocity]:
        """The newest command of each robot that has sent one since the last call."""


class LiveTeam:
    """Carries out the newest commands of robots, and tells them where they are; it decides nothing itself.

    Robots have wheels: of a command, ``left`` is not carried out. A robot that has sent no command for ``watchdog``
    seconds is stopped, as is one whose command is not finite.

    Args:
        world: the robots' bodies.
        obstacle_map: of the world, which the distance to the nearest obstacle refers to.
        robots: their names.
        network: to reach them by.
        limits: largest forward (m/s) and turning (rad/s) speed that the bodies accept.
        watchdog: (s), of the physics.
        direction_smoothing: that the robots' policy was trained with (m).

    Raises:
        ValueError: if there is not a name for each robot.

    Examples:
        >>> from redig.envs import corridor
        >>> class Straight:  # a network of robots that always drive ahead
        ...     def publish(self, sensed):
        ...         self.heard = sensed
        ...     def commands(self):
        ...         return {"robot_0": BodyVelocity(0.5, 0.0, 0.0)}
        >>> walls, network = corridor(), Straight()
        >>> team = LiveTeam(PhysicsWorld(walls, 1), walls, ["robot_0"], network)
        >>> team.reset([[-3.0, 0.0]], heading=[0.0], goal=[[3.0, 0.0]], now=0.0)
        >>> for k in range(50):
        ...     team.step(0.02, now=0.02 * (k + 1))
        >>> 0.4 < network.heard.state.position[0] + 3.0 < 0.5  # a second, with the time to get going
        True
    """

    def __init__(
        self,
        world: PhysicsWorld,
        obstacle_map: ObstacleMap,
        robots: Sequence[str],
        network: _Network,
        limits: tuple[float, float] = (1.2, 6.0),
        watchdog: float = 0.5,
        direction_smoothing: float = 0.0,
    ) -> None:
        if len(robots) != world.n_robots:
            raise ValueError(f"robots: got {len(robots)} names for {world.n_robots} robots")
        self.world, self.robots, self.watchdog = world, list(robots), watchdog
        self._map, self._network, self._limits = obstacle_map, network, np.array(limits)
        self._smoothing = direction_smoothing

    def reset(self, position: ArrayLike, heading: ArrayLike, goal: ArrayLike, now: float) -> None:
        """Put the robots at a start, at rest; commands that are under way are dropped.

        Args:
            position: ``[n, 2]`` (m).
            heading: ``[n]`` (rad).
            goal: ``[n, 2]`` (m), which the robots are told.
            now: time that states are stamped with (s).
        """
        self.world.reset(position, heading)
        self._goal = np.asarray(goal, float)
        self._command = np.zeros((self.world.n_robots, 2))
        self._heard = np.full(self.world.n_robots, -np.inf)
        self._network.commands()
        self.tell(now)

    def step(self, duration: float, now: float) -> None:
        """Listen, drive for ``duration`` (s), and tell the robots where that has taken them."""
        for robot, command in self._network.commands().items():
            i = self.robots.index(robot)
            wanted = np.array([command.forward, command.turn])
            self._command[i] = np.clip(wanted, -self._limits, self._limits) if np.isfinite(wanted).all() else 0.0
            self._heard[i] = self.world.time
        silent = self.world.time - self._heard > self.watchdog
        self.world.step(np.where(silent[:, None], 0.0, self._command), duration)
        self.tell(now)

    def tell(self, now: float) -> None:
        """Say to each robot what it senses, stamped ``now`` (s)."""
        for sensed in self.sensed(now):
            self._network.publish(sensed)

    def sensed(self, now: float) -> list[Sensed]:
        """What each robot senses, stamped ``now`` (s)."""
        position, velocity, heading = self.world.position, self.world.velocity, self.world.heading
        centres = torch.as_tensor(position, dtype=torch.float32)
        distance, direction = observed_obstacle(self._map, centres, self._smoothing)
        team = []
        for i, robot in enumerate(self.robots):
            place, speed, goal, wall = (_pair(x[i]) for x in (position, velocity, self._goal, direction.numpy()))
            state = RobotState(robot, now, place, speed, goal, float(distance[i]), wall)
            team.append(Sensed(state, float(heading[i])))
        return team

    @property
    def commands(self) -> list[BodyVelocity]:
        """The commands that the robots carry out, unless they have been silent."""
        return [BodyVelocity(forward, 0.0, turn) for forward, turn in self._command.tolist()]


def _pair(values: NDArray) -> tuple[float, float]:
    x, y = values.tolist()
    return x, y
