import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from redig.baselines import LeaderFollower, UncoordinatedPlanner, VirtualStructure
from redig.baselines.episode import EpisodePlanner
from redig.envs import make_env
from redig.evaluation import evaluate, rollout_trajectories

POLICIES = (LeaderFollower, UncoordinatedPlanner, VirtualStructure)


class Recorder(EpisodePlanner):
    """Notes for which teams it is asked to plan."""

    def __init__(self, scenario):
        super().__init__(scenario)
        self.begun = []

    def begin(self, teams, position, goal, num_teams):
        assert position.shape == goal.shape == (len(teams), 5, 2)
        self.begun.append(teams.tolist())

    def command(self, position, velocity, step):
        return torch.full_like(position, 3.0)


def team(observation: torch.Tensor, step: list[int]) -> TensorDict:
    state = {"agents": {"observation": observation}, "step_count": torch.tensor(step).unsqueeze(-1)}
    return TensorDict(state, [len(step)])


def test_it_plans_for_the_teams_that_begin_and_for_all_when_their_number_changes():
    policy = Recorder(make_env(1).scenario)
    for steps in ([0, 0, 0], [1, 1, 1], [2, 0, 0], [5, 7]):
        policy(team(torch.zeros(len(steps), 5, 9), steps))
    assert policy.begun == [[0, 1, 2], [1, 2], [0, 1]]


def test_commands_are_within_the_action_bounds():
    action = Recorder(make_env(1).scenario)(team(torch.zeros(2, 5, 9), [0, 0]))["agents", "action"]
    assert torch.equal(action, torch.ones(2, 5, 2))


def test_another_team_size_is_named():
    with pytest.raises(ValueError, match=r"observation: got shape \[2, 4, 9\], expected \[teams, 5, F\]"):
        Recorder(make_env(1).scenario)(team(torch.zeros(2, 4, 9), [0, 0]))


@pytest.mark.parametrize("policy", POLICIES)
def test_a_team_does_the_same_alone_and_among_others(policy):
    """A collector resets teams one by one: half of them begin again, the others go on."""
    env = make_env(4)
    driver, alone = policy(env.scenario), policy(env.scenario)
    state = env.reset()
    fresh = env.rand_step(state.clone())["agents", "observation"]  # places of another episode
    first = driver(state.clone())["agents", "action"]
    mixed = state.clone()
    mixed["agents", "observation"][2:] = fresh[2:]
    mixed["step_count"] = torch.tensor([[1], [1], [0], [0]])
    together = driver(mixed)["agents", "action"]
    expected = alone(team(fresh[2:], [0, 0]))["agents", "action"]
    assert torch.allclose(together[2:], expected, atol=1e-5)
    assert first.shape == together.shape


@pytest.mark.parametrize("policy", POLICIES)
def test_it_drives_what_evaluate_runs_more_than_once(policy):
    env = make_env(2, max_steps=5)
    driver = policy(env.scenario)
    first, again = (evaluate(driver, env, seed=1, num_starts=4) for _ in range(2))
    assert first == pytest.approx(again, nan_ok=True)
    both = [rollout_trajectories(p, env, seed=3)["position"] for p in (driver, policy(env.scenario))]
    assert torch.equal(*both)  # nothing is left of the episodes before


def test_the_environment_is_not_changed():
    env = make_env(2)
    for policy in POLICIES:
        policy(env.scenario)
    check_env_specs(env)
