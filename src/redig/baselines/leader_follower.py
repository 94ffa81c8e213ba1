"""Leader and followers: the leader plans, the others hold the rigid shape behind it."""

from __future__ import annotations

import torch
from torch import Tensor

from redig.baselines.episode import EpisodePlanner
from redig.envs.dynamics import limit_norm
from redig.envs.navigation import FormationNavigation
from redig.planning.astar import astar
from redig.planning.plans import team_grids
from redig.planning.tracking import PathTracker, pad_paths


class LeaderFollower(EpisodePlanner):
    """One robot plans a path to its goal, and the others keep their places relative to it (L&F of the paper).

    The leader follows its own A* path. The shape is rigid: a follower's slot is the leader's position plus its offset,
    turned by the heading of the shape. That heading follows the leader's motion, smoothed, and becomes that of the goal
    formation near the goal. A follower commands the slot's velocity plus ``gain`` times the way to it. The leader
    waits: it slows with the error of the follower that is farthest from where it can be, to ``slowest`` of its speed.

    Followers do not plan. Where a slot lies in a wall they go to the nearest free place, and near walls and teammates
    all robots approach no faster than they can stop.

    Args:
        scenario: of the environment to drive.
        leader: number of the leading robot; default: the one farthest ahead, and of those the one in the middle.
        speed: of the leader (m/s).
        gain: velocity of a follower for each metre to its slot (1/s).
        patience: error of a follower at which the leader is slowest (m).
        slowest: share of its speed that the leader keeps.
        turning: time constant of the heading and of the leader's pace (s).
        clearance: that is kept from walls and teammates (m).

    Raises:
        ValueError: if an argument is out of range.

    Examples:
        >>> from redig.envs import make_env
        >>> from redig.evaluation import evaluate
        >>> env = make_env(2, corridor_width=3.0)
        >>> evaluate(LeaderFollower(env.scenario), env, seed=0)["success_rate"]  # the rigid wedge fits
        1.0
    """

    def __init__(
        self,
        scenario: FormationNavigation,
        leader: int | None = None,
        speed: float = 0.8,
        gain: float = 2.0,
        patience: float = 0.6,
        slowest: float = 0.15,
        turning: float = 0.3,
        clearance: float = 0.03,
    ) -> None:
        super().__init__(scenario)
        offsets = scenario.offsets
        if leader is None:
            leader = int((offsets[:, 0].round(decimals=3) - 1e-3 * offsets[:, 1].abs()).argmax())
        if not 0 <= leader < scenario.n_robots:
            raise ValueError(f"leader: got {leader}, must be from 0 to {scenario.n_robots - 1}")
        if not 0 < speed <= scenario.max_speed:
            raise ValueError(f"speed: got {speed}, must satisfy 0 < speed <= max_speed = {scenario.max_speed} m/s")
        for name, value in (("gain", gain), ("patience", patience), ("turning", turning), ("clearance", clearance)):
            if not value > 0:
                raise ValueError(f"{name}: got {value}, must be greater than 0")
        if not 0 <= slowest <= 1:
            raise ValueError(f"slowest: got {slowest}, must be in [0, 1]")
        self.leader, self.speed, self.gain, self.patience, self.slowest = leader, speed, gain, patience, slowest
        self.turning, self.clearance = turning, clearance
        self.grid_of = team_grids(scenario)
        self._paths: list[Tensor] = []

    def begin(self, teams: Tensor, position: Tensor, goal: Tensor, num_teams: int) -> None:
        """Plan the leaders' paths; the shape starts with the heading that the team stands in."""
        if len(self._paths) != num_teams:
            self._paths = [position.new_empty(0)] * num_teams
            self.heading, self.goal_heading = position.new_zeros(num_teams), position.new_zeros(num_teams)
            self.goal, self.pace = position.new_zeros(num_teams, 2), position.new_zeros(num_teams, 1)
        offsets = self.scenario.offsets
        self.heading[teams], self.goal_heading[teams] = heading_of(position, offsets), heading_of(goal, offsets)
        self.goal[teams], self.pace[teams] = goal[:, self.leader], 1.0
        starts, ends = position[:, self.leader].tolist(), goal[:, self.leader].tolist()
        for team, start, end in zip(teams.tolist(), starts, ends, strict=True):
            self._paths[team] = astar(self.grid_of(team), start, end)
        paths = pad_paths(self._paths).to(position.device)
        speed = torch.full((num_teams,), self.speed, device=position.device)
        self._tracker = PathTracker(paths, speed, self.scenario.max_acceleration, self.scenario.dt)

    def command(self, position: Tensor, velocity: Tensor, step: Tensor) -> Tensor:
        """Lead, follow, and brake before walls and teammates."""
        leader, dt = position[:, self.leader], self.scenario.dt
        own = self._tracker(leader)  # [B, 2]
        slots = self._slots(leader)
        error = (self._free(slots) - position).norm(dim=-1).amax(-1, keepdim=True)
        wanted = (1 - error / self.patience).clamp(self.slowest, 1)
        self.pace = self.pace + (wanted - self.pace) * dt / self.turning
        own = own * self.pace
        turn = self._turn(leader, own)
        self.heading = self.heading + turn
        moved = self._slots(leader + dt * own)
        following = (moved - slots) / dt + self.gain * (self._free(moved) - position)
        commands = limit_norm(following, self.scenario.max_speed)
        commands[:, self.leader] = own
        return self._brake(position, commands)

    def _slots(self, leader: Tensor) -> Tensor:
        """Places of all robots ``[B, n, 2]`` (m) for leaders at ``[B, 2]``."""
        offset = self.scenario.offsets - self.scenario.offsets[self.leader]
        cos, sin = self.heading.cos().unsqueeze(-1), self.heading.sin().unsqueeze(-1)
        forward, left = offset.unbind(-1)
        return leader.unsqueeze(1) + torch.stack([cos * forward - sin * left, sin * forward + cos * left], -1)

    def _turn(self, leader: Tensor, own: Tensor) -> Tensor:
        """Change of the heading (rad) in this step: towards the motion, and over the last 1.5 m to the goal's."""
        motion = torch.atan2(own[:, 1], own[:, 0])
        near = (1.5 - (self.goal - leader).norm(dim=-1)).clamp(0, 1)
        wanted = wrapped(motion - self.heading) * (1 - near) + wrapped(self.goal_heading - self.heading) * near
        return wanted * self.scenario.dt / self.turning

    def _free(self, place: Tensor) -> Tensor:
        """The nearest places at which a robot is clear of walls."""
        distance, direction = self.scenario.obstacle_map.nearest(place)
        inside = (self.scenario.radius + self.clearance - distance).clamp_min(0).unsqueeze(-1)
        return place - inside * direction

    def _brake(self, position: Tensor, command: Tensor) -> Tensor:
        """Take from the commands what would bring robots to walls or teammates faster than they can stop."""
        scenario = self.scenario
        gap, direction = scenario.obstacle_map.nearest(position)
        command = command - direction * self._excess(command, direction, gap - scenario.radius)
        between = position.unsqueeze(-3) - position.unsqueeze(-2)  # [B, n, n, 2], from i to j
        gap = between.norm(dim=-1)
        direction = between / gap.clamp_min(1e-6).unsqueeze(-1)
        gap = gap + 1e3 * torch.eye(scenario.n_robots, device=position.device)
        closing = command.unsqueeze(-2) - command.unsqueeze(-3)  # of i against j
        excess = self._excess(closing, direction, gap - 2 * scenario.radius) / 2
        return command - (direction * excess).sum(-2)

    def _excess(self, velocity: Tensor, direction: Tensor, gap: Tensor) -> Tensor:
        """How much faster than allowed it is along ``direction`` ``[*B, 2]``, with ``gap`` ``[*B]`` (m) left."""
        left = (gap - self.clearance).clamp_min(0)
        braking = 0.5 * self.scenario.max_acceleration
        allowed = torch.minimum((2 * braking * left).sqrt(), left / (2 * self.scenario.dt))
        return ((velocity * direction).sum(-1) - allowed).clamp_min(0).unsqueeze(-1)


def heading_of(position: Tensor, offsets: Tensor) -> Tensor:
    """Heading ``[*B]`` (rad) of the formation ``offsets`` ``[n, 2]`` that fits ``position`` ``[*B, n, 2]`` best.

    Examples:
        >>> import torch
        >>> from redig.envs import formation_offsets
        >>> line = formation_offsets("line", 3)
        >>> heading_of(torch.stack([-line[:, 1], line[:, 0]], -1), line).item()  # turned left by a right angle
        1.5707963705062866
    """
    x, y = (position - position.mean(-2, keepdim=True)).unbind(-1)
    forward, left = offsets.unbind(-1)
    return torch.atan2((forward * y - left * x).sum(-1), (forward * x + left * y).sum(-1))


def wrapped(angle: Tensor) -> Tensor:
    """The same angle (rad) between -pi and pi.

    Examples:
        >>> wrapped(torch.tensor([0.5, 5.5])).round(decimals=4)
        tensor([ 0.5000, -0.7832])
    """
    return torch.atan2(angle.sin(), angle.cos())
