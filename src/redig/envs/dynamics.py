"""How a velocity command becomes motion: within a speed limit and an acceleration limit, and never through a wall."""

from __future__ import annotations

import torch
from torch import Tensor
from vmas.simulator.dynamics.common import Dynamics


class VelocityCommand(Dynamics):
    """Robot that takes velocity commands (m/s) and follows them as fast as its acceleration limit allows.

    The command is shortened to ``max_speed``; the force that reaches it within one step is limited by VMAS to the
    agent's ``max_f``, which for a mass of 1 kg is the acceleration limit in m/s².

    Args:
        dt: time step (s).
        max_speed: limit on the norm of the command (m/s).

    Attributes:
        acceleration: a limit of each environment's own beside that of ``max_f``, ``[B, 1]`` (m/s²), or ``None``.

    Examples:
        >>> import torch
        >>> from vmas.simulator.core import Agent, World
        >>> world = World(1, torch.device("cpu"), dt=0.1, drag=0.0)
        >>> robot = Agent("agent_0", max_f=2.0, dynamics=VelocityCommand(dt=0.1, max_speed=1.0))
        >>> world.add_agent(robot)
        >>> robot.action.u = torch.tensor([[3.0, 4.0]])
        >>> robot.dynamics.process_action()
        >>> world.step()
        >>> robot.state.vel  # a tenth of a second at 2 m/s²
        tensor([[0.1200, 0.1600]])
    """

    def __init__(self, dt: float, max_speed: float) -> None:
        super().__init__()
        self.dt = dt
        self.max_speed = max_speed
        self.acceleration: Tensor | None = None

    @property
    def needed_action_size(self) -> int:
        """Two: the command along x and y."""
        return 2

    def process_action(self) -> None:
        """Turn the command of the agent into a force."""
        command = limit_norm(self.agent.action.u[:, :2], self.max_speed)
        acceleration = (command - self.agent.state.vel) / self.dt
        if self.acceleration is not None:
            acceleration = limit_norm(acceleration, self.acceleration)
        self.agent.state.force = self.agent.mass * acceleration


def limit_norm(vector: Tensor, limit: float | Tensor) -> Tensor:
    """Shorten vectors ``[*B, 2]`` to a norm of at most ``limit`` (``[*B, 1]`` or a number), keeping their direction.

    Examples:
        >>> import torch
        >>> limit_norm(torch.tensor([3.0, 4.0]), 1.0)
        tensor([0.6000, 0.8000])
    """
    return vector * (limit / vector.norm(dim=-1, keepdim=True).clamp_min(limit))


def part_robots(position: Tensor, velocity: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Push overlapping robots apart by half the overlap each, and take their closing speed (inelastic contact).

    One pass: two robots end apart, in a crowd some overlap may be left for the next step. Robots that cover no more
    than their radius in a step cannot pass through each other.

    Args:
        position: ``[*B, n, 2]`` (m).
        velocity: ``[*B, n, 2]`` (m/s).
        radius: of a robot (m).

    Returns:
        position and velocity after the contact, shapes as given.

    Examples:
        >>> import torch
        >>> part_robots(torch.tensor([[0.0, 0.0], [0.1, 0.0]]), torch.tensor([[1.0, 0.0], [-1.0, 0.5]]), radius=0.1)
        (tensor([[-0.0500,  0.0000],
                [ 0.1500,  0.0000]]), tensor([[0.0000, 0.0000],
                [0.0000, 0.5000]]))
    """
    relative = position.unsqueeze(-2) - position.unsqueeze(-3)  # [*B, n, n, 2], from j to i
    gap = relative.norm(dim=-1, keepdim=True)
    apart = relative / gap.clamp_min(1e-6)
    myself = torch.eye(position.shape[-2], dtype=torch.bool, device=position.device).unsqueeze(-1)
    push = apart * (2 * radius - gap).clamp_min(0).masked_fill(myself, 0) / 2
    touching = (gap < 2 * radius + 1e-4) & ~myself
    closing = ((velocity.unsqueeze(-2) - velocity.unsqueeze(-3)) * apart).sum(-1, keepdim=True).clamp_max(0)
    return position + push.sum(-2), velocity - (apart * closing / 2 * touching).sum(-2)


def leave_walls(
    position: Tensor, velocity: Tensor, radius: float, distance: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor]:
    """Push robots out of walls, and take their motion into them (inelastic contact, no friction).

    Args:
        position: ``[*B, n, 2]`` (m).
        velocity: ``[*B, n, 2]`` (m/s).
        radius: of a robot (m).
        distance: signed distance to the nearest obstacle ``[*B, n]`` (m).
        direction: unit vector to it ``[*B, n, 2]``.

    Returns:
        position and velocity after the contact, shapes as given.

    Examples:
        >>> import torch
        >>> robot, velocity = torch.tensor([[0.75, 0.0]]), torch.tensor([[1.0, 0.5]])
        >>> wall_ahead = torch.tensor([[1.0, 0.0]])
        >>> leave_walls(robot, velocity, 0.5, distance=torch.tensor([0.25]), direction=wall_ahead)
        (tensor([[0.5000, 0.0000]]), tensor([[0.0000, 0.5000]]))
    """
    inside = (radius - distance).clamp_min(0).unsqueeze(-1)
    inward = (velocity * direction).sum(-1, keepdim=True).clamp_min(0) * (inside > 0)
    return position - direction * inside, velocity - direction * inward
