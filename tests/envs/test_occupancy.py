import math

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from redig.envs import ObstacleMap, OccupancyMap, load_occupancy_map
from redig.envs.occupancy import distance_to_cells

FINE = 21  # oracle cells to a cell's side

matrices = st.tuples(st.integers(1, 14), st.integers(1, 14), st.integers(0, 10_000), st.floats(0.02, 0.6)).map(
    lambda a: np.random.default_rng(a[2]).uniform(size=a[:2]) < a[3]
)


@given(matrices)
@settings(max_examples=60, deadline=None)
def test_distances_are_scipys_of_a_much_finer_grid(cells):
    found = distance_to_cells(torch.from_numpy(cells)).numpy()
    if not cells.any():
        assert np.isinf(found).all()
        return
    fine = np.kron(cells, np.ones((FINE, FINE), dtype=bool))
    expected = ndimage.distance_transform_edt(~fine)[FINE // 2 :: FINE, FINE // 2 :: FINE] / FINE
    # scipy measures to the centre of the nearest fine cell, which is up to half a diagonal beyond the edge
    assert (found <= expected + 1e-4).all()
    assert (found >= expected - 0.5 * math.sqrt(2) / FINE - 1e-4).all()


def rasterised(obstacle_map, resolution, origin, shape):
    """Cells whose centre lies inside an obstacle."""
    x0, y0, yaw = origin
    y, x = torch.meshgrid(*((torch.arange(n) + 0.5) * resolution for n in shape), indexing="ij")
    cos, sin = math.cos(yaw), math.sin(yaw)
    centres = torch.stack([x0 + cos * x - sin * y, y0 + sin * x + cos * y], -1)
    return obstacle_map.signed_distance(centres) < 0


SHAPES = ObstacleMap(
    torch.tensor([[0.0, 0.0, 1.0, 0.3, 0.4, 0.0], [1.2, 1.6, 0.0, 0.0, 0.0, 0.4]]), gap=1.0, bounds=(-3, -3, 3, 3)
)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_a_rasterised_map_has_its_distances_and_directions(yaw):
    middle = torch.tensor([4.0, 4.0])
    turn = torch.tensor([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    origin = (*(-middle @ turn).tolist(), yaw)
    grid = OccupancyMap(rasterised(SHAPES, 0.05, origin, (160, 160)), 0.05, origin, gap=1.0)
    points = 4 * torch.rand(400, 2, generator=torch.Generator().manual_seed(0)) - 2
    expected, direction = SHAPES.nearest(points)
    found, pointing = grid.nearest(points)
    outside = (expected > 0.1) & (expected < 1.5)
    assert (found - expected)[outside].abs().max() < 0.06
    agreement = (pointing * direction).sum(-1)[outside]
    assert agreement.median() > 0.99
    assert (agreement > 0.9).float().mean() > 0.95  # not where another obstacle is almost as near
    torch.testing.assert_close(pointing.norm(dim=-1), torch.ones(400))
    assert (found[expected < -0.08] < 0).all()


@given(matrices, st.floats(-math.pi, math.pi), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_the_field_against_single_cells(cells, yaw, seed):
    """Against the distance to every occupied square, one by one: the bounds of the docstring."""
    resolution, origin = 0.5, (0.3, -1.0, yaw)
    grid = OccupancyMap(torch.from_numpy(cells), resolution, origin, gap=1.0)
    height, width = cells.shape
    local = torch.from_numpy(np.random.default_rng(seed).uniform((0, 0), (width, height), (40, 2))).float()
    cos, sin = math.cos(yaw), math.sin(yaw)
    world = torch.tensor(origin[:2]) + resolution * local @ torch.tensor([[cos, sin], [-sin, cos]])
    ringed = np.pad(cells, 1, constant_values=True)
    rows, columns = np.nonzero(ringed)
    squares = torch.tensor(np.stack([columns - 0.5, rows - 0.5], -1), dtype=torch.float32)  # their centres
    excess = (local[:, None] - squares).abs() - 0.5
    expected = excess.clamp_min(0).norm(dim=-1).amin(-1) * resolution
    error = (grid.signed_distance(world) - expected) / resolution
    assert (error <= 0.31).all()
    assert (error[expected > 0] >= -0.6).all()


@pytest.mark.parametrize("yaw", [0.0, 1.0])
def test_direction_is_minus_the_gradient(yaw):
    cells = torch.from_numpy(np.random.default_rng(3).uniform(size=(20, 30)) < 0.1)
    grid = OccupancyMap(cells, 0.2, (-1.0, 0.5, yaw), gap=1.0)
    turn = torch.tensor([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]], dtype=torch.float64)
    point = torch.from_numpy(np.random.default_rng(4).uniform((0, 0), (6, 4), (200, 2))) @ turn
    point = point + torch.tensor([-1.0, 0.5], dtype=torch.float64)
    _, direction = grid.nearest(point)
    step, slopes = 1e-6, []
    for shift in torch.eye(2, dtype=torch.float64) * step:
        slopes.append((grid.signed_distance(point + shift) - grid.signed_distance(point - shift)) / (2 * step))
    gradient = torch.stack(slopes, -1)
    steep = gradient.norm(dim=-1) > 0.1
    assert steep.float().mean() > 0.9
    expected = -gradient / gradient.norm(dim=-1, keepdim=True)
    close = ((direction - expected).abs().amax(-1) < 1e-3)[steep]
    assert close.float().mean() > 0.97  # not on the lines between cells, where the slope changes


def test_gradients_are_finite_and_minus_the_direction():
    """Inside the grid and beyond it, and half way between walls, where the distance is flat."""
    grid = OccupancyMap(torch.zeros(6, 20, dtype=torch.bool), 0.1, (0.0, 0.0, 0.0), gap=0.6)
    point = torch.tensor([[1.0, 0.1], [1.0, 0.45], [1.0, 0.3], [1.0, 0.9]], requires_grad=True)
    distance, direction = grid.nearest(point)
    (slope,) = torch.autograd.grad(distance.sum(), point, retain_graph=True)
    torch.testing.assert_close(slope[[0, 1, 3]], -direction[[0, 1, 3]].detach())
    torch.testing.assert_close(slope[2], torch.zeros(2))
    (turning,) = torch.autograd.grad(direction.sum(), point)
    torch.testing.assert_close(turning, torch.zeros(4, 2))  # straight walls


def test_beyond_the_grid_is_wall():
    grid = OccupancyMap(torch.zeros(10, 20, dtype=torch.bool), 0.1, (0.0, 0.0, 0.0), gap=1.0)
    distance, direction = grid.nearest(torch.tensor([[1.0, -2.0], [5.0, 0.5], [1.0, 0.2]]))
    torch.testing.assert_close(distance, torch.tensor([-2.0, -3.0, 0.2]), atol=0.051, rtol=0)
    expected = torch.tensor([[0.0, -1.0], [1.0, 0.0], [0.0, -1.0]])  # beyond, away from the way back
    torch.testing.assert_close(direction, expected)
    assert grid.bounds == pytest.approx((0.0, 0.0, 2.0, 1.0))


PIXELS = np.array([[0, 254, 205], [254, 254, 0]], dtype=np.uint8)  # black is occupied, 205 unknown; top row first


def write_map(folder, image="map.pgm", **changes):
    keys = {"image": image, "resolution": 0.5, "origin": [-1.0, 2.0, 0.0], "negate": 0, "occupied_thresh": 0.65}
    keys |= {"free_thresh": 0.196, "gap": 0.4, **changes}
    lines = [f"{key}: {value}" for key, value in keys.items() if value is not None]
    (folder / "map.yaml").write_text("# saved by a map server\n" + "\n".join(lines) + "\n")
    return folder / "map.yaml"


def write_image(folder, kind):
    size = f"{PIXELS.shape[1]} {PIXELS.shape[0]}"
    if kind == "P5":
        (folder / "map.pgm").write_bytes(f"P5\n# CREATOR: map_saver\n{size}\n255\n".encode() + PIXELS.tobytes())
    elif kind == "P2":
        text = " ".join(map(str, PIXELS.flatten()))
        (folder / "map.pgm").write_text(f"P2\n# by hand\n{size}\n255\n{text}\n")
    elif kind == "P5, 16 bit":
        wide = (PIXELS.astype(np.uint16) * 257).astype(">u2")
        (folder / "map.pgm").write_bytes(f"P5\n{size}\n65535\n".encode() + wide.tobytes())
    elif kind == "png":
        imageio.imwrite(folder / "map.png", PIXELS)
    else:
        imageio.imwrite(folder / "map.png", np.stack([PIXELS] * 3, -1))
    return "map.png" if "png" in kind else "map.pgm"


@pytest.mark.parametrize("kind", ["P5", "P2", "P5, 16 bit", "png", "png, colours"])
def test_files_of_map_servers_are_read(tmp_path, kind):
    path = write_map(tmp_path, write_image(tmp_path, kind), route="[[-0.9, 2.25], [0.4, 2.25]]")
    grid = load_occupancy_map(path)
    assert grid.occupied.tolist() == [[False, False, True], [True, False, True]]  # bottom row first
    assert (grid.resolution, grid.origin, grid.gap) == (0.5, (-1.0, 2.0, 0.0), 0.4)
    torch.testing.assert_close(grid.route, torch.tensor([[-0.9, 2.25], [0.4, 2.25]]))
    assert grid.signed_distance(torch.tensor([[-0.25, 2.75], [-0.75, 2.75]])).tolist() == [0.25, -0.25]


def test_unknown_cells_negation_and_what_replaces_the_file(tmp_path):
    path = write_map(tmp_path, write_image(tmp_path, "P5"))
    free = load_occupancy_map(path, unknown_is_free=True, gap=0.9, route=[[0, 2.25], [0.4, 2.25]])
    assert free.occupied.tolist() == [[False, False, True], [True, False, False]]
    assert free.gap == 0.9 and free.route.tolist()[0] == [0.0, 2.25]
    negative = load_occupancy_map(write_map(tmp_path, negate=1))
    assert negative.occupied.tolist() == [[True, True, False], [False, True, True]]


def test_an_image_alone(tmp_path):
    write_image(tmp_path, "png")
    grid = load_occupancy_map(tmp_path / "map.png", resolution=0.1, gap=0.2, origin=(1.0, 0.0, math.pi / 2))
    assert grid.bounds == pytest.approx((0.8, 0.0, 1.0, 0.3))
    with pytest.raises(ValueError, match="resolution: got None, but map.png is an image alone"):
        load_occupancy_map(tmp_path / "map.png", gap=0.2)
    with pytest.raises(ValueError, match=r"gap: got None, and map.png does not say it"):
        load_occupancy_map(tmp_path / "map.png", resolution=0.1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"resolution": None}, "lacks resolution"),
        ({"free_thresh": None, "negate": None}, "lacks negate, free_thresh"),
        ({"mode": "scale"}, "mode: got 'scale' .* only trinary"),
        ({"resolution": "fine"}, "resolution: got 'fine' .* must be a number"),
        ({"resolution": -0.1}, "resolution: got -0.1, must be greater than 0 m"),
        ({"origin": 3}, r"origin: got 3 .* must be \[x, y, yaw\]"),
        ({"origin": [0.0, 1.0]}, r"origin: got \(0.0, 1.0\), must be x, y"),
        ({"free_thresh": 0.7}, "free_thresh: got 0.7 .* from 0 to occupied_thresh"),
        ({"gap": None}, "gap: got None, and map.yaml does not say it"),
        ({"gap": 0}, "gap: got 0, must be greater than 0 m"),
        ({"route": "[[0, 0]]"}, "route: got shape"),
    ],
)
def test_bad_files_are_named(tmp_path, changes, message):
    path = write_map(tmp_path, write_image(tmp_path, "P5"), **changes)
    with pytest.raises(ValueError, match=message):
        load_occupancy_map(path)


def test_missing_and_damaged_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="path: no such file"):
        load_occupancy_map(tmp_path / "none.yaml")
    path = write_map(tmp_path)
    with pytest.raises(FileNotFoundError, match="image: no such file"):
        load_occupancy_map(path)
    (tmp_path / "map.pgm").write_bytes(b"P5\n3 2\n")
    with pytest.raises(ValueError, match="image: .* cannot be read"):
        load_occupancy_map(path)
    for text in ("just text", "[1, 2", "a: !!python/object/apply:os.getcwd []"):
        (tmp_path / "map.yaml").write_text(text)
        with pytest.raises(ValueError, match="path: .*(lacks|not a YAML file)"):
            load_occupancy_map(path)
    with pytest.raises(ValueError, match="occupied: got torch.float32"):
        OccupancyMap(torch.zeros(3, 3), 0.1, (0.0, 0.0, 0.0), gap=1.0)
