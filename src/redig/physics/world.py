"""A team of differential-drive robots in MuJoCo: commands in, motion and contacts out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

try:
    import mujoco
except ImportError as error:
    raise ImportError("redig.physics needs MuJoCo: pip install 'redig[mujoco]'") from error

from redig.envs.maps import ObstacleMap
from redig.physics.model import Ground, RobotBody, team_model


class PhysicsWorld:
    """Robots with wheels, inertia, friction and contacts; all quantities are of the whole team, in the map's frame.

    Args:
        obstacle_map: the walls.
        n_robots: in the team.
        body: of each robot.
        ground: below them.
        timestep: of the physics (s).

    Raises:
        ValueError: as :func:`~redig.physics.model.team_model`.

    Examples:
        >>> from redig.envs import corridor
        >>> world = PhysicsWorld(corridor(), n_robots=2)
        >>> world.reset([[-2.5, 0.0], [-2.0, 0.0]], heading=[0.0, 0.0])
        >>> for _ in range(10):
        ...     world.step([[0.5, 0.0], [0.5, 1.0]])  # forward (m/s) and turning (rad/s), for 0.1 s
        >>> bool(world.position[0, 0] > -2.1), bool(world.heading[1] > 0.8), world.wall_contact.any()
        (True, True, np.False_)
    """

    def __init__(
        self,
        obstacle_map: ObstacleMap,
        n_robots: int,
        body: RobotBody | None = None,
        ground: Ground | None = None,
        timestep: float = 0.005,
    ) -> None:
        self.body = body or RobotBody()
        self.n_robots, self.timestep = n_robots, timestep
        self.model = mujoco.MjModel.from_xml_string(team_model(obstacle_map, n_robots, self.body, ground, timestep))
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(f"robot_{i}") for i in range(n_robots)]
        self._pose = np.array([joint.qposadr[0] for joint in joints])
        self._twist = np.array([joint.dofadr[0] for joint in joints])
        names = [self.model.geom(g).name for g in range(self.model.ngeom)]
        self._is_wall = np.array([name.startswith("wall_") for name in names])
        self._robot_of = np.full(self.model.ngeom, -1)  # only the chassis of a robot may touch walls and teammates
        for i in range(n_robots):
            self._robot_of[self.model.geom(f"chassis_{i}").id] = i
        self.wall_contact = np.zeros(n_robots, bool)
        self.robot_contact = np.zeros(n_robots, bool)
        mujoco.mj_forward(self.model, self.data)

    def reset(self, position: ArrayLike, heading: ArrayLike) -> None:
        """Put the robots at ``position`` ``[n, 2]`` (m) with ``heading`` ``[n]`` (rad), at rest.

        Raises:
            ValueError: for a wrong shape or a number that is not finite.
        """
        place, angle = self._checked("position", position, 2), self._checked("heading", heading)
        mujoco.mj_resetData(self.model, self.data)
        for i, start in enumerate(self._pose):
            half = angle[i] / 2
            self.data.qpos[start : start + 7] = [*place[i], 0.0, np.cos(half), 0.0, 0.0, np.sin(half)]
        self.wall_contact[:] = self.robot_contact[:] = False
        mujoco.mj_forward(self.model, self.data)

    def step(self, command: ArrayLike, duration: float = 0.1) -> None:
        """Drive for ``duration`` (s) with a linear (m/s) and an angular velocity (rad/s) a robot, ``[n, 2]``.

        Raises:
            ValueError: for a wrong shape, a number that is not finite, or a duration of less than a time step.
        """
        forward, turn = self._checked("command", command, 2).T
        apart = turn * self.body.track / 2
        self.step_wheels(np.stack([forward - apart, forward + apart], -1) / self.body.wheel_radius, duration)

    def step_wheels(self, speed: ArrayLike, duration: float = 0.1) -> None:
        """Drive for ``duration`` (s) with the speeds (rad/s) of left and right wheels, ``[n, 2]``.

        Contact flags then tell what was touched at any time within ``duration``.

        Raises:
            ValueError: as :meth:`step`.
        """
        self.data.ctrl[:] = self._checked("speed", speed, 2).ravel()
        steps = round(duration / self.timestep)
        if steps < 1:
            raise ValueError(f"duration: got {duration} s, must be at least a time step of {self.timestep} s")
        self.wall_contact[:] = self.robot_contact[:] = False
        for _ in range(steps):
            mujoco.mj_step(self.model, self.data)
            self._note_contacts()

    def _note_contacts(self) -> None:
        touching = self.data.contact.dist < 0
        first, second = self.data.contact.geom[touching].T
        for one, other in ((first, second), (second, first)):
            robot = self._robot_of[one]
            self.wall_contact[robot[(robot >= 0) & self._is_wall[other]]] = True
            self.robot_contact[robot[(robot >= 0) & (self._robot_of[other] >= 0)]] = True

    @property
    def time(self) -> float:
        """Since the reset (s)."""
        return self.data.time

    @property
    def position(self) -> NDArray[np.float64]:
        """Of the points on the ground between the wheels, ``[n, 2]`` (m)."""
        return self.data.qpos[self._pose[:, None] + np.arange(2)]

    @property
    def height(self) -> NDArray[np.float64]:
        """Of the same points, ``[n]`` (m)."""
        return self.data.qpos[self._pose + 2]

    @property
    def velocity(self) -> NDArray[np.float64]:
        """``[n, 2]`` (m/s)."""
        return self.data.qvel[self._twist[:, None] + np.arange(2)]

    @property
    def heading(self) -> NDArray[np.float64]:
        """``[n]`` (rad), in (-pi, pi]."""
        w, x, y, z = self.data.qpos[self._pose[:, None] + np.arange(3, 7)].T
        return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    @property
    def yaw_rate(self) -> NDArray[np.float64]:
        """``[n]`` (rad/s), about the robot's own vertical axis."""
        return self.data.qvel[self._twist + 5]

    @property
    def wheel_speed(self) -> NDArray[np.float64]:
        """Of left and right wheels, ``[n, 2]`` (rad/s)."""
        return self.data.actuator_velocity.reshape(-1, 2).copy()

    def renderer(self, width: int = 960, height: int = 480) -> Any:
        """MuJoCo's renderer for this world; without a display set ``MUJOCO_GL=egl`` before the first import."""
        return mujoco.Renderer(self.model, height, width)

    def _checked(self, name: str, value: ArrayLike, width: int | None = None) -> NDArray[np.float64]:
        shape = (self.n_robots,) if width is None else (self.n_robots, width)
        array = np.asarray(value, np.float64)
        if array.shape != shape:
            raise ValueError(f"{name}: got shape {list(array.shape)}, expected {list(shape)}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: got {array.tolist()}, all numbers must be finite")
        return array
