import pytest
import torch

from redig.envs import MapBatch, bollards, corridor, curve, doorway, forest, make_env
from redig.evaluation import gap_term

MAPS = (curve(), bollards(gap=0.7), forest(), doorway())
STILL = {"position_jitter": 0.0, "heading_jitter": 0.0, "formation_reward": "scaled", "navigation_reward": "progress"}


@pytest.mark.parametrize("lead", [(), (2,)])
def test_every_environment_has_the_distances_of_its_own_map(lead):
    point = 6 * torch.rand(*lead, len(MAPS), 50, 2, generator=torch.Generator().manual_seed(0)) - 3
    batch = MapBatch(MAPS)
    distance, direction = batch.nearest(point)
    assert torch.equal(batch.signed_distance(point), distance)
    for i, one in enumerate(MAPS):
        own_distance, own_direction = one.nearest(point[..., i, :, :])
        torch.testing.assert_close(distance[..., i, :], own_distance)
        torch.testing.assert_close(direction[..., i, :, :], own_direction)


def drive(env, steps=60):
    """Straight for the goal, into whatever is in between; the second environment starts anew on the way."""
    state, seen = env.reset(), []
    for k in range(steps):
        action = state["agents", "observation"][..., 4:6].clamp(-1, 1)
        state = env.step(state.set(("agents", "action"), action))["next"]
        seen.append(torch.cat([state["agents", "observation"], state["agents", "reward"]], -1))
        if k == 20:
            reset = torch.zeros(env.batch_size[0], 1, dtype=torch.bool)
            reset[min(1, env.batch_size[0] - 1)] = True
            state = env.reset(state.set("_reset", reset))
    return torch.stack(seen)


def test_a_batch_of_environments_is_as_each_alone():
    together = drive(make_env(2, obstacle_map=MapBatch((doorway(), MAPS[0])), **STILL))
    alone = drive(make_env(1, obstacle_map=MAPS[0], **STILL))
    torch.testing.assert_close(together[:, 1:], alone, atol=1e-4, rtol=0)
    assert not torch.equal(together[:, 0], together[:, 1])


def test_each_gap_is_that_of_its_own_metric():
    position = torch.rand(len(MAPS), 7, 5, 2, generator=torch.Generator().manual_seed(0))
    together = gap_term(position, MapBatch(MAPS).gap - 0.2, delta=0.5)
    for i, one in enumerate(MAPS):
        torch.testing.assert_close(together[i], gap_term(position[i], one.gap - 0.2, delta=0.5))


def test_moving_to_a_device_keeps_the_maps():
    moved = MapBatch(MAPS).to("cpu")
    assert torch.equal(moved.obstacles, MapBatch(MAPS).obstacles)
    assert torch.equal(moved.route, MapBatch(MAPS).route)


def test_bad_batches_are_refused():
    with pytest.raises(ValueError, match="maps: got none"):
        MapBatch(())
    with pytest.raises(ValueError, match="maps: some have a route and some have none"):
        MapBatch((corridor(), doorway()))
    with pytest.raises(ValueError, match="obstacle_map: got 4 maps, must be one for each of 3 environments"):
        make_env(3, obstacle_map=MapBatch(MAPS))
    with pytest.raises(ValueError, match="obstacle_map: its gap of 0.15 m is too narrow"):
        make_env(1, obstacle_map=bollards(gap=0.15))
