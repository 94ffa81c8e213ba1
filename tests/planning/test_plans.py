import pytest
import torch
from torchrl.envs import StepCounter, TransformedEnv, VmasEnv

from redig.envs import FormationNavigation, formation_integrity
from redig.planning import demonstrations


def make_env(num_envs: int, **kwargs):
    return TransformedEnv(VmasEnv(FormationNavigation(), num_envs=num_envs, **kwargs), StepCounter(200))


@pytest.fixture(scope="module")
def both():
    settings = {"num_trajectories": 40, "speed": (0.5, 1.0), "noise": 0.05, "seed": 3}
    return {
        planner: demonstrations(make_env(8), planner=planner, **settings) for planner in ("virtual_structure", "astar")
    }


def arrived(data):
    return (data["next", "agents", "info", "arrived"].squeeze(-1) * data["mask"].unsqueeze(-1)).amax(1)


def test_coordinated_teams_arrive_without_collisions_in_spite_of_the_noise(both):
    data = both["virtual_structure"]
    assert data.shape[0] == 8
    assert arrived(data).all()
    collided = data["next", "agents", "info", "collision"].squeeze(-1)[data["mask"]]
    assert collided.mean() < 1e-3


def test_coordinated_teams_keep_their_shape_and_uncoordinated_ones_do_not(both):
    tau = {}
    for planner, data in both.items():
        moving = data["mask"] & (data["agents", "info", "arrived"].squeeze(-1).amin(-1) == 0)
        tau[planner] = formation_integrity("wedge", data["agents", "observation"][moving][..., :2]).mean()
    assert tau["virtual_structure"] > 0.9
    assert tau["astar"] < tau["virtual_structure"] - 0.1


def test_each_team_has_its_own_speed_within_the_range(both):
    fastest = both["virtual_structure"]["agents", "observation"][..., 2:4].norm(dim=-1).flatten(1).quantile(0.95, 1)
    assert fastest.min() > 0.4 and fastest.max() < 1.1
    assert fastest.max() - fastest.min() > 0.1


def test_same_seed_same_coordinated_demonstrations():
    settings = {"num_trajectories": 10, "planner": "virtual_structure", "max_steps": 20}
    first, again = (demonstrations(make_env(2), seed=4, **settings) for _ in range(2))
    other = demonstrations(make_env(2), seed=5, **settings)
    assert torch.equal(first["agents", "action"], again["agents", "action"])
    assert not torch.equal(first["agents", "action"], other["agents", "action"])
