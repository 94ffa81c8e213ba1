import csv
import dataclasses
import json
import signal
import subprocess

import evaluate as evaluate_recipe
import ppo_gnn
import ppo_tuning
import pytest
import torch
from config import Config
from conftest import command
from PIL import Image
from ppo_config import SMOKE, PPOConfig
from task import SUITS
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.checkpoint import load_checkpoint
from redig.envs.factory import make_env
from redig.policy import ACTION, OBSERVATION, load_policy


@pytest.fixture(scope="module")
def smoke_ppo(tmp_path_factory):
    """One complete run at toy size: its folder and what it printed."""
    folder = tmp_path_factory.mktemp("runs") / "smoke"
    done = subprocess.run(
        command("ppo_gnn.py", "--method", "afor", "--smoke", "--out", folder, "--threads", 1),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder, done.stdout


def test_a_run_leaves_what_the_default_recipe_leaves(smoke_ppo):
    folder, printed = smoke_ppo
    metrics = json.loads((folder / "metrics.json").read_text())
    assert {"success_rate", "cfi_0.5", "cloned_success_rate", "last_jerk_mean"} <= set(metrics)
    assert json.loads((folder / "config.json").read_text())["formation_reward"] == "spring_damper_bonus"
    with open(folder / "evaluations.csv") as file:
        assert [row["phase"] for row in csv.DictReader(file)][:2] == ["clone", "online"]
    for name in ("learning_curve.png", "trajectories.png", "trajectories.gif"):
        with Image.open(folder / name) as image:
            assert min(image.size) > 200
    for name in ("policy", "last", "cloned"):
        assert load_policy(folder / f"{name}.safetensors", observation_dim=9)
    assert "team_success_rate" in printed


def test_the_policy_file_is_evaluated_by_the_same_command(smoke_ppo, tmp_path):
    path = smoke_ppo[0] / "policy.safetensors"
    metrics = evaluate_recipe.main(evaluate_recipe.Arguments(path, starts=4, out=tmp_path, animation=False))
    assert metrics["num_starts"] == 4
    for options, message in (
        ({"sampling_steps": 3}, "sampling_steps: .* holds a ppo policy"),
        ({"fixed_latent": True}, "fixed_latent, warm_start: a ppo policy has no chain"),
    ):
        with pytest.raises(ValueError, match=message):
            evaluate_recipe.main(evaluate_recipe.Arguments(path, starts=4, out=tmp_path, **options))


def assert_same_run(first, second):
    one, two = (load_checkpoint(folder / "checkpoint.pt")["loss"] for folder in (first, second))
    different = [key for key in one if isinstance(one[key], torch.Tensor) and not torch.equal(one[key], two[key])]
    assert different == [] and one.keys() == two.keys()
    assert (first / "evaluations.csv").read_text() == (second / "evaluations.csv").read_text()


@pytest.mark.parametrize("phase,step", [("clone", 1), ("online", 2)])
def test_an_interrupted_run_resumes_to_the_same_result(smoke_ppo, tmp_path, monkeypatch, phase, step):
    monkeypatch.setattr(ppo_gnn, "finish", lambda run, config: {})
    loop = ppo_gnn.Run.loop

    def interrupting(self, name, *arguments, **options):
        for i in loop(self, name, *arguments, **options):
            if (name, i) == (phase, step):
                signal.raise_signal(signal.SIGINT)
            yield i

    torch.set_num_threads(1)
    with monkeypatch.context() as patch:
        patch.setattr(ppo_gnn.Run, "loop", interrupting)
        with pytest.raises(SystemExit, match="--resume"):
            ppo_gnn.train(PPOConfig(method="afor", smoke=True, out=tmp_path / "run", threads=1))
    assert load_checkpoint(tmp_path / "run" / "checkpoint.pt")["counters"][phase] == step + 1
    ppo_gnn.train(PPOConfig(resume=tmp_path / "run"))
    assert_same_run(smoke_ppo[0], tmp_path / "run")


def test_without_a_warm_start_nothing_is_cloned(tmp_path, monkeypatch):
    monkeypatch.setattr("finish.draw_crossing", lambda *arguments: None)
    options = {**SMOKE, "clone_updates": 0, "frames": 320}
    metrics = ppo_gnn.train(PPOConfig(method="dgnn", out=tmp_path / "run", threads=1, **options))
    assert "success_rate" in metrics and not (tmp_path / "run" / "cloned.safetensors").exists()
    assert not (tmp_path / "demonstrations").exists()


def test_methods_differ_in_the_reward_alone():
    rewards = {name: PPOConfig(method=name).resolve().scenario() for name in ("dgnn", "afor", "afor_redig_reward")}
    assert rewards["afor_redig_reward"] == Config().resolve().scenario()
    assert rewards["dgnn"]["formation_reward"] == "none"
    assert rewards["afor"]["formation_reward"].startswith("spring_damper")
    given = PPOConfig(method="afor", formation_reward="none", formation_weight=9.0, formation="line").resolve()
    assert (given.formation_reward, given.formation_weight) == ("none", 9.0)
    assert given.arrival_bonus == SUITS["line"]["arrival_bonus"]


def test_frames_are_those_of_the_default_recipe():
    ours, theirs = Config(), PPOConfig()
    assert theirs.frames == ours.num_envs * (ours.warmup_steps + ours.env_steps)
    assert theirs.frames % (theirs.num_envs * theirs.horizon) == 0


@pytest.mark.parametrize(
    "options,message",
    [
        ({"method": "dqn"}, r"method: got 'dqn', allowed are dgnn, afor, afor_redig_reward"),
        ({"frames": 10}, r"frames: got 10, must be at least one round"),
        ({"team_share": 1.5}, r"team_share: got 1.5"),
        ({"epochs": 0}, r"epochs: got 0"),
        ({"formation": "star"}, r"formation: got 'star'"),
    ],
)
def test_bad_options_stop_before_any_training(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        ppo_gnn.train(PPOConfig(out=tmp_path / "run", **options))
    assert not (tmp_path / "run").exists()


def parts(**options):
    """Configuration, policy and loss at a small size."""
    config = PPOConfig(hidden=32, message_width=32, **options).resolve()
    architecture = ppo_gnn.policy_architecture(config, 9)
    policy = ppo_gnn.make_policy(config, architecture)
    return config, policy, ppo_gnn.make_loss(config, architecture, policy)


def test_advantages_against_a_double_loop():
    """On trajectories of the environment with time-outs, restarts and robots that end, at random, before their team."""
    torch.manual_seed(0)
    config, policy, loss = parts(gamma=0.9, gae_lambda=0.8)
    env = make_env(3, max_steps=6, **config.scenario())
    collector = Collector(env, policy, frames_per_batch=3 * 20, total_frames=-1, auto_register_policy_transforms=False)
    data = next(iter(collector))
    info = data["next", "agents", "info"]
    info["terminated"] = (torch.rand_like(info["terminated"]) < 0.1).float()
    data["agents", "info", "arrived"] = (torch.rand_like(info["arrived"]) < 0.3).float()
    reward, truncated, ended = data["next", "agents", "reward"], data["next", "done"], info["terminated"] > 0
    assert truncated.sum() == 3 * 3 and ended.any()  # steps 6, 12 and 18 of each team
    active = data["agents", "info", "arrived"] < 0.5

    critic = loss.critic_network
    with loss.critic_network_params.to_module(critic), torch.no_grad():
        value = critic(data.select(OBSERVATION))["agents", "state_value"]
        following = critic(data["next"].select(OBSERVATION))["agents", "state_value"]
    expected = torch.zeros_like(value)
    for e in range(3):
        for i in range(5):
            for t in range(20):
                weight = 1.0
                for s in range(t, 20):
                    bootstrap = 0.0 if ended[e, s, i] else following[e, s, i]
                    expected[e, t, i] += weight * (reward[e, s, i] + 0.9 * bootstrap - value[e, s, i])
                    if ended[e, s, i] or truncated[e, s]:
                        break
                    weight *= 0.9 * 0.8
    found = ppo_gnn.advantages(loss, ppo_gnn.robot_by_robot(data))
    torch.testing.assert_close(found["agents", "value_target"].view_as(value), expected + value, rtol=1e-4, atol=1e-5)
    standardised = (expected - expected[active].mean()) / expected[active].std()
    torch.testing.assert_close(found["agents", "advantage"].view_as(value), standardised, rtol=1e-3, atol=1e-4)


def test_a_share_of_the_reward_is_the_team_mean():
    config, policy, _ = parts()
    data = make_env(2, **config.scenario()).rollout(3, policy)
    own = data["next", "agents", "reward"].clone()
    for share in (0.0, 0.25, 1.0):
        found = ppo_gnn.robot_by_robot(data.clone(), share)["next", "agents", "reward"]
        torch.testing.assert_close(found, (1 - share) * own + share * own.sum(-2, keepdim=True) / 5)
    assert own.std(-2).max() > 0


def test_robots_that_have_arrived_teach_the_actor_nothing():
    torch.manual_seed(0)
    config, policy, loss = parts()
    env = make_env(4, **config.scenario())
    collector = Collector(
        env, policy, frames_per_batch=80, total_frames=-1, postproc=ppo_gnn.robot_by_robot,
        auto_register_policy_transforms=False,
    )  # fmt: skip
    data = next(iter(collector))
    data[ppo_gnn.ACTIVE][:, :, 2] = False
    batch = ppo_gnn.advantages(loss, data)
    changed = batch.clone()
    changed[ppo_gnn.ADVANTAGE][:, 2] = 100.0
    changed["agents", "action_log_prob"][:, 2] -= 1.0
    before, after = (ppo_gnn.loss_terms(loss, b)["loss_objective"] for b in (batch, changed))
    torch.testing.assert_close(before, after)
    changed[ppo_gnn.ADVANTAGE][:, 1] = 100.0
    assert (ppo_gnn.loss_terms(loss, changed)["loss_objective"] - before).abs() > 1.0


def test_ppo_finds_a_known_answer():
    """One step to live, and a reward for moving to half the offset of the only teammate: the action is known."""
    torch.manual_seed(0)
    config, policy, loss = parts(epochs=4, batch_size=64, initial_std=0.3)
    optimizer = torch.optim.Adam(loss.parameters(), 2e-3)

    def world(teams):
        observation = torch.zeros(teams, 1, 2, 9)
        observation[..., :2] = 2 * torch.rand(teams, 1, 2, 2) - 1
        answer = (observation[..., :2].flip(-2) - observation[..., :2]) * 0.4
        return TensorDict({"agents": {"observation": observation}}, [teams, 1]), answer

    def error():
        data, answer = world(500)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return (policy(data)[ACTION] - answer).square().mean().sqrt().item()

    untrained = error()
    for _ in range(25):
        data, answer = world(256)
        with torch.no_grad():
            policy(data)
        reward = -(data[ACTION] - answer).square().sum(-1, keepdim=True)
        done = torch.ones_like(reward, dtype=torch.bool)
        data["agents", "active"] = done
        data["next"] = TensorDict(
            {"agents": {"observation": data[OBSERVATION], "reward": reward, "done": done, "terminated": done}}, [256, 1]
        )
        for batch in ppo_gnn.minibatches(ppo_gnn.advantages(loss, data), config.epochs, config.batch_size):
            optimizer.zero_grad()
            sum(ppo_gnn.loss_terms(loss, batch).values()).backward()
            torch.nn.utils.clip_grad_norm_(loss.parameters(), config.grad_norm)  # without it some seeds diverge late
            optimizer.step()
    assert untrained > 0.3
    assert error() < 0.1


def test_cloning_meets_the_demonstrated_action():
    torch.manual_seed(0)
    _, policy, _ = parts()
    observation = torch.randn(64, 5, 9)
    wanted = 0.5 * observation[..., 4:6].tanh()
    batch = TensorDict({"agents": {"observation": observation, "action": wanted}}, [64])
    batch["agents", "active"] = torch.rand(64, 5, 1) < 0.7
    batch[ACTION][~batch["agents", "active"].squeeze(-1)] = float("nan")  # must not be looked at
    batch[ACTION] = batch[ACTION].nan_to_num(1e3)
    optimizer = torch.optim.Adam(policy.parameters(), 3e-3)
    for _ in range(200):
        optimizer.zero_grad()
        loss = ppo_gnn.cloning_loss(policy, batch)
        loss.backward()
        optimizer.step()
    assert loss.item() < 0.01


def test_a_trial_is_noted_without_a_final_evaluation(tmp_path, monkeypatch):
    monkeypatch.setattr(ppo_gnn, "finish", None)  # the trial replaces it
    ppo_tuning.main(PPOConfig(smoke=True, seed=11, lr=1e-3, threads=1), out=tmp_path)
    with open(tmp_path / "trials.csv") as file:
        (row,) = csv.DictReader(file)
    assert (row["formation"], row["method"], row["seed"], row["last_updates"]) == ("wedge", "dgnn", "11", "4.0")
    assert {"lr=0.001", "smoke=True", "frames=640"} <= set(row["options"].split())
    assert "gamma" not in row["options"] and "demonstration_speed" not in row["options"]
    assert not list(tmp_path.glob("*/metrics.json"))
    with pytest.raises(ValueError, match="seed: got 0"):
        ppo_tuning.main(PPOConfig(seed=0), out=tmp_path)


def test_help_explains_each_option(printed_help):
    printed = printed_help("ppo_gnn.py")
    for field in dataclasses.fields(PPOConfig):
        assert f"--{field.name.replace('_', '-')}" in printed
