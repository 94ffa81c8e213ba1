"""The task of :class:`~redig.envs.FormationNavigation` with MuJoCo in place of VMAS's physics."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from vmas.simulator.core import World

from redig.deploy.drive import Base, DifferentialDrive
from redig.envs import rewards
from redig.envs.dynamics import limit_norm
from redig.envs.map_batch import map_at
from redig.envs.maps import ObstacleMap
from redig.envs.navigation import FormationNavigation
from redig.envs.occupancy import OccupancyMap
from redig.physics.model import RobotBody
from redig.physics.world import PhysicsWorld


class PhysicsNavigation(FormationNavigation):
    """Formation navigation by differential-drive robots in MuJoCo.

    Starts, goals, observations, rewards, holding and ends are those of :class:`~redig.envs.FormationNavigation`, so
    policies and :func:`~redig.evaluation.evaluate` take it as it is. What differs is how a command becomes motion: a
    :class:`~redig.deploy.drive.DifferentialDrive` turns it into wheel speeds 50 times a second, motors, grip and
    contacts do the rest, and collisions are the contacts that MuJoCo reports at any time within a step. Robots start
    at rest, facing their goals. It simulates one team after the other, hundreds of times slower than VMAS.

    Further keyword arguments:

    * ``body`` (:class:`~redig.physics.RobotBody`), of the scenario's ``radius``; ``ground``
      (:class:`~redig.physics.Ground`).
    * ``base`` (:class:`~redig.deploy.drive.Base`): limits of the drive; default: see :func:`base_of`. ``gain`` (1/s):
      how fast it turns. ``pace``: of the drive. ``drive_interval`` (s): between two of its commands.

    ``acceleration_range`` and ``turn_gain`` of the scenario mean nothing here: motors, grip and drive decide that.

    Raises:
        ValueError: as the scenario that it extends; and for a body of another radius, or a ``drive_interval`` that
            does not divide ``dt``.

    Examples:
        >>> from redig.envs import make_env
        >>> from redig.physics import Ground
        >>> env = make_env(1, scenario=PhysicsNavigation(), n_robots=3, ground=Ground(friction=0.3))
        >>> env.rollout(2)["next", "agents", "observation"].shape
        torch.Size([1, 2, 3, 9])
    """

    def make_world(self, batch_dim: int, device: torch.device, **kwargs) -> World:
        """Build the team and its map in both simulators (called by VMAS)."""
        body, ground = kwargs.pop("body", None), kwargs.pop("ground", None)
        base, gain, pace = kwargs.pop("base", None), kwargs.pop("gain", 8.0), kwargs.pop("pace", 1.0)
        self.drive_interval = kwargs.pop("drive_interval", 0.02)
        world = super().make_world(batch_dim, device, **kwargs)
        self.drive_calls = round(self.dt / self.drive_interval)
        if self.drive_calls < 1 or abs(self.drive_calls * self.drive_interval - self.dt) > 1e-9:
            raise ValueError(f"drive_interval: got {self.drive_interval} s, must divide dt, {self.dt} s")
        body = body or RobotBody(radius=self.radius)
        if body.radius != self.radius:
            raise ValueError(f"body: got a radius of {body.radius} m, that of the scenario is {self.radius} m")
        base = base or base_of(body, self.max_speed, self.max_acceleration)
        maps = [map_at(self.obstacle_map, i) for i in range(batch_dim)]
        self.teams = [PhysicsWorld(boxes(each), self.n_robots, body, ground) for each in maps]
        self.drives = [
            [DifferentialDrive(base, gain=gain, pace=pace) for _ in range(self.n_robots)] for _ in range(batch_dim)
        ]
        return world

    def reset_world_at(self, env_index: int | None = None) -> None:
        """Draw new starts and goals; robots face their goals."""
        super().reset_world_at(env_index)
        position = self._positions()
        ahead = self.goal - position
        heading = torch.atan2(ahead[..., 1], ahead[..., 0])
        for i in range(len(self.teams)) if env_index is None else [env_index]:
            self.teams[i].reset(position[i].cpu().numpy(), heading[i].cpu().numpy())
            for drive in self.drives[i]:
                drive.stop()

    def state_dict(self) -> dict[str, Tensor]:
        """Not there: what MuJoCo and the drives keep from step to step is in no checkpoint.

        Raises:
            NotImplementedError: always; train in :class:`~redig.envs.FormationNavigation`.
        """
        raise NotImplementedError("PhysicsNavigation cannot be put into a checkpoint; train in FormationNavigation")

    def _settle(self) -> tuple[Tensor, Tensor, Tensor]:
        """Let MuJoCo carry out the commands from where it was; what VMAS made of them is replaced."""
        action = torch.stack([agent.action.u for agent in self.world.agents], 1)
        command = limit_norm(action, self.max_speed).double().cpu().numpy()
        touched = np.stack([self._drive(*each) for each in zip(self.teams, self.drives, command, strict=True)])
        position = self.goal.new_tensor(np.stack([team.position for team in self.teams]))
        velocity = self.goal.new_tensor(np.stack([team.velocity for team in self.teams]))
        self._place(position, velocity)
        free = rewards.clearance(position, self.obstacle_map.signed_distance(position), self.radius)
        wall, mate = torch.as_tensor(touched, device=self.goal.device).unbind(1)
        return wall, mate, free

    def _drive(self, team: PhysicsWorld, drives: list[DifferentialDrive], command: NDArray) -> NDArray[np.bool_]:
        """One team for one step; which robots touched a wall and which a mate, ``[2, n]``."""
        touched = np.zeros((2, self.n_robots), bool)
        for _ in range(self.drive_calls):
            headings = team.heading.tolist()
            triples = zip(drives, command.tolist(), headings, strict=True)
            team.step(
                [drive(vector, angle, self.drive_interval) for drive, vector, angle in triples], self.drive_interval
            )
            touched |= [team.wall_contact, team.robot_contact]
        return touched


def boxes(obstacle_map: ObstacleMap | OccupancyMap) -> ObstacleMap:
    """The map, if it is one of boxes.

    Raises:
        ValueError: if it is a grid, of which there is no model.

    Examples:
        >>> from redig.envs import corridor
        >>> boxes(corridor(0.9)).gap
        0.9
    """
    if not isinstance(obstacle_map, ObstacleMap):
        raise ValueError(f"obstacle_map: got {type(obstacle_map).__name__}, MuJoCo's model is of ObstacleMap only")
    return obstacle_map


def base_of(body: RobotBody, max_speed: float, max_acceleration: float) -> Base:
    """Limits of the drive of a body: the wheels may run a fifth faster than the robot, to turn at full speed.

    Examples:
        >>> base_of(RobotBody(), max_speed=1.0, max_acceleration=2.0).max_linear
        1.2
    """
    return Base(
        length=2 * body.radius,
        width=2 * body.radius,
        track=body.track,
        wheel_radius=body.wheel_radius,
        max_linear=1.2 * max_speed,
        max_angular=6.0,
        max_linear_acceleration=max_acceleration,
        max_angular_acceleration=30.0,
    )
