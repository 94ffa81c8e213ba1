"""Formation navigation through a map: a VMAS scenario in one file, used through TorchRL's ``VmasEnv``."""

from __future__ import annotations

import torch
from torch import Tensor
from vmas.simulator.core import Agent, Sphere, World
from vmas.simulator.scenario import BaseScenario

from redig.envs import rewards, starts
from redig.envs.direction import observed_obstacle
from redig.envs.dynamics import leave_walls, part_robots
from redig.envs.formation_reward import FORMATION_REWARDS, formation_reward
from redig.envs.formations import formation_offsets, pairwise_distances
from redig.envs.map_batch import AnyMap, check_map, map_at
from redig.envs.maps import corridor
from redig.envs.motion import Motion
from redig.envs.random_maps import named_map
from redig.envs.routes import turned_along

NAVIGATION_REWARDS = ("goal_speed", "progress")


class FormationNavigation(BaseScenario):
    """A team crosses a map in formation: from a formation on one side to the same formation on the other.

    The defaults are the paper's (Eq. 29 and 30, with the corrections of ``docs/paper.md``); recipes state what they
    change. All quantities of a step are computed once for the whole team after the physics step, so rewards do not
    depend on the order in which VMAS asks for them.

    Keyword arguments of ``VmasEnv(FormationNavigation(), ...)``:

    * ``formation``, ``n_robots``, ``formation_width`` (m): the shape, see
      :func:`~redig.envs.formations.formation_offsets`.
    * ``corridor_width``, ``corridor_length`` (m), ``corridor_angle`` (rad): the default map. ``obstacle_map`` replaces
      it: an :class:`~redig.envs.ObstacleMap`, an :class:`~redig.envs.OccupancyMap`, a :class:`~redig.envs.MapBatch`
      with a map for each environment, or a name, see :func:`~redig.envs.named_map`.
    * ``start_distance`` (m): from the map's centre to the centre of the start and of the goal formation, along
      ``corridor_angle``; on a map with a route, its ends say where both are and how they head. ``position_jitter`` (m)
      and ``heading_jitter`` (rad): half ranges of what is added to each.
    * ``radius`` (m), ``max_speed`` (m/s), ``max_acceleration`` (m/s²), ``dt`` (s): the robots. ``acceleration_range``:
      smallest and largest factor on ``max_acceleration``, drawn for each team at its reset; ``None``: 1. ``turn_gain``:
      slowest and fastest turn towards commands (1/s), drawn likewise, of robots with wheels that start facing their
      goals, see :class:`~redig.envs.TurningCommand`; ``None``: points that move in any direction at once.
    * ``observe_direction``: add the unit vector to the nearest obstacle (9 numbers); ``False`` gives the paper's 7.
      ``direction_smoothing`` (m): how far to either side of where the nearest obstacle changes that vector turns, see
      :func:`~redig.envs.direction.smoothed_direction`; 0: it jumps.
    * ``formation_reward``: one of ``spring_damper`` (Eq. 29), ``spring_damper_bonus``, ``scaled``, ``slanted``,
      ``integrity``, ``none``; ``formation_weight``; ``omega``; ``formation_tolerance`` (m): how far from its place a
      robot's bonus is gone, of ``scaled`` and ``slanted``. The frame of these two is the goal's heading, so that the
      goal itself is a perfect formation. On a route it is turned back by as much as the route turns between the team's
      centroid and the goal, so that a team is squeezed across the path wherever it is; on a straight one that is
      nothing. The contextual formation integrity has no frame.
    * ``navigation_reward``: ``goal_speed`` (Eq. 30) or ``progress``, both as the crow flies: along an arc of less than
      half a circle every step still pays; ``time_cost``, taken from it at each step until the robot arrives;
      ``arrival_bonus``, ``goal_radius`` (m); ``collision_penalty``; ``proximity_penalty`` and ``proximity_margin``
      (m), a ramp before contact.
    * ``collision_terminates``, ``arrival_terminates``: what ends the task of one robot (``info["terminated"]``).
    * ``hold_steps``: steps for which the team holds at its goals before the episode ends.

    Observation of a robot: position (m), velocity (m/s), goal - position (m), distance to the nearest obstacle (m) and,
    optionally, the direction to it. A robot that has arrived holds: it is steered to its goal whatever its command.

    ``info`` of a robot: ``position``, ``velocity``, ``pairwise_distance`` ``[n]``, ``navigation_reward``,
    ``formation_reward``, ``arrival_reward``, ``collision_reward``, ``wall_collision``, ``robot_collision``,
    ``collision``, ``arrived``, ``terminated`` (0 or 1).

    Raises:
        ValueError: for an unknown name, a size that is not positive, a passage too narrow for one robot, a number of
            maps that is not that of the environments, or a start or goal inside a wall.
        TypeError: for an unknown keyword argument.

    Examples:
        >>> from torchrl.envs import VmasEnv
        >>> from redig.envs import FormationNavigation
        >>> env = VmasEnv(FormationNavigation(), num_envs=4, formation="line", n_robots=3, seed=0)
        >>> env.reset()["agents", "observation"].shape
        torch.Size([4, 3, 9])
    """

    obstacle_map: AnyMap

    def make_world(self, batch_dim: int, device: torch.device, **kwargs) -> World:
        """Build the team and its map (called by VMAS)."""
        self._read_arguments(kwargs, batch_dim)
        offsets = formation_offsets(self.formation, self.n_robots, self.formation_width)
        self.offsets = offsets.to(device)
        self.obstacle_map = self.obstacle_map.to(device)
        limits = self.dt, self.max_speed, self.max_acceleration, self.acceleration_range, self.turn_gain
        self.motion = Motion(self.n_robots, batch_dim, device, *limits)
        world = World(batch_dim, device, dt=self.dt, drag=0.0)
        for i in range(self.n_robots):
            world.add_agent(
                Agent(
                    name=f"agent_{i}",
                    shape=Sphere(self.radius),
                    rotatable=False,
                    collide=False,  # contact is resolved against the signed distance, see ``post_step``
                    mass=1.0,
                    max_f=self.motion.max_force,
                    u_range=self.max_speed,
                    dynamics=self.motion.robots[i],
                )
            )
        batch = (batch_dim, self.n_robots)
        self.poses, self.ahead = starts.start_and_goal(
            self.obstacle_map, self.corridor_angle, self.start_distance, batch_dim, device
        )
        self.goal = torch.zeros(*batch, 2, device=device)
        self.direction = torch.zeros(batch_dim, 2, device=device)
        self.arrived = torch.zeros(batch, dtype=torch.bool, device=device)
        self.held = torch.zeros(batch_dim, dtype=torch.long, device=device)
        self._quantities: dict[str, Tensor] | None = None
        return world

    def _read_arguments(self, kwargs: dict, batch_dim: int) -> None:
        take = kwargs.pop
        self.formation = take("formation", "wedge")
        self.n_robots = take("n_robots", 5)
        self.formation_width = take("formation_width", 2.0)
        corridor_width, corridor_length = take("corridor_width", 1.1), take("corridor_length", 2.0)
        self.corridor_angle = take("corridor_angle", 0.0)
        self.start_distance = take("start_distance", 2.75)
        self.position_jitter = take("position_jitter", 0.25)
        self.heading_jitter = take("heading_jitter", 0.1)
        self.radius, self.dt = take("radius", 0.1), take("dt", 0.1)
        self.max_speed, self.max_acceleration = take("max_speed", 1.0), take("max_acceleration", 2.0)
        self.acceleration_range, self.turn_gain = take("acceleration_range", None), take("turn_gain", None)
        self.observe_direction = take("observe_direction", True)
        self.direction_smoothing = take("direction_smoothing", 0.0)
        self.formation_reward = take("formation_reward", "spring_damper")
        self.formation_weight, self.omega = take("formation_weight", 1.0), take("omega", 0.5)
        self.formation_tolerance = take("formation_tolerance", 0.5)
        self.navigation_reward = take("navigation_reward", "goal_speed")
        self.time_cost = take("time_cost", 0.0)
        self.arrival_bonus, self.goal_radius = take("arrival_bonus", 15.0), take("goal_radius", 0.1)
        self.collision_penalty = take("collision_penalty", 1.5)
        self.proximity_penalty, self.proximity_margin = take("proximity_penalty", 0.0), take("proximity_margin", 0.1)
        self.collision_terminates = take("collision_terminates", False)
        self.arrival_terminates = take("arrival_terminates", True)
        self.hold_steps = take("hold_steps", 10)
        positive = (
            "radius",
            "dt",
            "max_speed",
            "max_acceleration",
            "goal_radius",
            "proximity_margin",
            "start_distance",
            "formation_tolerance",
        )
        for name in positive:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: got {getattr(self, name)}, must be greater than 0")
        if not self.direction_smoothing >= 0:
            raise ValueError(f"direction_smoothing: got {self.direction_smoothing}, must be at least 0 m")
        if self.max_speed * self.dt > self.radius:
            raise ValueError(
                f"max_speed: got {self.max_speed} m/s, at which a robot covers more than its radius ({self.radius} m) "
                f"in a step of {self.dt} s and could pass through another; lower it, or lower dt"
            )
        for name, allowed in (("formation_reward", FORMATION_REWARDS), ("navigation_reward", NAVIGATION_REWARDS)):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name}: got {getattr(self, name)!r}, allowed are {', '.join(allowed)}")
        if corridor_width <= 2 * self.radius:
            raise ValueError(
                f"corridor_width: got {corridor_width} m, too narrow for one robot of radius {self.radius} m; "
                f"it must be greater than {2 * self.radius} m"
            )
        obstacle_map = take("obstacle_map", None)
        if obstacle_map is None:
            obstacle_map = corridor(corridor_width, corridor_length, self.corridor_angle)
        self.obstacle_map = named_map(obstacle_map, batch_dim) if isinstance(obstacle_map, str) else obstacle_map
        check_map(self.obstacle_map, batch_dim, self.radius)
        if kwargs:
            raise TypeError(f"unknown argument(s) of FormationNavigation: {', '.join(sorted(kwargs))}")

    def reset_world_at(self, env_index: int | None = None) -> None:
        """Draw new start and goal formations for one environment, or for all."""
        index = slice(None) if env_index is None else slice(env_index, env_index + 1)
        shape = self.offsets, self.position_jitter, self.heading_jitter
        _, start = starts.draw_formation(self.poses[0][index], self.ahead[0], *shape)
        goal_heading, goal = starts.draw_formation(self.poses[1][index], self.ahead[1], *shape)
        here = self.obstacle_map if env_index is None else map_at(self.obstacle_map, env_index)
        starts.check_places(start, goal, here, self.radius, self.start_distance)
        self.direction[index] = goal_heading
        self.goal[index] = goal
        self.arrived[index] = False
        self.held[index] = 0
        ahead = goal - start
        self.motion.draw(index, torch.atan2(ahead[..., 1], ahead[..., 0]))
        for i, agent in enumerate(self.world.agents):
            agent.set_pos(start[:, i] if env_index is None else start[0, i], batch_index=env_index)
            agent.set_vel(
                torch.zeros_like(agent.state.vel if env_index is None else start[0, i]), batch_index=env_index
            )
        self._quantities = None

    def process_action(self, agent: Agent) -> None:
        """A robot that has arrived holds: its command steers it to its goal."""
        i = self.world.agents.index(agent)
        to_goal = (self.goal[:, i] - agent.state.pos) / (4 * self.dt)
        hold = to_goal.clamp(-self.max_speed, self.max_speed)
        agent.action.u = torch.where(self.arrived[:, i, None], hold, agent.action.u)

    def _positions(self) -> Tensor:
        return torch.stack([agent.state.pos for agent in self.world.agents], 1)

    def _velocities(self) -> Tensor:
        return torch.stack([agent.state.vel for agent in self.world.agents], 1)

    def pre_step(self) -> None:
        """Remember where the robots were, for the progress reward."""
        self.previous_position = self._positions()

    def post_step(self) -> None:
        """Resolve contacts, then measure the step."""
        wall, mate, free = self._settle()
        position, velocity = self._positions(), self._velocities()
        collision = wall | mate
        near_goal = (self.goal - position).norm(dim=-1) < self.goal_radius
        arriving = near_goal & ~self.arrived
        moving = ~self.arrived
        self.arrived = self.arrived | near_goal
        self.held = torch.where(self.arrived.all(-1), self.held + 1, 0)

        if self.navigation_reward == "progress":
            navigation = rewards.progress(self.previous_position, position, self.goal, self.dt)
        else:
            navigation = rewards.goal_speed(position, velocity, self.goal)
        shape = self.offsets, self._travel_direction(position), self.omega, self.formation_tolerance
        bonus = formation_reward(self.formation_reward, self.formation, position, velocity, *shape)
        parts = {
            "navigation_reward": (navigation - self.time_cost) * moving,
            "formation_reward": self.formation_weight * bonus,
            "arrival_reward": self.arrival_bonus * arriving,
            "collision_reward": -self.collision_penalty * collision
            - self.proximity_penalty * rewards.proximity(free, self.proximity_margin),
        }
        terminated = (collision & self.collision_terminates) | (self.arrived & self.arrival_terminates)
        self._quantities = self._measure(position, velocity, parts, wall, mate, terminated)

    def _settle(self) -> tuple[Tensor, Tensor, Tensor]:
        """Move robots out of contact; whether each touched a wall, or a mate, and its free space (m): ``[B, n]``."""
        position, velocity = self._positions(), self._velocities()
        obstacle_distance = self.obstacle_map.signed_distance(position)
        mate_clearance = rewards.mate_clearance(position, self.radius)
        free = torch.minimum(mate_clearance, obstacle_distance - self.radius)
        position, velocity = part_robots(position, velocity, self.radius)
        position, velocity = leave_walls(position, velocity, self.radius, *self.obstacle_map.nearest(position))
        self._place(position, velocity)
        return obstacle_distance < self.radius, mate_clearance < 0, free

    def _place(self, position: Tensor, velocity: Tensor) -> None:
        for i, agent in enumerate(self.world.agents):
            agent.state.pos, agent.state.vel = position[:, i], velocity[:, i]

    def _travel_direction(self, position: Tensor) -> Tensor:
        """Where a formation should head ``[B, 2]``: as at the goal, less what the route still turns until there."""
        if self.obstacle_map.route is None:
            return self.direction
        return turned_along(self.obstacle_map.route, position.mean(-2), self.direction)

    @property
    def quantities(self) -> dict[str, Tensor]:
        """Everything that ``observation``, ``reward`` and ``info`` hand out, for the whole team: ``[B, n, ...]``.

        Measured after each step; after resets when first asked for, as VMAS resets environments one by one.
        """
        if self._quantities is None:
            self._quantities = self._measure(self._positions(), self._velocities())
        return self._quantities

    def _measure(
        self,
        position: Tensor,
        velocity: Tensor,
        parts: dict[str, Tensor] | None = None,
        wall: Tensor | None = None,
        mate: Tensor | None = None,
        terminated: Tensor | None = None,
    ) -> dict[str, Tensor]:
        zero = position.new_zeros(position.shape[:2])
        smoothing = self.direction_smoothing if self.observe_direction else 0.0
        distance, direction = observed_obstacle(self.obstacle_map, position, smoothing)
        observation = [position, velocity, self.goal - position, distance.unsqueeze(-1)]
        if self.observe_direction:
            observation.append(direction)
        names = ("navigation_reward", "formation_reward", "arrival_reward", "collision_reward")
        parts = parts or dict.fromkeys(names, zero)
        wall = zero if wall is None else wall.to(zero.dtype)
        mate = zero if mate is None else mate.to(zero.dtype)
        return {
            "observation": torch.cat(observation, -1),
            "reward": torch.stack(list(parts.values())).sum(0),
            "position": position,
            "velocity": velocity,
            "pairwise_distance": pairwise_distances(position),
            **parts,
            "wall_collision": wall,
            "robot_collision": mate,
            "collision": torch.maximum(wall, mate),
            "arrived": self.arrived.to(zero.dtype),
            "terminated": zero if terminated is None else terminated.to(zero.dtype),
        }

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that the next step depends on, so that a run can be resumed exactly."""
        state = {name: getattr(self, name).clone() for name in ("goal", "direction", "arrived", "held")}
        return {"position": self._positions(), "velocity": self._velocities(), **state, **self.motion.state_dict()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Put the team where :meth:`state_dict` found it."""
        for name in ("goal", "direction", "arrived", "held"):
            getattr(self, name).copy_(state[name])
        for i, agent in enumerate(self.world.agents):
            agent.set_pos(state["position"][:, i], batch_index=None)
            agent.set_vel(state["velocity"][:, i], batch_index=None)
        self.motion.load_state_dict(state)
        self._quantities = None

    def observation(self, agent: Agent) -> Tensor:
        """State of one robot ``[B, 9]`` (or 7)."""
        return self.quantities["observation"][:, self.world.agents.index(agent)]

    def reward(self, agent: Agent) -> Tensor:
        """Reward of one robot ``[B]``."""
        return self.quantities["reward"][:, self.world.agents.index(agent)]

    def info(self, agent: Agent) -> dict[str, Tensor]:
        """What metrics and losses need of one robot, each ``[B, ...]``."""
        i = self.world.agents.index(agent)
        return {k: v[:, i] for k, v in self.quantities.items() if k not in ("observation", "reward")}

    def done(self) -> Tensor:
        """True ``[B]`` once the whole team has held at its goals for ``hold_steps``."""
        return self.held >= self.hold_steps
