import random

import pytest
import torch

from redig.envs import EVALUATION_MAPS, MAP_KINDS, MapBatch, make_env, named_map, random_map


def same(one, other):
    return torch.equal(one.obstacles, other.obstacles) if one.obstacles.shape == other.obstacles.shape else False


@pytest.mark.parametrize("kind", MAP_KINDS)
def test_a_seed_is_a_map_and_no_training_map_is_an_evaluation_map(kind):
    held_out = [random_map(kind, seed, "evaluation") for seed in range(EVALUATION_MAPS)]
    training = [random_map(kind, seed) for seed in range(2 * EVALUATION_MAPS)]
    gaps = [one.gap for one in held_out + training]
    assert len(set(gaps)) == len(gaps)
    assert same(random_map(kind, 3), training[3])
    assert min(gaps) >= 0.6


def test_drawing_a_map_disturbs_no_other_generator():
    torch.manual_seed(0)
    random.seed(0)
    expected = torch.rand(1), random.random()
    torch.manual_seed(0)
    random.seed(0)
    random_map("forest", 1)
    assert (torch.rand(1), random.random()) == expected


@pytest.mark.parametrize("kind", MAP_KINDS)
@pytest.mark.parametrize("formation", ["wedge", "circle"])
def test_formations_find_room_at_start_and_goal_of_every_evaluation_map(kind, formation):
    env = make_env(EVALUATION_MAPS, obstacle_map=f"{kind}:evaluation", formation=formation)
    observation = env.reset()["agents", "observation"]
    assert observation[..., 6].min() >= 0.1
    x_min, y_min, x_max, y_max = env.base_env.scenario.obstacle_map.bounds
    goal = env.base_env.scenario.goal
    assert (goal > torch.tensor([x_min, y_min])).all() and (goal < torch.tensor([x_max, y_max])).all()


def test_curves_turn_to_either_side():
    sides = {(random_map("curve", seed).route[:, 1].sum() > 0).item() for seed in range(8)}
    assert sides == {True, False}


def test_names_stand_for_maps():
    batch = named_map("bollards:evaluation", EVALUATION_MAPS + 2)
    assert isinstance(batch, MapBatch) and len(batch.maps) == EVALUATION_MAPS + 2
    assert same(batch.maps[1], random_map("bollards", 1, "evaluation"))
    assert same(batch.maps[-1], batch.maps[1])  # they begin again
    assert same(named_map("bollards:train", EVALUATION_MAPS + 2).maps[-1], random_map("bollards", EVALUATION_MAPS + 1))
    assert same(named_map("doorway:train", 1), random_map("doorway", 0))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("maze", 0), "kind: got 'maze', allowed are corridor, narrowing"),
        (("forest", 0, "test"), "split: got 'test', allowed are train, evaluation"),
        (("forest", -1), "seed: got -1"),
        (("forest", 32, "evaluation"), "seed: got 32, must be 0 or more, and less than 32 in evaluation"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        random_map(*arguments)


@pytest.mark.parametrize("name", ["forest", "forest:test", "maze:train", "map.pgm"])
def test_other_names_are_refused(name):
    with pytest.raises(ValueError, match="obstacle_map: got .* must be KIND:SPLIT .*forest.* or the path"):
        make_env(2, obstacle_map=name)
