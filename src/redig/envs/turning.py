"""A robot with wheels among the points of VMAS: it must turn before it can drive where it is told."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from redig.envs.dynamics import VelocityCommand, limit_norm

SLOW = 0.1  # m/s: commands below it turn the robot the slower, the slower they are


class TurningCommand(VelocityCommand):
    """Robot that takes velocity commands (m/s), turns towards them, and drives along its heading only.

    The motion of a :class:`~redig.deploy.drive.DifferentialDrive` without its limits on wheels: the angle ``e`` between
    heading and command decays as ``exp(-gain t)``, at ``max_turn`` at most, and the robot drives at ``|command| cos e``
    within its acceleration limit; backwards where the command is behind. The force that holds it in a curve is its
    wheels' own: the agent needs ``max_f=None``.

    Args:
        dt: time step (s).
        max_speed: limit on the norm of the command (m/s).
        gain: how fast the angle is closed, of each environment ``[B, 1]`` (1/s).
        acceleration: limit along the heading, of each environment ``[B, 1]`` (m/s²).
        max_turn: fastest turn (rad/s).

    Attributes:
        heading: of the robot in each environment ``[B, 1]`` (rad), counter-clockwise from x.

    Examples:
        >>> import torch
        >>> from vmas.simulator.core import Agent, World
        >>> world = World(1, torch.device("cpu"), dt=0.1, drag=0.0)
        >>> dynamics = TurningCommand(0.1, 1.0, gain=torch.tensor([[4.0]]), acceleration=torch.tensor([[2.0]]))
        >>> robot = Agent("agent_0", dynamics=dynamics)
        >>> world.add_agent(robot)
        >>> robot.action.u = torch.tensor([[0.5, 0.5]])  # at 45 degrees to the left of where it looks
        >>> dynamics.process_action()
        >>> world.step()
        >>> dynamics.heading.rad2deg().round(), robot.state.vel.norm()
        (tensor([[15.]]), tensor(0.2000))
    """

    acceleration: Tensor

    def __init__(self, dt: float, max_speed: float, gain: Tensor, acceleration: Tensor, max_turn: float = 6.0) -> None:
        super().__init__(dt, max_speed)
        self.gain, self.acceleration, self.max_turn = gain, acceleration, max_turn
        self.heading = torch.zeros_like(gain)

    def process_action(self) -> None:
        """Turn, then speed up along the new heading: both become the force of the agent."""
        command = limit_norm(self.agent.action.u[:, :2], self.max_speed)
        speed = command.norm(dim=-1, keepdim=True)
        error = wrapped(torch.atan2(command[:, 1:], command[:, :1]) - self.heading)
        behind = error.abs() > math.pi / 2
        error = torch.where(behind, wrapped(error + math.pi), error)
        closed = error * (1 - torch.exp(-self.gain * (speed / SLOW).clamp_max(1) * self.dt))
        turn = closed.clamp(-self.max_turn * self.dt, self.max_turn * self.dt)

        velocity = self.agent.state.vel
        before = (velocity * unit_vector(self.heading)).sum(-1, keepdim=True)
        wanted = torch.where(behind, -speed, speed) * (error - turn).cos()
        most = self.acceleration * self.dt
        change = (wanted - before).clamp(-most, most)
        self.heading.copy_(wrapped(self.heading + turn))  # in place: it may be a view of a whole team's
        self.agent.state.force = self.agent.mass * ((before + change) * unit_vector(self.heading) - velocity) / self.dt


def wrapped(angle: Tensor) -> Tensor:
    """Angles (rad) brought into [-pi, pi).

    Examples:
        >>> import torch
        >>> wrapped(torch.tensor([0.0, 7.0])).round(decimals=3)
        tensor([0.0000, 0.7170])
    """
    return (angle + math.pi) % (2 * math.pi) - math.pi


def unit_vector(heading: Tensor) -> Tensor:
    """Unit vectors ``[*B, 2]`` of headings ``[*B, 1]`` (rad).

    Examples:
        >>> import torch
        >>> unit_vector(torch.tensor([[0.0]]))
        tensor([[1., 0.]])
    """
    return torch.cat([heading.cos(), heading.sin()], -1)
