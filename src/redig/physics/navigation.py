"""The task of :class:`~redig.envs.FormationNavigation` with MuJoCo in place of VMAS's physics."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from vmas.simulator.core import World

from redig.envs import rewards
from redig.envs.dynamics import limit_norm
from redig.envs.navigation import FormationNavigation
from redig.physics.model import Ground, RobotBody
from redig.physics.stand_in import Drive
from redig.physics.world import PhysicsWorld


class PhysicsNavigation(FormationNavigation):
    """Formation navigation by differential-drive robots in MuJoCo: starts, observations, rewards and ends unchanged."""

    def make_world(self, batch_dim: int, device: torch.device, **kwargs) -> World:
        """Build the team and its map in both simulators (called by VMAS)."""
        ground, self.drive_interval = kwargs.pop("ground", Ground()), kwargs.pop("drive_interval", 0.02)
        drive = kwargs.pop("drive", {})
        world = super().make_world(batch_dim, device, **kwargs)
        body = RobotBody(radius=self.radius)
        self.teams = [PhysicsWorld(self.obstacle_map, self.n_robots, body, ground) for _ in range(batch_dim)]
        self.drives = [Drive(self.n_robots, **drive) for _ in range(batch_dim)]
        return world

    def reset_world_at(self, env_index: int | None = None) -> None:
        """Draw new starts and goals; robots face their goals."""
        super().reset_world_at(env_index)
        position = self._positions()
        ahead = self.goal - position
        heading = torch.atan2(ahead[..., 1], ahead[..., 0])
        for i in range(len(self.teams)) if env_index is None else [env_index]:
            self.teams[i].reset(position[i].cpu().numpy(), heading[i].cpu().numpy())
            self.drives[i].reset()

    def _settle(self) -> tuple[Tensor, Tensor, Tensor]:
        """Let MuJoCo carry out the commands from where it was; what VMAS made of them is replaced."""
        command = torch.stack([agent.action.u for agent in self.world.agents], 1)
        command = limit_norm(command, self.max_speed).double().cpu().numpy()
        wall, mate = [], []
        for team, drive, wanted in zip(self.teams, self.drives, command, strict=True):
            touched = []
            for _ in range(round(self.dt / self.drive_interval)):
                team.step(drive(wanted, team.heading, self.drive_interval), self.drive_interval)
                touched.append((team.wall_contact.copy(), team.robot_contact.copy()))
            wall.append(np.any([w for w, _ in touched], 0))
            mate.append(np.any([m for _, m in touched], 0))
        like = self.goal
        position = like.new_tensor(np.stack([team.position for team in self.teams]))
        velocity = like.new_tensor(np.stack([team.velocity for team in self.teams]))
        self._place(position, velocity)
        clear = rewards.clearance(position, self.obstacle_map.signed_distance(position), self.radius)
        flags = [torch.as_tensor(np.stack(x), device=like.device) for x in (wall, mate)]
        return flags[0], flags[1], clear
