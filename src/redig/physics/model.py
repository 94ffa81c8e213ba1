"""Robots, walls and ground as a MuJoCo model (MJCF): differential-drive robots in any :class:`~redig.envs.ObstacleMap`.

The model is text, so it opens in MuJoCo's own viewer and in anything else that reads MJCF.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from redig.envs.maps import ObstacleMap

COLOURS = ("0 .45 .7", ".84 .37 0", "0 .62 .45", ".8 .47 .65", ".9 .62 0", ".34 .71 .91")
WALL_HEIGHT = 0.25  # m


@dataclass(frozen=True)
class RobotBody:
    """A round robot on two driven wheels, with a sprung caster before and behind them.

    Args:
        radius: of the footprint (m); the wheels lie within it.
        mass: of the whole robot (kg).
        wheel_radius: (m).
        track: distance between the wheels (m).
        torque: limit of each wheel's motor (N m).
        gain: torque a wheel's motor gives for each rad/s that the wheel is too slow (N m s/rad).

    Raises:
        ValueError: for a size that is not positive, or wheels that reach beyond the footprint.

    Examples:
        >>> body = RobotBody()
        >>> round(body.torque / body.wheel_radius * 2 / body.mass, 1)  # m/s², more than the 2 that policies learn with
        5.0
    """

    radius: float = 0.1
    mass: float = 2.0
    wheel_radius: float = 0.04
    track: float = 0.15
    torque: float = 0.2
    gain: float = 0.1

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name}: got {value}, must be greater than 0")
        if math.hypot(self.track / 2 + WHEEL_HALF_WIDTH, self.wheel_radius) > self.radius:
            raise ValueError(f"track: got {self.track} m, at which wheels reach beyond the radius of {self.radius} m")


WHEEL_HALF_WIDTH = 0.008  # m


@dataclass(frozen=True)
class Ground:
    """What the wheels stand on: flat and of good grip by default.

    Args:
        friction: coefficient of wheels on the ground; 0.2 and less is slippery.
        ridge_height: of a ridge across the map's centre (m); 0: flat.
        ridge_length: of each of its two slopes (m).
        ridge_angle: direction in which it is climbed (rad); 0: along x.

    Raises:
        ValueError: for a value out of range.

    Examples:
        >>> ridge = Ground(ridge_height=0.1)
        >>> round(math.degrees(math.atan(ridge.ridge_height / ridge.ridge_length)), 1)  # degrees
        5.7
    """

    friction: float = 1.0
    ridge_height: float = 0.0
    ridge_length: float = 1.0
    ridge_angle: float = 0.0

    def __post_init__(self) -> None:
        for name in ("friction", "ridge_length"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: got {getattr(self, name)}, must be greater than 0")
        if self.ridge_height < 0:
            raise ValueError(f"ridge_height: got {self.ridge_height} m, must not be negative")


def team_model(
    obstacle_map: ObstacleMap,
    n_robots: int,
    body: RobotBody | None = None,
    ground: Ground | None = None,
    timestep: float = 0.005,
) -> str:
    """The MJCF of a team in a map: bodies ``robot_i``, each with a free joint and two wheels, and walls ``wall_j``.

    Wheels and casters have contact priority, so that their own friction counts and not the larger one of the ground,
    which would make casters drag.

    Args:
        obstacle_map: rounded boxes become boxes and round corners, all of them vertical.
        n_robots: at least 1.
        body: of each robot.
        ground: below them.
        timestep: of the simulation (s).

    Raises:
        ValueError: for ``n_robots`` below 1 or a ``timestep`` that is not positive.

    Examples:
        >>> from redig.envs import corridor
        >>> team_model(corridor(), n_robots=5).count("<freejoint")
        5
    """
    if n_robots < 1:
        raise ValueError(f"n_robots: got {n_robots}, must be at least 1")
    if not timestep > 0:
        raise ValueError(f"timestep: got {timestep} s, must be greater than 0")
    body, ground = body or RobotBody(), ground or Ground()
    walls = [geom for wall in obstacle_map.obstacles.tolist() for geom in _wall(*wall)]
    named = "".join(f'\n    <geom name="wall_{j}" class="wall" {geom}/>' for j, geom in enumerate(walls))
    robots = "".join(_robot(i, body) for i in range(n_robots))
    wheels = [f"robot_{i}_{side}" for i in range(n_robots) for side in ("left", "right")]
    motors = "".join(f'\n    <velocity name="{wheel}" joint="{wheel}" class="wheel"/>' for wheel in wheels)
    ridge_mesh, ridge = _ridge(ground) if ground.ridge_height > 0 else ("", "")
    return f"""<mujoco model="team">
  <option timestep="{timestep}" integrator="implicitfast"/>
  <visual><global offwidth="1280" offheight="960"/><map znear="0.01"/>
    <headlight ambient=".45 .45 .45" diffuse=".25 .25 .25" specular="0 0 0"/></visual>
  <default>
    <default class="wall"><geom contype="2" conaffinity="0" friction="0.3" rgba=".55 .57 .6 1"/></default>
    <default class="ground"><geom contype="1" conaffinity="0" rgba=".93 .93 .9 1"/></default>
    <default class="chassis"><geom contype="2" conaffinity="3" friction="0.3"/></default>
    <default class="wheel">
      <geom contype="0" conaffinity="1" priority="1" solref=".01 1" condim="3" friction="{ground.friction}"
            rgba=".2 .2 .2 1"/>
      <velocity kv="{body.gain}" forcerange="-{body.torque} {body.torque}"/>
    </default>
    <default class="caster">
      <geom contype="0" conaffinity="1" priority="1" solref=".01 1" condim="1" rgba=".4 .4 .4 1"/>
      <joint type="slide" axis="0 0 1" range="-.012 .012" stiffness="{50 * body.mass * GRAVITY:.6g}"
             springref="{-CASTER_SHARE / 50:.6g}" damping="{0.5 * body.mass:.6g}"/>
    </default>
  </default>
  <asset>{ridge_mesh}</asset>
  <worldbody>
    <light directional="true" pos="-3 -3 8" dir=".4 .5 -1" diffuse=".4 .4 .4" specular="0 0 0"/>
    <geom name="ground" class="ground" type="plane" size="0 0 1"/>{ridge}{named}{robots}
  </worldbody>
  <actuator>{motors}
  </actuator>
</mujoco>
"""


GRAVITY = 9.81  # m/s²
CASTER_SHARE = 0.15  # of the weight, on each of the two casters


def _wall(x: float, y: float, half_x: float, half_y: float, heading: float, radius: float) -> list[str]:
    """A rounded box as a cross of two boxes and a cylinder at each corner, less what has no volume."""
    half_height = WALL_HEIGHT / 2
    boxes = {(half_x + radius, half_y), (half_x, half_y + radius)}
    cos, sin = math.cos(heading), math.sin(heading)
    geoms = [
        f'type="box" pos="{x:.9g} {y:.9g} {half_height}" euler="0 0 {math.degrees(heading):.9g}" '
        f'size="{a:.9g} {b:.9g} {half_height}"'
        for a, b in sorted(boxes)
        if a > 0 and b > 0
    ]
    corners = {(sx * half_x, sy * half_y) for sx in (-1, 1) for sy in (-1, 1)} if radius > 0 else set()
    geoms += [
        f'type="cylinder" pos="{x + cos * a - sin * b:.9g} {y + sin * a + cos * b:.9g} {half_height}" '
        f'size="{radius:.9g} {half_height}"'
        for a, b in sorted(corners)
    ]
    return geoms


def _robot(i: int, body: RobotBody) -> str:
    """One robot: its origin is on the ground, between the wheels, x forward."""
    wheel, caster, height = body.wheel_radius, body.radius / 8, body.radius * 0.8
    wheel_mass, caster_mass = 0.05 * body.mass, 0.01 * body.mass
    chassis_mass = body.mass - 2 * (wheel_mass + caster_mass)
    floor = caster * 1.6  # clearance of the chassis
    middle, reach = (floor + height) / 2, body.radius - caster
    wheels = "".join(
        f"""
      <body name="robot_{i}_{side}" pos="0 {sign * body.track / 2} {wheel}">
        <joint name="robot_{i}_{side}" axis="0 1 0" armature="1e-5"/>
        <geom class="wheel" type="ellipsoid" size="{wheel} {WHEEL_HALF_WIDTH} {wheel}" mass="{wheel_mass}"/>
      </body>"""
        for side, sign in (("left", 1), ("right", -1))
    )
    casters = "".join(
        f"""
      <body pos="{sign * reach} 0 {caster}"><joint class="caster"/>
        <geom class="caster" type="sphere" size="{caster}" mass="{caster_mass}"/></body>"""
        for sign in (1, -1)
    )
    return f"""
    <body name="robot_{i}"><freejoint name="robot_{i}"/>
      <geom name="chassis_{i}" class="chassis" type="cylinder" pos="0 0 {middle}" mass="{chassis_mass}"
            size="{body.radius} {(height - floor) / 2}" rgba="{COLOURS[i % len(COLOURS)]} 1"/>
      <geom type="box" pos="{body.radius / 2} 0 {height}" size="{body.radius / 2} .008 .004" rgba="1 1 1 1" mass="0"
            contype="0" conaffinity="0"/>{wheels}{casters}
    </body>"""


def _ridge(ground: Ground) -> tuple[str, str]:
    """A ridge across the map as a prism: its mesh, and the geom that uses it."""
    length, height, breadth, depth = ground.ridge_length, ground.ridge_height, 10.0, 0.1
    profile = [(-length, 0), (0, height), (length, 0), (length, -depth), (-length, -depth)]
    vertices = "  ".join(f"{x} {y} {z}" for x, z in profile for y in (-breadth, breadth))
    angle = math.degrees(ground.ridge_angle)
    return (
        f'<mesh name="ridge" vertex="{vertices}"/>',
        f'\n    <geom name="ridge" class="ground" type="mesh" mesh="ridge" euler="0 0 {angle}"/>',
    )
