import json
import os
import pickle
import re
from dataclasses import asdict, replace

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.envs import make_env
from redig.modules import DDIM, DDPM, DPMSolver
from redig.policy import ACTION, FORMAT, OBSERVATION, PolicyConfig, build_policy, load_policy, read_header, save_policy

SMALL = PolicyConfig(9, embedding_dim=6, encoder_hidden=6, hidden=(8,), diffusion_steps=10, sampling_steps=5)
VARIANTS = [
    SMALL,
    replace(SMALL, encoder="linear", encoder_activation=None, radius=1.0, observation_dim=7),
    replace(SMALL, action_low=(-0.5, 0.0), action_high=(2.0, 0.1), aggregation="sum", hidden=(8, 4), step_dim=4),
    replace(SMALL, schedule="vp", noise_ratio=0.5, early_stop=3, sampling_steps=None),
]


def team(width=9, *batch):
    torch.manual_seed(0)
    return TensorDict({"agents": {"observation": torch.randn(*batch, 5, width)}}, batch)


def act(policy, data, kind=ExplorationType.RANDOM):
    torch.manual_seed(1)
    with torch.no_grad(), set_exploration_type(kind):
        return policy(data.clone())[ACTION]


@pytest.fixture
def saved(tmp_path):
    policy = build_policy(SMALL)
    path = tmp_path / "policy.safetensors"
    save_policy(path, policy, SMALL, {"formation": "wedge", "n_robots": 5})
    return path, policy


def written(path, tensors, **changes):
    """A policy file whose header says something else."""
    header = {"format": FORMAT, "policy": json.dumps(asdict(SMALL)), "environment": "{}", **changes}
    save_file(tensors, path, {name: value for name, value in header.items() if value is not None})
    return path


@pytest.mark.parametrize("config", VARIANTS)
def test_round_trip_gives_equal_actions(config, tmp_path):
    policy = build_policy(config)
    save_policy(tmp_path / "p.safetensors", policy, config)
    loaded = load_policy(tmp_path / "p.safetensors", config.observation_dim)
    for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        data = team(config.observation_dim, 4)
        assert torch.equal(act(policy, data, kind), act(loaded, data, kind))
    assert read_header(tmp_path / "p.safetensors") == (config, {})
    assert not loaded.training


@pytest.mark.parametrize("config", VARIANTS)
def test_policy_is_what_its_configuration_says(config):
    encoder, actor = (module.module for module in build_policy(config))
    assert (encoder.in_features, encoder.embedding_dim) == (config.observation_dim, config.embedding_dim)
    assert (encoder.kind, encoder.radius) == (config.encoder, config.radius)
    assert torch.equal(actor.low, torch.tensor(config.action_low))
    assert torch.equal(actor.high, torch.tensor(config.action_high))
    assert (actor.schedule.num_steps, actor.schedule.kind) == (config.diffusion_steps, config.schedule)
    assert actor.sampler == DDPM(config.sampling_steps, config.noise_ratio, config.early_stop)
    layers = [layer.out_features for layer in actor.denoiser.net if isinstance(layer, torch.nn.Linear)]
    assert layers == [*config.hidden, len(config.action_low)]
    assert actor.denoiser.step_dim == config.step_dim


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_policy_reads_observations_of_any_team_size(batch):
    policy = build_policy(SMALL)
    assert policy.in_keys == [OBSERVATION]
    for n in (1, 3, 8):
        data = TensorDict({"agents": {"observation": torch.randn(*batch, n, 9)}}, batch)
        assert act(policy, data).shape == (*batch, n, 2)


def test_header_and_environment(saved):
    assert read_header(saved[0]) == (SMALL, {"formation": "wedge", "n_robots": 5})


def test_file_is_plain_safetensors(saved):
    path, policy = saved
    with safe_open(path, framework="pt") as file:
        assert set(file.keys()) == set(policy.state_dict())
        assert file.metadata()["format"] == FORMAT


def test_saving_does_not_touch_the_policy_and_replaces_the_file(saved):
    path, policy = saved
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    for parameter in policy.parameters():
        parameter.data.add_(1)
    save_policy(path, policy, SMALL)
    assert os.listdir(path.parent) == [path.name]
    loaded = load_policy(path).state_dict()
    for name, value in policy.state_dict().items():
        assert torch.equal(loaded[name], value)
    assert any(not torch.equal(loaded[name], value) for name, value in before.items())


def test_failing_save_leaves_the_old_file(saved):
    path, policy = saved
    content = path.read_bytes()
    with pytest.raises(TypeError):
        save_policy(path, policy, SMALL, {"map": object()})
    assert path.read_bytes() == content
    assert os.listdir(path.parent) == [path.name]


class Bomb:
    exploded = False

    def __reduce__(self):
        return (setattr, (Bomb, "exploded", True))


@pytest.mark.parametrize("write", [lambda o, p: p.write_bytes(pickle.dumps(o)), torch.save])
def test_pickle_in_disguise_is_refused_and_not_executed(write, tmp_path):
    path = tmp_path / "policy.safetensors"
    write({"weights": Bomb()}, path)
    with pytest.raises(ValueError, match=re.escape(f"{path} is not a safetensors file")):
        load_policy(path)
    assert not Bomb.exploded


@pytest.mark.parametrize("part", [0.0, 0.001, 0.3, 0.6, 0.999])
def test_truncated_file(saved, part):
    path, _ = saved
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(ValueError, match=re.escape(f"{path} is not a safetensors file, or is damaged")):
        load_policy(path)


@pytest.mark.parametrize("format_", ["redig-policy-0", None])
def test_other_format(saved, format_):
    path, policy = saved
    written(path, policy.state_dict(), format=format_)
    with pytest.raises(ValueError, match=re.escape(f"{path} has format {format_!r}, expected 'redig-policy-1'")):
        load_policy(path)


def test_safetensors_without_header(saved):
    path, policy = saved
    save_file(policy.state_dict(), path)
    with pytest.raises(ValueError, match="has format None"):
        read_header(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"policy": json.dumps({**asdict(SMALL), "unheard_of": 1})},
        {"policy": json.dumps({"radius": 2.0})},
        {"policy": "{"},
        {"policy": None},
        {"environment": None},
        {"policy": json.dumps({**asdict(SMALL), "embedding_dim": 7})},
    ],
    ids=["unknown field", "missing field", "not JSON", "no policy", "no environment", "other widths"],
)
def test_header_that_does_not_fit(saved, changes):
    path, policy = saved
    written(path, policy.state_dict(), **changes)
    with pytest.raises(ValueError, match=re.escape(str(path))):
        load_policy(path)


def test_missing_weights(saved):
    path, policy = saved
    weights = policy.state_dict()
    weights.pop(next(iter(weights)))
    written(path, weights)
    with pytest.raises(ValueError, match=re.escape(str(path))):
        load_policy(path)


def test_wrong_observation_width_names_both(saved):
    with pytest.raises(ValueError, match=r"observations of 9 numbers a robot, the environment gives 7"):
        load_policy(saved[0], observation_dim=7)
    with pytest.raises(ValueError, match=r"\[4, 5, 7\], expected \[\*B, n, 9\]"):
        act(load_policy(saved[0]), team(7, 4))


def test_missing_file(tmp_path):
    for path in (tmp_path / "absent.safetensors", tmp_path):
        with pytest.raises(FileNotFoundError, match=re.escape(f"policy: no such file: {path}")):
            load_policy(path)


def test_sampler_that_does_not_fit_the_schedule():
    with pytest.raises(ValueError, match="asks for 11 steps, the schedule has 10"):
        build_policy(replace(SMALL, sampling_steps=11))


def test_deployment_chooses_the_sampler(tmp_path):
    config = PolicyConfig(observation_dim=9, diffusion_steps=20, sampling_steps=5, sampler="ddim", eta=0.5)
    policy = build_policy(config)
    assert policy[-1].module.sampler == DDIM(5, 0.5)
    path = tmp_path / "policy.safetensors"
    save_policy(path, policy, config)
    assert load_policy(path)[-1].module.sampler == DDIM(5, 0.5)
    other = load_policy(path, sampler=DPMSolver(4))
    assert other[-1].module.sampler == DPMSolver(4)
    for name, weight in policy.state_dict().items():
        assert torch.equal(other.state_dict()[name], weight), name
    with pytest.raises(ValueError, match="asks for 21 steps, the schedule has 20"):
        load_policy(path, sampler=DDIM(21))


def test_unknown_sampler():
    with pytest.raises(ValueError, match="sampler: got 'euler', allowed are ddpm, ddim, dpmsolver"):
        build_policy(PolicyConfig(observation_dim=9, sampler="euler"))


def test_deployment_keeps_latent_and_previous_action(tmp_path):
    config = PolicyConfig(observation_dim=9, diffusion_steps=20)
    path = tmp_path / "policy.safetensors"
    save_policy(path, build_policy(config), config)
    policy = load_policy(path, fixed_latent=True, warm_start=7)
    env = make_env(3, max_steps=4)
    shape = env.full_action_spec_unbatched["agents", "action"].shape
    data = env.append_transform(policy[-1].make_tensordict_primer(shape)).rollout(4, policy)
    latent, previous = data["agents", "latent"], data["agents", "previous_action"]
    assert torch.equal(latent, latent[:, :1].expand_as(latent))
    assert latent[:, 0].std() > 0.3
    assert torch.equal(previous[:, 0], torch.zeros_like(previous[:, 0]))
    torch.testing.assert_close(previous[:, 1:], data["agents", "action"][:, :-1])  # bounds of -1 and 1 m/s
