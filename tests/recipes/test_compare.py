import csv
import json
import math
from dataclasses import replace

import compare
import compare_plot
import compare_tuning
import gymnasium
import pytest
import torch
from compare_methods import METHODS
from compare_tasks import Keys, make_env, transitions
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs.utils import set_exploration_type

TINY = {
    "frames": 32, "num_envs": 4, "frames_per_batch": 8, "random_frames": 8, "updates_per_batch": 2, "batch_size": 8,
    "gamma": 0.9, "episode_steps": 4, "evaluation_frames": 16, "episodes": 2, "hidden": 16,
}  # fmt: skip
COLLECTOR = {"auto_register_policy_transforms": False}
RUNS = [(task, method) for task, methods in METHODS.items() for method in methods]


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    for task in METHODS:
        monkeypatch.setitem(compare.BUDGETS, task, TINY | ({"num_envs": 1} if task == "pendulum" else {}))


def run(task, method, out, **options):
    with open(compare.main(compare.Arguments(task, method, out=out, **options)), newline="") as file:
        return list(csv.DictReader(file))


def without_seconds(rows):
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


@pytest.mark.parametrize(("task", "method"), RUNS)
def test_every_method_runs_on_every_task_and_a_seed_repeats(task, method, tmp_path):
    rows = run(task, method, tmp_path / "first")
    assert tuple(rows[0]) == compare.COLUMNS
    assert [row["frames"] for row in rows] == ["0", "16", "32"]
    assert [row["updates"] for row in rows] == ["0", "2", "6"]  # none after the first batch, which is random
    assert math.isnan(float(rows[0]["loss_qvalue"]))
    assert all(math.isfinite(float(value)) for row in rows[1:] for value in row.values())
    config = json.loads((tmp_path / "first" / f"{task}-{method}-seed0.json").read_text())
    assert config["lr"] > 0 and config["frames"] == 32 and config["method"] == method
    assert without_seconds(run(task, method, tmp_path / "again")) == without_seconds(rows)


@pytest.mark.parametrize("task", METHODS)
def test_another_seed_is_another_run(task, tmp_path):
    """Not even the random actions and the losses on them are the same."""
    method = next(iter(METHODS[task]))
    columns = [
        [row["loss_qvalue"] for row in run(task, method, tmp_path, seed=seed) if row["updates"] != "0"]
        for seed in (0, 1)
    ]
    assert all(first != second for first, second in zip(*columns, strict=True))


@pytest.mark.parametrize(("task", "method"), RUNS)
def test_the_policy_that_collects_and_is_evaluated_is_the_one_that_learns(task, method):
    config = compare.Arguments(task, method).config()
    env = make_env(task, 2, 6, seed=0)
    learner = METHODS[task][method](env, config)
    collector = Collector(env, learner.collect, frames_per_batch=16, total_frames=16, **COLLECTOR)
    batch = transitions(next(iter(collector)), Keys.of(env))
    if learner.improved is not None:
        batch[learner.improved] = batch[Keys.of(env).action].clone()
    before = [parameter.detach().clone() for parameter in learner.evaluate.parameters()]
    for _ in range(2):  # TD3 moves its actor at every second update
        learner.update(batch)
    assert before and all(not torch.equal(a, b) for a, b in zip(before, learner.evaluate.parameters(), strict=True))
    assert {p.data_ptr() for p in collector.policy.parameters()} == {
        p.data_ptr() for p in learner.evaluate.parameters()
    }


@pytest.mark.parametrize("task", ["pendulum", "navigation"])
def test_evaluation_leaves_training_as_it_is(task, tmp_path, monkeypatch):
    """Twice as many evaluations change neither the networks nor the frames that training draws."""
    method = next(iter(METHODS[task]))
    rarely = run(task, method, tmp_path / "rarely")
    monkeypatch.setitem(compare.BUDGETS, task, compare.BUDGETS[task] | {"evaluation_frames": 8})
    often = run(task, method, tmp_path / "often")
    assert [row["return_mean"] for row in often if row["frames"] in ("0", "16", "32")] == [
        row["return_mean"] for row in rarely
    ]


def test_return_is_that_of_the_first_episode():
    """Against a loop over Gymnasium's own environment; the rollout goes on into second episodes, which do not count."""
    env = make_env("pendulum", 2, episode_steps=7, seed=3)
    policy = TensorDictModule(lambda x: x[..., 2:].tanh(), in_keys=["observation"], out_keys=["action"])
    returns = compare.evaluate(env, policy, steps=17)
    env.set_seed(compare.EVALUATION_SEED)
    for start, found in zip(env.reset()["observation"], returns, strict=True):
        single = gymnasium.make("Pendulum-v1").unwrapped
        single.reset(seed=0)
        single.state = [math.atan2(start[1], start[0]), start[2].item()]
        observation, total = single._get_obs(), 0.0
        for _ in range(7):
            observation, reward, *_ = single.step([math.tanh(observation[2])])
            total += reward
        assert found.item() == pytest.approx(total, rel=1e-4)


def test_evaluation_is_deterministic_and_restores_the_random_state():
    config = replace(compare.Arguments("navigation", "masac").config(), **TINY)
    env = make_env("navigation", 3, 6, seed=0)
    method = METHODS["navigation"]["masac"](env, config)
    state = torch.get_rng_state()
    with set_exploration_type(None):
        first, second = (compare.evaluate(env, method.evaluate, 6) for _ in range(2))
    assert torch.equal(first, second)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("task", METHODS)
def test_a_time_out_is_no_termination(task):
    """The last step of a truncated episode is done but not terminated, for each agent, so that it is bootstrapped."""
    env = make_env(task, 2, episode_steps=4, seed=0)
    data = env.rollout(4, break_when_any_done=False).reshape(-1)
    keys = Keys.of(env)
    kept = transitions(data, keys)
    done, terminated, reward = (kept["next", key] for key in (keys.done, keys.terminated, keys.reward))
    assert done.shape == terminated.shape == reward.shape
    solved = data["next", "terminated"].squeeze(-1)  # some starts of reverse_transport are solved
    out_of_time = (data["next", "step_count"].squeeze(-1) == 4) & ~solved
    assert out_of_time.any()
    assert done[out_of_time].all() and not terminated[out_of_time].any()
    assert done[solved].all() and terminated[solved].all()
    assert not done[~(solved | out_of_time)].any()


def test_changed_options():
    config = compare.Arguments("pendulum", "sac", change={"lr": 0.5, "frames": 100.0}).config()
    assert config.lr == 0.5
    assert config.frames == 100 and isinstance(config.frames, int)


def test_unknown_names():
    with pytest.raises(ValueError, match="task: got 'chess', allowed are pendulum, "):
        compare.Arguments("chess", "sac").config()
    with pytest.raises(ValueError, match="change: got 'learning_rate', allowed are seed, frames, "):
        compare.Arguments("pendulum", "sac", change={"learning_rate": 1}).config()
    with pytest.raises(ValueError, match="method: got 'maddpg', allowed on pendulum are sac, td3, dipo"):
        compare.Arguments("pendulum", "maddpg").config()


def write_run(folder, method, seed, returns, frames=(0, 10, 30)):
    folder.mkdir(exist_ok=True)
    name = f"pendulum-{method}-seed{seed}"
    (folder / f"{name}.json").write_text(json.dumps({"task": "pendulum", "method": method, "seed": seed}))
    lines = [f"{at},0,{value},1.0,{at}.0,nan,nan" for at, value in zip(frames, returns, strict=True)]
    (folder / f"{name}.csv").write_text("\n".join([",".join(compare.COLUMNS), *lines]) + "\n")


def test_table_and_figure(tmp_path):
    write_run(tmp_path / "runs", "sac", 0, (-10, 0, 4))
    write_run(tmp_path / "runs", "sac", 1, (-10, 0, 8))
    write_run(tmp_path / "runs", "dipo", 0, (-10, -10, -10))
    out = tmp_path / "summary"
    table = compare_plot.main(compare_plot.Arguments(tmp_path / "runs", out))
    # final 4 and 8; areas (-5 * 10 + 2 * 20) / 30 = -1/3 and (-5 * 10 + 4 * 20) / 30 = 1
    assert "| pendulum | sac | 2 | 6 ± 2.8 | 0.3333 ± 0.94 | 30 ± 0 |" in table
    assert "| pendulum | dipo | 1 | -10 ± 0 | -10 ± 0 | 30 ± 0 |" in table
    assert (out / "table.md").read_text() == table
    assert (out / "curves.png").stat().st_size > 5000
    with open(out / "curves.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["method"], row["seed"]) for row in rows[::3]] == [("sac", "0"), ("sac", "1"), ("dipo", "0")]


def test_plot_refuses_what_it_cannot_average(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no TASK-METHOD"):
        compare_plot.read(tmp_path)
    write_run(tmp_path, "sac", 0, (0, 1, 2))
    write_run(tmp_path, "td3", 0, (0, 1, 2), frames=(0, 10, 20))
    with pytest.raises(ValueError, match="on pendulum differ .*: 20 frames, every 10; 30 frames, every 10"):
        compare_plot.read(tmp_path)


def test_tuning_runs_the_grid_once(tmp_path, monkeypatch):
    monkeypatch.setattr(compare_tuning, "FRAMES", {"single": 32, "team": 32})
    arguments = compare_tuning.Arguments(("pendulum", "navigation"), ("td3", "masac"), out=tmp_path)
    rows = compare_tuning.main(arguments)
    assert [(row["task"], row["method"], row["lr"], row["alpha_init"]) for row in rows] == [
        ("pendulum", "td3", 3e-4, 1.0),
        ("pendulum", "td3", 1e-3, 1.0),
        ("navigation", "masac", 3e-4, 1.0),
        ("navigation", "masac", 3e-4, 0.01),
        ("navigation", "masac", 1e-3, 1.0),
        ("navigation", "masac", 1e-3, 0.01),
    ]
    config = json.loads((tmp_path / "lr0.001-alpha0.01" / "navigation-masac-seed100.json").read_text())
    assert (config["lr"], config["alpha_init"], config["frames"], config["seed"]) == (1e-3, 0.01, 32, 100)
    monkeypatch.setattr(compare, "main", None)  # the second time there is nothing left to run
    assert compare_tuning.main(arguments) == rows
    with open(tmp_path / "tuning.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == 6
    with pytest.raises(ValueError, match="seed: got 0, must be at least 100"):
        compare_tuning.main(compare_tuning.Arguments(seed=0, out=tmp_path))
