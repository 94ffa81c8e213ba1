import math

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv, VmasEnv
from torchrl.envs.utils import ExplorationType
from vmas.simulator.environment.environment import Environment

from redig.envs import FormationNavigation, formation_integrity
from redig.evaluation import evaluate, rollout_trajectories

KEYS = ["success_rate", "team_success_rate", "travel_time", "travel_time_teams"]
KEYS += ["cfi_0.5", "cfi_0.1", "cfi_0.03", "cfi_literal_0.5", "cfi_literal_0.1", "cfi_literal_0.03"]
KEYS += ["jerk_mean", "jerk_peak", "collision_rate", "num_starts"]


class EndsAtCollision(FormationNavigation):
    """Teams end at different times, and without having arrived."""

    def done(self):
        return super().done() | (self.quantities["collision"] > 0).any(-1)


def make(num_envs=4, steps=80, transform=None, scenario=FormationNavigation, **kwargs):
    kwargs = {"n_robots": 3, "corridor_width": 3.0, "start_distance": 2.0, **kwargs}
    env = VmasEnv(scenario(), num_envs=num_envs, seed=0, **kwargs)
    return TransformedEnv(env, transform or StepCounter(steps))


def module(function):
    return TensorDictModule(function, in_keys=[("agents", "observation")], out_keys=[("agents", "action")])


straight = module(lambda observation: (2 * observation[..., 4:6]).clamp(-1, 1))
noisy = module(lambda o: (2 * o[..., 4:6] + torch.randn_like(o[..., 4:6])).clamp(-1, 1))
still = module(lambda observation: torch.zeros_like(observation[..., :2]))


def same(first: dict, second: dict) -> bool:
    return repr(first) == repr(second)  # NaN equals NaN, and every digit counts


def test_straight_drive_through_a_wide_corridor_succeeds():
    metrics = evaluate(straight, make(), seed=1)
    assert list(metrics) == KEYS
    assert all(type(value) is float for value in metrics.values())
    assert metrics["success_rate"] == metrics["team_success_rate"] == metrics["travel_time_teams"] == 1
    assert metrics["collision_rate"] == 0
    assert metrics["num_starts"] == 4
    assert 4 - 0.5 < metrics["travel_time"] < 6.5  # 4 m at 1 m/s, jitter, and slowing down


def test_team_that_stands_still():
    metrics = evaluate(still, make(steps=10), seed=1)
    assert metrics["success_rate"] == metrics["travel_time_teams"] == metrics["collision_rate"] == 0
    assert math.isnan(metrics["travel_time"])
    assert metrics["jerk_mean"] == metrics["jerk_peak"] == 0


@pytest.mark.parametrize(
    ("scenario", "width"), [(FormationNavigation, 0.9), (FormationNavigation, 3.0), (EndsAtCollision, 2.6)]
)
def test_metrics_equal_a_loop_over_the_trajectories(scenario, width):
    env = make(num_envs=6, steps=70, scenario=scenario, corridor_width=width)
    metrics = evaluate(noisy, env, seed=2)
    data = rollout_trajectories(noisy, env, seed=2)
    xi = width - 2 * 0.1
    succeeded, teams, times, collided = [], [], [], []
    cfi, mean_jerk, peak_jerk = [], [], []
    for e in range(6):
        length = int(data["mask"][e].sum())
        p = data["position"][e, :length].double()
        arrived, hit = data["arrived"][e, :length], data["collision"][e, :length]
        first = [next((k for k in range(length) if arrived[k, i]), None) for i in range(3)]
        succeeded += [first[i] is not None and not hit[:, i].any() for i in range(3)]
        teams.append(all(succeeded[-3:]))
        collided += [bool(hit[:, i].any()) for i in range(3)]
        if None not in first:
            times.append(0.1 * max(first))
        last = length - 1 if None in first else max(first)
        values = []
        for k in range(last + 1):
            r = max((p[k, i] - p[k].mean(0)).norm().item() for i in range(3))
            gap = min(1.0, max(0.0, 2 - abs(r - xi) / 0.1))
            values.append(0.5 * gap + 0.5 * formation_integrity("wedge", p[k]).item())
        cfi.append(sum(values) / len(values))
        jerks = []
        for i in range(3):
            until = length - 1 if first[i] is None else first[i]
            for k in range(3, until + 1):
                third = p[k, i] - 3 * p[k - 1, i] + 3 * p[k - 2, i] - p[k - 3, i]
                jerks.append(third.norm().item() / 0.1**3)
        mean_jerk.append(sum(jerks) / len(jerks))
        peak_jerk.append(max(jerks))
    assert 0 < sum(succeeded) < 18  # the case is worth its name
    assert metrics["success_rate"] == pytest.approx(sum(succeeded) / 18)
    assert metrics["team_success_rate"] == pytest.approx(sum(teams) / 6)
    assert metrics["collision_rate"] == pytest.approx(sum(collided) / 18)
    assert metrics["travel_time_teams"] == pytest.approx(len(times) / 6)
    assert metrics["travel_time"] == pytest.approx(sum(times) / len(times) if times else math.nan, nan_ok=True)
    assert metrics["cfi_0.1"] == pytest.approx(sum(cfi) / 6, abs=1e-4)
    assert metrics["jerk_mean"] == pytest.approx(sum(mean_jerk) / 6, abs=1e-2)
    assert metrics["jerk_peak"] == pytest.approx(sum(peak_jerk) / 6, abs=1e-2)


def test_trajectories_hold_each_start_once():
    data = rollout_trajectories(straight, make(num_envs=8, hold_steps=3), seed=3)
    lengths = data["mask"].sum(1)
    assert len(set(lengths.tolist())) > 1  # teams end at different times
    assert data.shape == (8, lengths.max())
    for e, length in enumerate(lengths.tolist()):
        assert data["mask"][e, :length].all()
        # the team is done once it has held for 3 samples, and then nothing changes: no second episode
        assert data["arrived"][e].all(-1).int().argmax() == length - 3
        for key in ("position", "velocity", "arrived", "collision"):
            assert (data[key][e, length:] == data[key][e, length - 1]).all()
    assert not data["arrived"][:, 0].any()
    assert (data["velocity"][:, 0] == 0).all()
    step = (data["position"][:, 1] - data["position"][:, 0]).norm(dim=-1)
    assert (step > 0).all()
    assert (step < 0.1).all()


def test_horizon_ends_the_trajectories():
    env = make(steps=80)
    assert rollout_trajectories(still, env, seed=0).shape == (4, 81)
    assert rollout_trajectories(still, env, seed=0, max_steps=7).shape == (4, 8)
    assert rollout_trajectories(still, env, seed=0, max_steps=7)["mask"].all()
    with_others = make(transform=Compose(RewardSum(), StepCounter(5)))
    assert rollout_trajectories(still, with_others, seed=0).shape == (4, 6)


@pytest.mark.parametrize("policy", [straight, noisy])
def test_equal_seeds_give_equal_results(policy):
    first = make()
    expected = evaluate(policy, first, seed=5)
    torch.manual_seed(123)
    first.rollout(3)
    assert same(evaluate(policy, first, seed=5), expected)
    assert same(evaluate(policy, make(), seed=5), expected)
    assert not same(evaluate(policy, first, seed=6), expected)


def test_random_states_are_left_alone():
    env = make()
    torch.manual_seed(0)
    torch_state, vmas_state = torch.get_rng_state(), Environment.vmas_random_state[0].clone()
    evaluate(noisy, env, seed=9)
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert torch.equal(Environment.vmas_random_state[0], vmas_state)


def test_random_states_are_left_alone_when_the_policy_fails():
    def fail(observation):
        raise RuntimeError("no idea")

    env = make()
    torch_state = torch.get_rng_state()
    with pytest.raises(RuntimeError, match="no idea"):
        evaluate(module(fail), env, seed=9)
    assert torch.equal(torch.get_rng_state(), torch_state)


def test_starts_do_not_depend_on_the_policy():
    env = make()
    first, second = (rollout_trajectories(p, env, seed=4, max_steps=2)["position"][:, 0] for p in (noisy, still))
    assert torch.equal(first, second)


def test_number_of_starts():
    env = make(num_envs=4, steps=40)
    first, second = (rollout_trajectories(straight, env, seed=s) for s in (7, 8))
    arrived = torch.cat([d["arrived"].any(1) & ~d["collision"].any(1) for d in (first, second)]).float()
    for count in (3, 4, 6, 8):
        metrics = evaluate(straight, env, seed=7, num_starts=count)
        assert metrics["num_starts"] == count
        assert metrics["success_rate"] == pytest.approx(arrived[:count].mean().item())


def test_deltas_name_the_keys():
    metrics = evaluate(still, make(steps=5), seed=0, deltas=(0.25,))
    assert [key for key in metrics if key.startswith("cfi")] == ["cfi_0.25", "cfi_literal_0.25"]


def test_exploration_type_and_gradients_seen_by_the_policy():
    from torchrl.envs.utils import exploration_type

    seen = set()

    def spy(observation):
        seen.add((exploration_type(), torch.is_grad_enabled()))
        return torch.zeros_like(observation[..., :2])

    env = make(steps=2)
    evaluate(module(spy), env, seed=0)
    assert seen == {(ExplorationType.DETERMINISTIC, False)}
    seen.clear()
    evaluate(module(spy), env, seed=0, exploration_type=ExplorationType.RANDOM)
    assert seen == {(ExplorationType.RANDOM, False)}


def test_bad_arguments():
    env = make()
    with pytest.raises(ValueError, match="num_starts: got 0"):
        evaluate(still, env, seed=0, num_starts=0)
    with pytest.raises(ValueError, match="max_steps: got 0"):
        evaluate(still, env, seed=0, max_steps=0)
    with pytest.raises(ValueError, match="max_steps: got None"):
        evaluate(still, env.base_env, seed=0)
    assert rollout_trajectories(still, env.base_env, seed=0, max_steps=2).shape == (4, 3)
