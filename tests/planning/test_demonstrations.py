from dataclasses import replace

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import StepCounter, TransformedEnv, VmasEnv
from vmas.simulator.environment.environment import Environment

from redig.envs import MAP_KINDS, FormationNavigation, MapBatch, OccupancyMap, corridor, doorway, load_occupancy_map
from redig.evaluation import evaluate
from redig.planning import demonstrations, occupancy_grid
from redig.viz import plot_trajectories

KEYS = ([("agents", "observation")], [("agents", "action")])


def make_env(num_envs: int = 3, steps: int | None = None, **kwargs):
    env = VmasEnv(FormationNavigation(), num_envs=num_envs, **{"formation": "line", "n_robots": 3, **kwargs})
    return env if steps is None else TransformedEnv(env, StepCounter(steps))


def equal(first, second) -> bool:
    return first.shape == second.shape and bool((first == second).all())


@pytest.fixture(scope="module")
def data():
    return demonstrations(make_env(steps=200), num_trajectories=13, speed=(0.5, 1.0), seed=1)


def test_shapes_and_keys(data):
    assert data.shape[0] == 5  # 13 trajectories are five teams of three, from two batches of three environments
    assert data.shape[1] <= 200
    assert data["agents", "observation"].shape == (*data.shape, 3, 9)
    assert data["agents", "action"].shape == (*data.shape, 3, 2)
    assert data["next", "agents", "reward"].shape == (*data.shape, 3, 1)
    assert set(data["next", "agents", "info"].keys()) == {"collision", "arrived", "terminated"}
    assert {"done", "terminated", "truncated"} <= set(data["next"].keys())
    assert data["mask"].dtype == torch.bool and data["mask"].shape == data.shape


def test_mask_ends_with_the_first_done(data):
    for episode in data.unbind(0):
        done = episode["next", "done"].squeeze(-1).tolist()
        end = done.index(True) if True in done else len(done) - 1
        assert episode["mask"].tolist() == [step <= end for step in range(len(done))]
    ends = data["mask"].sum(-1)
    assert len(set(ends.tolist())) > 1 and ends.max() == data.shape[1]


def test_transitions_follow_each_other_and_the_command_moves_the_robot(data):
    both = data["mask"][:, 1:]
    then, now = data["next", "agents", "observation"][:, :-1], data["agents", "observation"][:, 1:]
    assert torch.equal(then[both], now[both])
    position, velocity = then[..., :2], then[..., 2:4]
    before = data["agents", "observation"][:, :-1, :, :2]
    undisturbed = both & ~(data["next", "agents", "info", "collision"][:, :-1].squeeze(-1) > 0).any(-1)
    assert torch.allclose((before + 0.1 * velocity)[undisturbed], position[undisturbed], atol=1e-5)


def test_robots_reach_their_goals_along_free_cells(data):
    arrived = (data["next", "agents", "info", "arrived"].squeeze(-1) * data["mask"].unsqueeze(-1)).amax(1)
    assert arrived.all()
    inflated = occupancy_grid(make_env().scenario.obstacle_map, inflation=0.1)
    for place in data["agents", "observation"][data["mask"]][..., :2].flatten(0, 1).tolist():
        assert inflated.is_free(place)


def test_speeds_differ_between_robots_and_stay_in_their_range(data):
    speed = data["agents", "observation"][..., 2:4].norm(dim=-1)
    speed = speed.masked_fill(~data["mask"].unsqueeze(-1), 0).flatten(0, 1).unflatten(0, data.shape)
    middle = speed[:, 20:40].median(1).values
    assert middle.min() > 0.4 and middle.max() < 1.05
    assert middle.max() - middle.min() > 0.2


def test_noise_has_the_given_size():
    quiet, noisy = (demonstrations(make_env(8), 24, noise=noise, max_steps=2) for noise in (0.0, 0.05))
    difference = noisy["agents", "action"][:, 0] - quiet["agents", "action"][:, 0]
    away_from_limit = (quiet["agents", "action"][:, 0].abs() < 0.8) & (difference != 0)
    assert difference[away_from_limit].std().item() == pytest.approx(0.05, rel=0.5)
    assert noisy["agents", "action"].abs().max() <= 1.0


def test_same_seed_same_demonstrations_whatever_the_callers_random_state():
    settings = {"num_trajectories": 6, "max_steps": 15, "planner": "rrt"}
    torch.manual_seed(3)
    first = demonstrations(make_env(2), seed=4, **settings)
    torch.manual_seed(5)
    env = make_env(2, seed=9)
    env.rollout(3)
    assert equal(first, demonstrations(env, seed=4, **settings))
    assert not equal(first, demonstrations(env, seed=5, **settings))


def test_random_states_of_the_caller_are_left_untouched():
    env = make_env(2)
    torch.manual_seed(0)
    env.set_seed(0)
    expected = torch.rand(3), env.reset()["agents", "observation"]
    torch.manual_seed(0)
    env.set_seed(0)
    state = Environment.vmas_random_state
    demonstrations(env, 6, max_steps=5, seed=8)
    assert Environment.vmas_random_state is state
    assert torch.equal(torch.rand(3), expected[0])
    assert torch.equal(env.reset()["agents", "observation"], expected[1])


def test_second_call_reads_the_file(tmp_path, monkeypatch):
    first = demonstrations(make_env(2, steps=9), 6, cache_dir=tmp_path / "new")
    (file,) = (tmp_path / "new").iterdir()
    assert file.name.startswith("demonstrations-") and file.suffix == ".pt"
    monkeypatch.setattr("redig.planning.tracking.PathTracker.__call__", None)  # nothing may be made again
    again = demonstrations(make_env(2, steps=9), 6, cache_dir=tmp_path / "new")
    assert equal(first, again)
    assert again.batch_size == first.batch_size
    assert again["next", "agents"].batch_size == first["next", "agents"].batch_size


@pytest.mark.parametrize(
    ("env", "settings"),
    [
        ({}, {"seed": 1}),
        ({}, {"num_trajectories": 9}),
        ({}, {"planner": "rrt"}),
        ({}, {"speed": (0.6, 1.0)}),
        ({}, {"noise": 0.1}),
        ({}, {"max_steps": 4}),
        ({"steps": 4}, {}),
        ({"num_envs": 3}, {}),
        ({"formation": "wedge"}, {}),
        ({"collision_penalty": 2.0}, {}),
        ({"turn_gain": (2.0, 8.0)}, {}),
        ({"turn_gain": [2.0, 8.0]}, {}),
        ({"corridor_width": 1.0}, {}),
        ({"obstacle_map": doorway(gap=1.1)}, {}),
        ({"obstacle_map": replace(corridor(), route=torch.tensor([[-2.7, 0.0], [2.7, 0.0]]))}, {}),
        ({"obstacle_map": MapBatch((corridor(), corridor()))}, {}),
    ],
)
def test_any_other_setting_makes_another_file(tmp_path, env, settings):
    usual = {"num_trajectories": 6, "max_steps": 3}
    demonstrations(make_env(2), **usual, cache_dir=tmp_path)
    demonstrations(make_env(**{"num_envs": 2, **env}), **{**usual, **settings}, cache_dir=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_range_as_json_has_it_makes_the_same_file(tmp_path):
    for turn_gain in ((2.0, 8.0), [2.0, 8.0]):
        demonstrations(make_env(2, turn_gain=turn_gain), 6, max_steps=3, cache_dir=tmp_path)
    assert len(list(tmp_path.iterdir())) == 1


def test_a_scenario_with_a_formation_of_its_own_makes_another_file(tmp_path):
    class Staggered(FormationNavigation):
        def make_world(self, *args, **kwargs):
            world = super().make_world(*args, **kwargs)
            self.offsets = self.offsets + torch.tensor([[0.3, 0.0], [-0.3, 0.0], [0.0, 0.0]])
            return world

    class Renamed(FormationNavigation):
        """Might override anything."""

    for scenario in (FormationNavigation, Staggered, Renamed):
        env = VmasEnv(scenario(), num_envs=2, formation="line", n_robots=3)
        demonstrations(env, 6, max_steps=3, cache_dir=tmp_path)
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize("damage", [b"", b"not a checkpoint", None])
def test_a_corrupt_file_is_made_again(tmp_path, damage):
    first = demonstrations(make_env(2), 6, max_steps=3, cache_dir=tmp_path)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-100] if damage is None else damage)
    with pytest.warns(UserWarning, match="cannot be read"):
        again = demonstrations(make_env(2), 6, max_steps=3, cache_dir=tmp_path)
    assert equal(first, again)
    assert list(tmp_path.iterdir()) == [file]
    torch.load(file, weights_only=True)  # and the file is whole again


def test_a_failed_write_leaves_no_file(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        demonstrations(make_env(2), 6, max_steps=3, cache_dir=tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"planner": "prm"}, "planner: got 'prm', allowed are astar, rrt"),
        ({"num_trajectories": 0}, "num_trajectories: got 0"),
        ({"max_steps": 0}, "max_steps: got 0"),
        ({"speed": (0.5, 1.5)}, r"speed: got \(0.5, 1.5\)"),
        ({"speed": (0.0, 0.5)}, r"speed: got \(0.0, 0.5\)"),
        ({"speed": (0.8, 0.5)}, r"speed: got \(0.8, 0.5\)"),
        ({"noise": -0.1}, "noise: got -0.1"),
    ],
)
def test_bad_arguments_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        demonstrations(make_env(2), **settings)


def test_a_start_outside_the_map_is_named():
    with pytest.raises(ValueError, match=r"start: got .* outside the bounds"):
        demonstrations(make_env(2, start_distance=6.0), 6)


def test_narrow_corridor_that_one_robot_fits_through():
    env = make_env(2, formation="wedge", corridor_width=0.3, corridor_angle=0.5)
    data = demonstrations(env, 6, max_steps=200, noise=0.0)
    alone = data["next", "agents", "info", "arrived"].squeeze(-1).amax(1)
    assert alone.any(-1).all()


def arrived(data):
    return (data["next", "agents", "info", "arrived"].squeeze(-1) * data["mask"].unsqueeze(-1)).amax(1)


@pytest.mark.parametrize("kind", MAP_KINDS)
def test_robots_cross_every_kind_of_map(kind):
    env = make_env(2, steps=220, obstacle_map=f"{kind}:train")
    assert arrived(demonstrations(env, 6, speed=(0.9, 1.0), max_steps=220)).all()


@pytest.fixture
def walled_file(tmp_path):
    """A wall with a door of 1 m in a room of 9 m x 6 m, turned by a quarter, as a map server saves it."""
    image = np.full((120, 180), 254, dtype=np.uint8)
    image[:, 84:96] = 0
    image[50:70, 84:96] = 254
    image[0], image[-1] = 205, 205  # unknown
    imageio.imwrite(tmp_path / "room.pgm", image)
    (tmp_path / "room.yaml").write_text(
        "image: room.pgm\nresolution: 0.05\norigin: [3.0, -4.5, 1.5707963]\nnegate: 0\noccupied_thresh: 0.65\n"
        "free_thresh: 0.196\ngap: 1.0\nroute: [[0.0, -2.5], [0.0, 2.5]]\n"
    )
    return tmp_path / "room.yaml"


def test_robots_cross_a_grid_from_a_file_and_a_drawing_shows_it(walled_file, tmp_path):
    env = make_env(2, steps=150, obstacle_map=str(walled_file))
    data = demonstrations(env, 6, speed=(0.9, 1.0), cache_dir=tmp_path / "cache", noise=0.0)
    assert arrived(data).all()
    position = data["agents", "observation"][..., :2]
    assert (position[:, 0, :, 1] < -2).all() and (position[:, -1, :, 1] > 0).any()  # along y, which the file turned to
    in_the_wall = (position[..., 1].abs() < 0.3)[data["mask"]]
    assert in_the_wall.any()
    assert position[..., 0][data["mask"]][in_the_wall].abs().max() < 0.42  # through the door
    demonstrations(
        make_env(2, steps=150, obstacle_map=load_occupancy_map(walled_file, gap=0.9)),
        6,
        speed=(0.9, 1.0),
        cache_dir=tmp_path / "cache",
        noise=0.0,
    )
    assert len(list((tmp_path / "cache").iterdir())) == 2
    metrics = evaluate(TensorDictModule(lambda state: (2 * state[..., 4:6]).clamp(-1, 1), *KEYS), env, seed=0)
    assert 0 <= metrics["cfi_0.5"] <= 1 and metrics["collision_rate"] > 0  # straight on, the outer robots hit the wall
    grid = env.base_env.scenario.obstacle_map
    assert isinstance(grid, OccupancyMap)
    plot_trajectories(tmp_path / "crossing.png", position[0, :40], "line", grid)
    assert (tmp_path / "crossing.png").stat().st_size > 10_000
