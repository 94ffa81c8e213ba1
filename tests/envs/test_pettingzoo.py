import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from pettingzoo.test import parallel_api_test, parallel_seed_test
from tensordict import TensorDict
from torchrl.envs import PettingZooWrapper, check_env_specs
from torchrl.envs.utils import ExplorationType, MarlGroupMapType, set_exploration_type
from vmas.simulator.environment.environment import Environment

from redig.envs import make_env
from redig.envs.pettingzoo import FormationNavigationParallelEnv
from redig.policy import load_policy, read_header
from redig.viz.scene import PALETTE

ROOT = Path(__file__).parents[2]
POLICY = ROOT / "recipes" / "policies" / "wedge.safetensors"
pytestmark = pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested")


def drive(env, act, *resets):
    """Observations, rewards, terminations, truncations and infos of a whole episode, one tuple a step."""
    for reset in resets:
        observations, infos = env.reset(seed=reset)
    steps = [(observations, {}, {}, {}, infos)]
    while env.agents:
        steps.append(env.step(act(steps[-1][0])))
    return steps


def to_goal(observations):
    """Commands that lead straight to the goals."""
    return {agent: np.clip(observation[4:6], -1, 1) for agent, observation in observations.items()}


def wander(observations):
    """Commands that depend on the agent and on where it is, and lead into walls."""
    return {agent: np.sin(9 * observation[:2] + i) for i, (agent, observation) in enumerate(observations.items())}


def same(first, second):
    np.testing.assert_equal(first, second)  # compares nested containers, exactly
    return True


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("arguments", [{}, {"formation": "line", "n_robots": 3, "observe_direction": False}])
def test_pettingzoo_accepts_it(arguments):
    env = FormationNavigationParallelEnv(max_steps=25, **arguments)
    parallel_api_test(env, num_cycles=100)
    parallel_seed_test(lambda: FormationNavigationParallelEnv(max_steps=25, **arguments))


@pytest.mark.parametrize(
    ("act", "arguments", "ending"),
    [
        (to_goal, {"corridor_width": 4.0, "reward_scale": 0.5}, "terminated"),
        (wander, {"max_steps": 40, "formation": "line", "start_distance": 1.5}, "truncated"),
    ],
)
def test_every_step_is_that_of_the_torchrl_environment(act, arguments, ending):
    native = make_env(1, **arguments)
    native.set_seed(5)
    data = native.reset()
    env = FormationNavigationParallelEnv(**arguments)
    steps = drive(env, act, 5)
    for k, (observations, rewards, terminations, truncations, infos) in enumerate(steps):
        assert list(observations) == list(infos) == env.possible_agents
        assert same(list(observations.values()), list(data["agents", "observation"][0].numpy()))
        for i, info in enumerate(infos.values()):
            assert same(info, {key: value[0, i].numpy() for key, value in data["agents", "info"].items()})
        if k > 0:
            assert rewards == dict(zip(env.possible_agents, data["agents", "reward"].flatten().tolist(), strict=True))
            assert terminations == dict.fromkeys(env.possible_agents, data["terminated"].item())
            assert truncations == dict.fromkeys(env.possible_agents, data["truncated"].item())
        assert data["done"].item() == (k == len(steps) - 1)
        team = torch.tensor(np.stack(list(act(observations).values())))
        data = native.step(data.set(("agents", "action"), team[None]))["next"]
    last = {"terminated": terminations, "truncated": truncations}
    assert {name for name, flags in last.items() if all(flags.values())} == {ending}


def test_the_seed_decides_a_whole_run_and_no_other_random_state_matters():
    def starts(disturb):
        env = FormationNavigationParallelEnv(max_steps=3)
        found = [env.reset(seed=8)[0]]
        for _ in range(3):
            if disturb:
                torch.rand(3)
                FormationNavigationParallelEnv(seed=1).reset(seed=2)
                make_env(2).reset()
            env.step(to_goal(found[-1]))
            found.append(env.reset()[0])
        return found

    found = starts(disturb=True)
    assert same(found, starts(disturb=False))
    assert not np.array_equal(found[1]["agents_0"], found[2]["agents_0"])


def test_torch_and_vmas_draw_the_same_as_without_it():
    def draw(beside):
        torch.manual_seed(0)
        np.random.seed(0)
        native = make_env(2)
        native.set_seed(0)
        state = Environment.vmas_random_state
        if beside:
            drive(FormationNavigationParallelEnv(max_steps=3), wander, 4, None)
        assert Environment.vmas_random_state is state
        return torch.rand(3), torch.from_numpy(np.random.rand(3)), native.reset()["agents", "observation"]

    for expected, found in zip(draw(beside=False), draw(beside=True), strict=True):
        assert torch.equal(expected, found)


def test_environments_side_by_side_run_as_if_alone():
    first, second = (FormationNavigationParallelEnv(max_steps=6, seed=seed) for seed in (1, 2))
    runs = [[env.reset()] for env in (first, second)]
    for _ in range(6):
        for env, run in zip((first, second), runs, strict=True):
            run.append(env.step(wander(run[-1][0])))
    for seed, run in zip((1, 2), runs, strict=True):
        alone = drive(FormationNavigationParallelEnv(max_steps=6, seed=seed), wander, None)
        assert same([step[0] for step in run], [step[0] for step in alone])


def test_the_shipped_policy_crosses_the_corridor_as_in_the_torchrl_environment():
    _, scenario = read_header(POLICY)
    env = FormationNavigationParallelEnv(**scenario)
    wrapped = PettingZooWrapper(FormationNavigationParallelEnv(**scenario))
    native = make_env(1, **scenario)
    policy = load_policy(POLICY)

    def act(observations):
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            _, actions = policy(torch.from_numpy(np.stack(list(observations.values()))))
        return dict(zip(observations, actions.numpy(), strict=True))

    for seed in range(3):
        observations, *_, infos = zip(*drive(env, act, seed, None), strict=True)
        wrapped.set_seed(seed)  # resets, so the rollout's start is the second that is drawn
        native.set_seed(seed)
        native.reset()
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            rollouts = wrapped.rollout(200, policy), native.rollout(200, policy).squeeze(0)
        track = torch.tensor(np.stack([list(step.values()) for step in observations[1:]]))
        for rollout in rollouts:
            torch.testing.assert_close(rollout["next", "agents", "observation"], track, rtol=0, atol=1e-4)
            assert rollout["next", "terminated"][-1]
        assert all(info["arrived"] == 1 for info in infos[-1].values())
        assert not any(info["collision"] for step in infos for info in step.values())


def test_torchrl_finds_the_keys_of_our_policies_and_of_the_native_environment():
    env = PettingZooWrapper(FormationNavigationParallelEnv(max_steps=5))
    check_env_specs(env)
    assert env.group_map == {"agents": [f"agents_{i}" for i in range(5)]}
    grouped = PettingZooWrapper(
        FormationNavigationParallelEnv(max_steps=5), group_map=MarlGroupMapType.ALL_IN_ONE_GROUP
    )
    assert grouped.group_map == env.group_map
    found, native = env.rollout(9)[-1], make_env(1, max_steps=5).rollout(9)[0, -1]
    own = {("agents", flag) for flag in ("done", "terminated", "truncated")}

    def shapes(data: TensorDict):
        keys = data["next"].keys(True, True)
        return {key: data["next", key].shape for key in keys if key not in own and key != "step_count"}

    assert shapes(found) == shapes(native)
    assert found["next", "agents", "truncated"].all() and found["next", "agents", "done"].shape == (5, 1)
    assert not found["next", "agents", "terminated"].any()


def test_spaces():
    env = FormationNavigationParallelEnv(max_speed=0.8, n_robots=3, formation="line")
    observations, _ = env.reset(seed=0)
    assert env.state_space.contains(env.state())
    assert same(env.state(), np.concatenate(list(observations.values())))
    for agent in env.possible_agents:
        action, observation = env.action_space(agent), env.observation_space(agent)
        assert same((action.low, action.high), (np.float32([-0.8, -0.8]), np.float32([0.8, 0.8])))
        assert action.dtype == observation.dtype == np.float32
        assert observation.contains(observations[agent])
    assert len({id(env.action_space(agent)) for agent in env.possible_agents}) == 3


def test_what_a_caller_does_to_its_arrays_stays_outside():
    env, other = (FormationNavigationParallelEnv(max_steps=4) for _ in range(2))
    observations, infos = env.reset(seed=0)
    actions = to_goal(observations)
    for agent in env.agents:
        observations[agent].fill(7)
        for value in infos[agent].values():
            value.fill(7)
    env.state().fill(7)
    other.reset(seed=0)
    assert same(env.state(), other.state())
    assert same(env.step(actions), other.step(actions))


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            [np.nan, 0.0],
            r"actions\['agents_2'\]: got \[nan, 0\.0\], must be 2 finite numbers from -1\.0 to 1\.0 \(m/s\)",
        ),
        ([0.0, 1.5], r"actions\['agents_2'\]: got \[0\.0, 1\.5\]"),
        ([0.0, -np.inf], r"actions\['agents_2'\]: got \[0\.0, -inf\]"),
        ([0.0], r"actions\['agents_2'\]: got \[0\.0\], must be 2"),
        ([[0.0, 0.0]], r"actions\['agents_2'\]: got \[\[0\.0, 0\.0\]\]"),
    ],
)
def test_a_bad_action_is_refused_by_name_and_changes_nothing(command, message):
    env = FormationNavigationParallelEnv()
    observations, _ = env.reset(seed=0)
    before = env.state()
    with pytest.raises(ValueError, match=message):
        env.step({**to_goal(observations), "agents_2": command})
    assert same(env.state(), before)


def test_actions_of_others_than_the_agents_are_refused():
    env = FormationNavigationParallelEnv(n_robots=3)
    actions = to_goal(env.reset()[0])
    with pytest.raises(ValueError, match=r"actions: got those of agents_0, agents_2, .* agents_0, agents_1, agents_2$"):
        env.step({agent: actions[agent] for agent in ("agents_0", "agents_2")})
    with pytest.raises(ValueError, match="actions: got those of .*, robot_0, must be one for each of agents_0"):
        env.step({**actions, "robot_0": actions["agents_0"]})
    with pytest.raises(ValueError, match="actions: got those of nobody"):
        env.step({})


def test_a_step_needs_an_episode():
    env = FormationNavigationParallelEnv(max_steps=1)
    actions = dict.fromkeys(env.possible_agents, (0.0, 0.0))
    with pytest.raises(RuntimeError, match="state: no episode has begun; call reset first"):
        env.state()
    with pytest.raises(RuntimeError, match="step: no episode is under way; call reset first"):
        env.step(actions)
    env.reset()
    env.step(actions)
    with pytest.raises(RuntimeError, match="call reset first"):
        env.step(actions)
    env.close()
    env.close()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"render_mode": "human"}, ValueError, "render_mode: got 'human', allowed are rgb_array and None"),
        ({"formation": "star"}, ValueError, "star"),
        ({"max_steps": 0}, ValueError, "max_steps: got 0"),
        ({"num_robots": 3}, TypeError, "num_robots"),
        ({"num_envs": 3}, TypeError, "num_envs"),
    ],
)
def test_bad_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        FormationNavigationParallelEnv(**arguments)


def test_pictures_show_the_team_on_its_way():
    env = FormationNavigationParallelEnv(render_mode="rgb_array", dt=0.05)
    assert env.metadata["render_fps"] == 20

    def column(frame):
        distance = np.abs(frame.astype(float) - 255 * np.array(to_rgb(PALETTE[0]))).max(-1)
        return np.nonzero(distance < 24)[1].max()  # of the leading robot's foremost point

    for seed in (0, 1):
        observations, _ = env.reset(seed=seed)
        frames = [env.render()]
        for _ in range(2):
            for _ in range(5):
                observations, *_ = env.step(to_goal(observations))
            frames.append(env.render())
        assert all(frame.dtype == np.uint8 and frame.shape == frames[0].shape for frame in frames)
        assert frames[0].ndim == 3 and frames[0].shape[-1] == 3
        assert column(frames[0]) + 5 < column(frames[1]) < column(frames[2])


def test_without_a_render_mode_there_is_no_picture():
    env = FormationNavigationParallelEnv()
    env.reset()
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert env.render() is None


def test_the_documented_example_runs(monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "pettingzoo.md").read_text(), re.DOTALL)
    monkeypatch.chdir(ROOT)
    names = {}
    exec(code, names)
    assert names["crossing"]["next", "terminated"][-1]
    assert all(info["arrived"] for info in names["infos"].values())


def test_pettingzoo_is_optional(monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "redig"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pettingzoo", None)  # as if it were not installed
    importlib.import_module("redig.envs")
    with pytest.raises(ImportError, match=r"needs PettingZoo: pip install 'redig\[pettingzoo\]'"):
        importlib.import_module("redig.envs.pettingzoo")
