"""What the actor keeps from step to step in TorchRL's environments: fixed latents and the previous action."""

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import GymEnv, StepCounter, TransformedEnv, VmasEnv, check_env_specs
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import get_primers_from_module

from redig.modules import DDIM, DDPM, DenoisingMLP, DiffusionActor, GraphEncoder, NoiseSchedule

LATENT, PREVIOUS = ("agents", "latent"), ("agents", "previous_action")


def make_team(max_steps=3, num_envs=4, latent_key=LATENT, warm_start=9, sampler=None, **keys):
    """Three robots of a VMAS scenario, their policy, and the environment with the actor's primer."""
    torch.manual_seed(0)
    env = VmasEnv("navigation", num_envs=num_envs, n_agents=3, seed=0)
    width = env.observation_spec["agents", "observation"].shape[-1]
    encoder = TensorDictModule(GraphEncoder(width, 6, 8), [("agents", "observation")], [("agents", "embedding")])
    actor = DiffusionActor(
        DenoisingMLP(2, 6, (16,)),
        env.full_action_spec,
        schedule=NoiseSchedule(20, "linear"),
        sampler=sampler or DDIM(10),
        latent_key=latent_key,
        warm_start=warm_start,
        **keys,
    )
    env = TransformedEnv(env, StepCounter(max_steps=max_steps))
    return env.append_transform(actor.make_tensordict_primer()), TensorDictSequential(encoder, actor), actor


def rollout(env, policy, steps, kind=ExplorationType.RANDOM, **options):
    with torch.no_grad(), set_exploration_type(kind):
        return env.rollout(steps, policy, break_when_any_done=False, **options)


@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"latent_key": None},
        {"warm_start": None},
        {"latent_key": ("agents", "a", "b", "z"), "previous_action_key": ("agents", "a", "b", "u")},
        {"latent_key": "z", "previous_action_key": "u"},
        {"latent_key": ("kept", "z"), "previous_action_key": ("kept", "deep", "u")},
    ],
)
def test_environment_with_the_primer_passes_torchrls_check(keys):
    env, policy, actor = make_team(**keys)
    check_env_specs(env)
    data = rollout(env, policy, 5)
    for key in (actor.latent_key, actor.previous_action_key):
        if key is not None:
            assert data[key].shape == (4, 5, 3, 2)
            assert data["next", key].shape == (4, 5, 3, 2)


def test_latents_last_for_an_episode_and_are_fresh_in_the_next():
    env, policy, _ = make_team(max_steps=3)
    latent = rollout(env, policy, 9)[LATENT].unflatten(1, (3, 3))  # [env, episode, step, robot, 2]
    assert (latent == latent[:, :, :1]).all()
    first = latent[:, :, 0].flatten(0, 2)
    assert len(first.unique(dim=0)) == len(first) == 4 * 3 * 3  # of each environment, episode and robot its own
    assert first.mean().item() == pytest.approx(0, abs=0.4)
    assert first.std().item() == pytest.approx(1, abs=0.3)


def test_partial_resets_touch_only_the_environments_that_reset():
    env, policy, _ = make_team(max_steps=100)
    data = rollout(env, policy, 3)
    after = data[:, -1]["next"].clone()
    mask = torch.tensor([True, False, True, False]).unsqueeze(-1)
    reset = env.reset(after.clone().set("_reset", mask))
    for i, fresh in enumerate(mask.flatten()):
        assert torch.equal(reset[LATENT][i], after[LATENT][i]) == (not fresh)
        assert torch.equal(reset[PREVIOUS][i], torch.zeros(3, 2) if fresh else after[PREVIOUS][i])
    assert (after[PREVIOUS] != 0).all()


def test_previous_action_is_the_last_one_scaled_and_the_middle_after_a_reset():
    env, policy, actor = make_team(max_steps=3)
    data = rollout(env, policy, 9)
    scaled = actor.module.normalize(data["agents", "action"])
    torch.testing.assert_close(data["next", "agents", "previous_action"], scaled)
    previous = data[PREVIOUS].unflatten(1, (3, 3))
    assert (previous[:, :, 0] == 0).all()
    torch.testing.assert_close(previous[:, :, 1:], scaled.unflatten(1, (3, 3))[:, :, :-1])


def test_the_rollout_is_the_chain_from_what_is_kept():
    env, policy, actor = make_team(max_steps=3)
    data = rollout(env, policy, 5)
    with torch.no_grad():
        expected, _ = actor.module(data["agents", "embedding"], data[LATENT], data[PREVIOUS])
    torch.testing.assert_close(data["agents", "action"], expected)


def test_deterministic_warm_start_repeats_itself():
    env, policy, _ = make_team(latent_key=None)
    actions = []
    for _ in range(2):
        env.set_seed(0)
        actions.append(rollout(env, policy, 5, ExplorationType.DETERMINISTIC)["agents", "action"])
    assert torch.equal(*actions)


def test_warm_start_with_a_sampler_that_adds_noise():
    env, policy, _ = make_team(sampler=DDPM(), warm_start=5)
    action = rollout(env, policy, 5)["agents", "action"]
    assert action.isfinite().all()


def test_seeds():
    def run(seed):
        env, policy, _ = make_team()
        torch.manual_seed(seed)
        env.set_seed(seed)
        return rollout(env, policy, 7)["agents", "action"]

    assert torch.equal(run(1), run(1))
    assert not torch.equal(run(1), run(2))


def test_collector():
    env, policy, actor = make_team(max_steps=3)
    collector = Collector(env, policy, frames_per_batch=20, total_frames=60, auto_register_policy_transforms=False)
    batches = torch.cat([batch.clone() for batch in collector], 1)
    collector.shutdown()
    assert batches.shape == (4, 15)
    latent = batches[LATENT].unflatten(1, (5, 3))  # episodes go on from one batch to the next
    assert (latent == latent[:, :, :1]).all()
    scaled = actor.module.normalize(batches["agents", "action"]).unflatten(1, (5, 3))
    torch.testing.assert_close(batches[PREVIOUS].unflatten(1, (5, 3))[:, :, 1:], scaled[:, :, :-1])


@pytest.mark.parametrize("batched", [False, True])
def test_gym(batched):
    torch.manual_seed(0)
    env = GymEnv("Pendulum-v1", num_envs=2) if batched else GymEnv("Pendulum-v1")
    actor = DiffusionActor(
        DenoisingMLP(1, 3, (16,)),
        env.full_action_spec,
        ["observation"],
        ["action"],
        sampler=DDIM(5),
        latent_key=("kept", "latent"),
        warm_start=60,
    )
    assert actor.previous_action_key == "previous_action"
    env = TransformedEnv(env, StepCounter(max_steps=3)).append_transform(actor.make_tensordict_primer())
    check_env_specs(env)
    data = rollout(env, actor, 6)
    latent = data["kept", "latent"].unflatten(-2, (2, 3))
    assert (latent == latent[..., :1, :]).all()
    assert (latent[..., 0, 0, :] != latent[..., 1, 0, :]).all()
    previous, action = data["previous_action"], data["action"] / 2  # the bounds are -2 and 2
    assert (previous[..., [0, 3], :] == 0).all()
    torch.testing.assert_close(previous[..., [1, 2, 4, 5], :], action[..., [0, 1, 3, 4], :])


def test_actor_of_one_robot_that_drives_a_team():
    env, policy, actor = make_team()
    single = DiffusionActor(DenoisingMLP(2, 6, (16,)), actor.spec["agents", "action"][0], latent_key=LATENT)
    with pytest.raises(ValueError, match="mismatch"):
        TransformedEnv(env.base_env, single.make_tensordict_primer()).rollout(2, policy)
    env = TransformedEnv(env.base_env, single.make_tensordict_primer((3, 2)))
    assert rollout(env, TensorDictSequential(policy[0], single), 2)[LATENT].shape == (4, 2, 3, 2)


def test_torchrl_finds_the_primer_in_a_policy():
    _, policy, _ = make_team()
    bare = VmasEnv("navigation", num_envs=4, n_agents=3, seed=0)
    found = rollout(TransformedEnv(bare, get_primers_from_module(policy)), policy, 3)
    assert {LATENT, PREVIOUS} <= set(found.keys(True, True))
    bare = VmasEnv("navigation", num_envs=4, n_agents=3, seed=0)
    collector = Collector(bare, policy, frames_per_batch=8, total_frames=8, auto_register_policy_transforms=True)
    assert {LATENT, PREVIOUS} <= set(next(iter(collector)).keys(True, True))
    collector.shutdown()


@pytest.mark.filterwarnings("error:Could not auto-wire")
def test_an_actor_that_keeps_nothing_has_an_empty_primer():
    _, policy, _ = make_team(latent_key=None, warm_start=None)
    assert len(get_primers_from_module(policy)) == 0
    bare = VmasEnv("navigation", num_envs=4, n_agents=3, seed=0)
    collector = Collector(bare, policy, frames_per_batch=8, total_frames=8, auto_register_policy_transforms=True)
    assert next(iter(collector)).shape == (4, 2)
    collector.shutdown()


def test_environment_without_the_primer():
    env, policy, _ = make_team()
    message = r"no key \('agents', 'latent'\), \('agents', 'previous_action'\); .*append make_tensordict_primer\(\)"
    with pytest.raises(KeyError, match=message):
        env.base_env.rollout(2, policy)
