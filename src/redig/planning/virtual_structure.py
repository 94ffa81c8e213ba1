"""Virtual structure: the whole formation squeezed to fit the map ahead, and restored after it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from redig.envs.formations import formation_integrity
from redig.envs.maps import ObstacleMap
from redig.envs.occupancy import OccupancyMap
from redig.planning.centre_path import centre_path, free_width, normals, team_grid
from redig.planning.curves import sample, smooth
from redig.planning.grid import OccupancyGrid
from redig.planning.timing import time_scaling

SPACING = 0.02  # m, between samples of a way
LEVELS = 41  # of the squeeze, from none to full
EARLY = 0.6  # share of the smoothing window by which a squeeze comes early, so that smoothing costs few millimetres


@dataclass(frozen=True, eq=False)
class StructurePlanner:
    """Plans the ways of all robots of a team together.

    The formation is a structure that moves along a path through the middle of the free room (:func:`centre_path`). Each
    robot keeps its place in it: so far along the path, so far to the left of it. Where the map is too narrow, the
    structure is squeezed: the places ``o_i`` (forward, left) become ``o_i (I + u (D - I))^T`` with
    ``D = [[stretch, shear], [0, squeeze]]`` and u from 0 to 1.

    ``squeeze`` is what fits the narrowest place. ``stretch`` and ``shear`` are chosen such that robots keep apart and
    ``tau - delay_cost * (metres that robots must gain or lose on the centre)`` is largest: each such metre costs about
    a second. All robots move in straight lines from one shape to the next, as early and as gently as there is room for.

    Args:
        obstacle_map: the map.
        formation: its name, see :func:`~redig.envs.formations.formation_integrity`.
        offsets: ``[n, 2]`` (m), forward and left.
        radius: of a robot (m).
        clearance: to keep from walls and between robots (m); in a very narrow gap half of the room there is.
        delay_cost: formation integrity that a second of travel is worth.
        approach: longest way over which the structure changes its shape (m).
        corner: half of the window over which ways are smoothed (m).
        effort: share of the acceleration limit to use; the mean jerk is about proportional to it.

    Raises:
        ValueError: if no room is left for a robot, or an argument is out of range.

    Examples:
        >>> from redig.envs import corridor, formation_offsets
        >>> offsets = formation_offsets("wedge", 5)
        >>> plan = StructurePlanner(corridor(), "wedge", offsets, radius=0.1)
        >>> start, goal = offsets - torch.tensor([2.75, 0.0]), offsets + torch.tensor([2.75, 0.0])
        >>> position = plan(start, goal, max_speed=1.0, max_acceleration=2.0, dt=0.1)
        >>> bool((corridor().signed_distance(position) > 0.1).all()), bool(torch.allclose(position[-1], goal))
        (True, True)
    """

    obstacle_map: ObstacleMap | OccupancyMap
    formation: str
    offsets: Tensor
    radius: float
    clearance: float = 0.025
    delay_cost: float = 0.2
    approach: float = 2.0
    corner: float = 0.6
    effort: float = 0.8

    def __post_init__(self) -> None:
        for name in ("clearance", "effort"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: got {getattr(self, name)}, must be greater than 0")
        for name in ("approach", "corner"):
            if not getattr(self, name) >= SPACING:
                raise ValueError(f"{name}: got {getattr(self, name)}, must be at least {SPACING} m")
        if not self.effort <= 1:
            raise ValueError(f"effort: got {self.effort}, must be at most 1")

    @cached_property
    def grid(self) -> OccupancyGrid:
        """What the path of the centre is searched on."""
        return team_grid(self.obstacle_map, self.radius, self.reach)

    @property
    def margin(self) -> float:
        """Distance (m) from walls and between robots."""
        return min(self.clearance, (self.obstacle_map.gap / 2 - self.radius) / 2)

    @property
    def half_breadth(self) -> float:
        """Distance (m) of the outermost robot from the centre line, when the structure is not squeezed."""
        return self.offsets[:, 1].abs().max().item()

    @property
    def reach(self) -> float:
        """Half of the breadth (m) that the team needs when it is not squeezed."""
        return self.half_breadth + self.radius + self.margin

    def __call__(self, start: Tensor, goal: Tensor, max_speed: float, max_acceleration: float, dt: float) -> Tensor:
        """Positions ``[T, n, 2]`` (m) at times 0, dt, ... from ``start`` ``[n, 2]`` to ``goal`` ``[n, 2]`` (m)."""
        return time_scaling(self.ways(start, goal), max_speed, self.effort * max_acceleration, dt)

    def ways(self, start: Tensor, goal: Tensor) -> Tensor:
        """Ways of all robots ``[S, n, 2]`` (m): row s is where they are when the centre is at sample s of its path."""
        path = centre_path(self.obstacle_map, self.grid, start.mean(0), goal.mean(0), self.reach, SPACING)
        squeezed = self.squeezed(path)
        window = round(self.corner / SPACING)
        needed = self._needed(path, squeezed)
        early = round(EARLY * window)
        needed = torch.nn.functional.max_pool1d(needed.view(1, 1, -1), 2 * early + 1, 1, early).flatten()
        level = self._ramps(needed)
        shape = torch.lerp(self.offsets, squeezed, level[:, None, None])  # [S, n, 2]
        ways = place(path, shape)
        bound = needed.nonzero().flatten()
        first, last = (bound[0], bound[-1]) if len(bound) else (torch.tensor(len(path)), torch.tensor(0))
        station = torch.arange(len(path))
        leaving = (1 - station / self._room(first)).clamp_min(0)[:, None, None]
        arriving = (1 - (len(path) - 1 - station) / self._room(len(path) - 1 - last)).clamp_min(0)[:, None, None]
        ways = ways + leaving * (start - ways[0]) + arriving * (goal - ways[-1])
        return smooth(ways, window)

    def squeezed(self, path: Tensor) -> Tensor:
        """Places ``[n, 2]`` (m) in the structure where ``path`` ``[S, 2]`` is narrowest."""
        left, right = free_width(self.obstacle_map, path, self.reach)
        breadth = (left + right)[(left < self.reach) & (right < self.reach)]
        breadth = torch.cat([breadth, breadth.new_tensor([2 * self.reach])])  # where nothing binds
        room = breadth.min().item() / 2 - self.radius - self.margin
        if room <= 0:
            raise ValueError(
                f"obstacle_map: {breadth.min().item():.2f} m at the narrowest place, too narrow for a robot of radius "
                f"{self.radius} m with {self.margin:.3f} m on either side"
            )
        squeeze = min(1.0, math.floor(1e3 * room) / 1e3 / self.half_breadth)
        return self._best_shape(squeeze)

    @lru_cache(maxsize=64)  # noqa: B019 - the plans of many teams on one map differ by less than a millimetre
    def _best_shape(self, squeeze: float) -> Tensor:
        forward, left = self.offsets.unbind(-1)
        stretch, shear = torch.meshgrid(torch.linspace(0.2, 3, 141), torch.linspace(0, 3, 151), indexing="ij")
        stretch, shear = stretch.reshape(-1, 1), shear.reshape(-1, 1)
        x = stretch * forward + shear * left
        places = torch.stack([x, (squeeze * left).expand_as(x)], -1)  # [C, n, 2]
        gained = x - forward
        delay = gained.amax(-1) - gained.amin(-1)
        value = formation_integrity(self.formation, places) - self.delay_cost * delay
        value = value - 1e-3 * (stretch - 1).abs().squeeze(-1)  # between equals, the one that is stretched least
        return places[value.masked_fill(~self._apart(places), -torch.inf).argmax()]

    def _apart(self, places: Tensor) -> Tensor:
        """Whether the robots keep clear of each other in each of ``places`` ``[C, n, 2]`` and on the way to it."""
        n = len(self.offsets)
        apart = torch.ones(len(places), dtype=torch.bool)
        needed = min(2 * self.radius + self.margin, torch.pdist(self.offsets).min().item())
        for share in (0.25, 0.5, 0.75, 1.0):
            gap = torch.cdist(between := torch.lerp(self.offsets, places, share), between)
            apart &= (gap + 1e3 * torch.eye(n)).amin((-1, -2)) >= needed - 1e-6
        return apart

    def _needed(self, path: Tensor, squeezed: Tensor) -> Tensor:
        """Least squeeze ``[S]``, from 0 to 1, with which all robots are clear of walls at each sample of the path."""
        level = torch.linspace(0, 1, LEVELS)
        shapes = torch.lerp(self.offsets, squeezed, level[:, None, None])  # [L, n, 2]
        position = place(path, shapes.unsqueeze(1).expand(-1, len(path), -1, -1))  # [L, S, n, 2]
        free = self.obstacle_map.signed_distance(position).amin(-1) >= self.radius + 0.75 * self.margin
        hit = (~free).flip(0).int()
        last_hit = LEVELS - 1 - hit.argmax(0)
        return torch.where(hit.any(0), level[(last_hit + 1).clamp_max(LEVELS - 1)], 0.0)

    def _room(self, samples: Tensor) -> Tensor:
        return samples.clamp(1, round(self.approach / SPACING))

    def _ramps(self, needed: Tensor) -> Tensor:
        """The least squeeze that is as needed everywhere and changes linearly over the way there is, 0 at both ends."""
        place = needed.nonzero()  # [N, 1]
        ahead = (torch.arange(len(needed)) - place).float()  # [N, S], from a narrow place to each sample
        before, after = self._room(place), self._room(len(needed) - 1 - place)
        tent = (1 - torch.maximum(ahead / after, -ahead / before)).clamp_min(0) * needed[place]
        return torch.cat([tent, torch.zeros(1, len(needed))]).amax(0)


def place(path: Tensor, shape: Tensor) -> Tensor:
    """Where robots are if their place is ``shape`` ``[*B, S, n, 2]`` (m), along and to the left of ``path`` ``[S, 2]``.

    Examples:
        >>> import torch
        >>> path = torch.stack([torch.linspace(0, 1, 51), torch.zeros(51)], -1)
        >>> place(path, torch.tensor([[0.5, 0.2]]).expand(51, 1, 2))[0]
        tensor([[0.5000, 0.2000]])
    """
    spacing = (path[1:] - path[:-1]).norm(dim=-1).mean()
    station = torch.arange(len(path)).unsqueeze(-1) + shape[..., 0] / spacing
    return sample(path, station) + shape[..., 1:] * sample(normals(path), station.clamp(0, len(path) - 1))
