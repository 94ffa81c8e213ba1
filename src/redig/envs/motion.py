"""How the robots of each team move: as points or as bases with wheels, with limits drawn at each reset."""

from __future__ import annotations

import torch
from torch import Tensor

from redig.envs.dynamics import VelocityCommand
from redig.envs.turning import TurningCommand

Range = tuple[float, float] | None


class Motion:
    """The dynamics of all robots, and what differs from team to team in them.

    Args:
        n_robots: robots in a team.
        batch_dim: number of teams.
        device: of the simulation.
        dt: time step (s).
        max_speed: (m/s).
        max_acceleration: (m/s²).
        acceleration_range: smallest and largest factor on ``max_acceleration``; ``None``: 1.
        turn_gain: slowest and fastest turn (1/s) of :class:`~redig.envs.turning.TurningCommand`; ``None``: points.

    Raises:
        ValueError: for a range that is not one, or a factor above 1.

    Examples:
        >>> import torch
        >>> motion = Motion(2, 3, torch.device("cpu"), 0.1, 1.0, 2.0, turn_gain=(2.0, 2.0))
        >>> motion.draw(slice(None), heading=torch.zeros(3, 2))
        >>> motion.gain.squeeze(-1)
        tensor([2., 2., 2.])
    """

    def __init__(
        self,
        n_robots: int,
        batch_dim: int,
        device: torch.device,
        dt: float,
        max_speed: float,
        max_acceleration: float,
        acceleration_range: Range = None,
        turn_gain: Range = None,
    ) -> None:
        low, high = acceleration_range or (1, 1)
        if not 0 < low <= high <= 1:
            raise ValueError(f"acceleration_range: got {acceleration_range}, must be 0 < low <= high <= 1")
        slowest, fastest = turn_gain or (1, 1)
        if not 0 < slowest <= fastest < float("inf"):
            raise ValueError(f"turn_gain: got {turn_gain}, must be 0 < slowest <= fastest (1/s)")
        self.max_acceleration, self.acceleration_range, self.turn_gain = max_acceleration, acceleration_range, turn_gain
        self.acceleration = torch.full((batch_dim, 1), float(max_acceleration), device=device)
        self.gain = torch.zeros(batch_dim, 1, device=device)
        self.heading = torch.zeros(batch_dim, n_robots, 1, device=device)
        self.robots = [self._robot(i, dt, max_speed) for i in range(n_robots)]

    def _robot(self, i: int, dt: float, max_speed: float) -> VelocityCommand:
        if self.turn_gain is not None:
            wheeled = TurningCommand(dt, max_speed, self.gain, self.acceleration)
            wheeled.heading = self.heading[:, i]
            return wheeled
        point = VelocityCommand(dt, max_speed)
        point.acceleration = None if self.acceleration_range is None else self.acceleration
        return point

    @property
    def max_force(self) -> float | None:
        """What VMAS should limit the force on a robot of 1 kg to (N); ``None`` where its dynamics sees to all of it."""
        return self.max_acceleration if self.turn_gain is None else None

    def draw(self, index: slice, heading: Tensor) -> None:
        """New limits for some teams ``[b]``, whose robots head as said ``[b, n]`` (rad)."""
        if self.acceleration_range is not None:
            self.acceleration[index] = self.max_acceleration * _drawn(self.acceleration[index], self.acceleration_range)
        if self.turn_gain is not None:
            self.gain[index] = _drawn(self.gain[index], self.turn_gain)
            self.heading[index] = heading.unsqueeze(-1)

    @property
    def _state(self) -> tuple[str, ...]:
        return ("acceleration",) if self.turn_gain is None else ("acceleration", "gain", "heading")

    def state_dict(self) -> dict[str, Tensor]:
        """What the next step depends on."""
        return {name: getattr(self, name).clone() for name in self._state}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Put it back."""
        for name in self._state:
            getattr(self, name).copy_(state[name])


def _drawn(like: Tensor, bounds: tuple[float, float]) -> Tensor:
    low, high = bounds
    return low + (high - low) * torch.rand_like(like)
