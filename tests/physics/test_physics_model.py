import math

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.envs import ObstacleMap, corridor
from redig.physics import Ground, RobotBody, team_model


def compiled(*args, **kwargs):
    model = mujoco.MjModel.from_xml_string(team_model(*args, **kwargs))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


size = st.floats(0.05, 1.0)
box = st.tuples(
    *[st.floats(-2, 2)] * 2, st.just(0.0) | size, st.just(0.0) | size, st.floats(-3, 3), st.just(0.0) | size
)


@settings(max_examples=25, deadline=None)
@given(
    boxes=st.lists(box.filter(lambda b: b[5] > 0 or min(b[2:4]) > 0), min_size=1, max_size=3), seed=st.integers(0, 99)
)
def test_walls_are_where_the_signed_distance_says(boxes, seed):
    obstacle_map = ObstacleMap(torch.tensor(boxes), gap=1.0, bounds=(-3, -3, 3, 3))
    model, data = compiled(obstacle_map, 1)
    chassis = model.geom("chassis_0").id
    walls = [g for g in range(model.ngeom) if model.geom(g).name.startswith("wall_")]
    for point in np.random.default_rng(seed).uniform(-4, 4, (10, 2)):
        expected = obstacle_map.signed_distance(torch.tensor(point, dtype=torch.float32)).item() - 0.1
        if expected > 0.01:  # MuJoCo's distance of shapes that overlap is another one
            data.qpos[:2] = point
            mujoco.mj_forward(model, data)
            found = min(mujoco.mj_geomDistance(model, data, chassis, wall, 20.0, None) for wall in walls)
            assert found == pytest.approx(expected, abs=2e-3)


def test_robots_weigh_what_they_should_and_stay_within_their_radius():
    body = RobotBody(mass=3.0)
    model, data = compiled(corridor(), 2, body)
    for i in range(2):
        assert model.body_subtreemass[model.body(f"robot_{i}").id] == pytest.approx(3.0)
    for g in range(model.ngeom):
        if model.body_rootid[model.geom_bodyid[g]] == model.body("robot_0").id:
            x, y, _ = data.geom_xpos[g]
            half_x, half_y, _ = np.abs(data.geom_xmat[g].reshape(3, 3)) @ model.geom_aabb[g, 3:]
            is_round = model.geom(g).name == "chassis_0"
            reach = half_x if is_round else math.hypot(abs(x) + half_x, abs(y) + half_y)
            assert reach <= body.radius + 0.001  # the box around a caster has corners


def test_friction_of_wheels_is_their_own():
    model, _ = compiled(corridor(), 1, ground=Ground(friction=0.2))
    driven = [g for g in range(model.ngeom) if model.geom_priority[g] == 1]
    assert len(driven) == 4  # two wheels and two casters
    assert model.geom_friction[driven, 0].tolist().count(0.2) == 2


def test_the_ridge_is_as_high_and_steep_as_asked_and_turns_with_its_angle():
    ground = Ground(ridge_height=0.2, ridge_length=0.5, ridge_angle=math.pi / 2)
    model, data = compiled(corridor(), 1, ground=ground)

    def height(x, y):
        hit = np.zeros(1, np.int32)
        down = mujoco.mj_ray(model, data, [x, y, 5.0], [0, 0, -1], None, 1, model.body("robot_0").id, hit)
        return 5.0 - down

    assert height(1.5, 0.0) == pytest.approx(0.2, abs=1e-3)
    assert height(1.5, 0.25) == pytest.approx(0.1, abs=1e-3)
    assert height(1.5, -0.6) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: RobotBody(mass=0.0), "mass: got 0.0"),
        (lambda: RobotBody(track=0.2), "track: got 0.2"),
        (lambda: Ground(friction=-1.0), "friction: got -1.0"),
        (lambda: Ground(ridge_height=-0.1), "ridge_height: got -0.1"),
        (lambda: team_model(corridor(), 0), "n_robots: got 0"),
        (lambda: team_model(corridor(), 1, timestep=0.0), "timestep: got 0.0"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
