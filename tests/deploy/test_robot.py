import shutil
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.deploy import ModulePolicy, RobotPolicy, RobotState, export_policy
from redig.deploy import load_policy as load_exported
from redig.envs.factory import make_env
from redig.modules import DDIM, DDPM, DPMSolver
from redig.policy import ACTION, OBSERVATION, PolicyConfig, build_policy, load_policy, read_header, save_policy

SHIPPED = "recipes/policies/wedge.safetensors"
SMALL = PolicyConfig(
    9,
    (-0.5, -1.0),
    (2.0, 0.5),
    embedding_dim=6,
    encoder_hidden=6,
    hidden=(8, 4),
    diffusion_steps=12,
    schedule="linear",
    sampling_steps=6,
)
STEPS, RADIUS = SMALL.sampling_steps, SMALL.radius
KINDS = ("onnx", "module")


@pytest.fixture(scope="module")
def team():
    torch.manual_seed(0)
    return build_policy(SMALL)


@pytest.fixture(scope="module")
def files(team, tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    save_policy(folder / "policy.safetensors", team, SMALL, {"formation": "line"})
    for stochastic in (False, True):
        name = "stochastic" if stochastic else "plain"
        export_policy(team, folder / f"{name}.onnx", SMALL, {"formation": "line"}, ego=True, stochastic=stochastic)
    return folder


@pytest.fixture(scope="module")
def robots(files):
    """One robot's policy by kind of file, and whether it is stochastic."""
    return {
        ("onnx", False): RobotPolicy(files / "plain.onnx"),
        ("onnx", True): RobotPolicy(str(files / "stochastic.onnx")),
        ("module", False): RobotPolicy(files / "policy.safetensors"),
        ("module", True): RobotPolicy(ModulePolicy(files / "policy.safetensors", stochastic=True)),
    }


def states_of(observation):
    """What robots with these observations know of themselves."""
    return [
        RobotState(
            f"robot_{i}", 0.0, tuple(row[:2]), tuple(row[2:4]), tuple(row[:2] + row[4:6]), row[6], tuple(row[7:])
        )
        for i, row in enumerate(np.asarray(observation, float))
    ]


def batched(team, observation, heard, latent=None, noise=None):
    """Actions ``[n, 2]`` of the whole team at once, where i hears j if ``heard[i, j]`` and it is near."""
    position = observation[:, :2].astype(float)
    near = np.linalg.norm(position[:, None] - position, axis=-1) <= RADIUS
    robot, sender = np.nonzero(near & heard & ~np.eye(len(position), dtype=bool))
    edges = torch.from_numpy(np.stack([sender, robot]))
    encoder, actor = team
    given = [] if latent is None else [torch.from_numpy(value) for value in (latent, *noise)]
    with pytest.MonkeyPatch.context() as patch, torch.no_grad():
        kind = ExplorationType.DETERMINISTIC if latent is None else ExplorationType.RANDOM
        patch.setattr(torch, "randn", lambda shape, **_: given.pop(0).reshape(shape))
        with set_exploration_type(kind):
            embedding = encoder.module.forward_sparse(torch.from_numpy(observation), edges)
            action = actor.module(embedding).numpy()
    assert not given
    return action


@st.composite
def crowds(draw, most=8):
    """Observations ``[n, 9]`` on a grid that no two robots are a radius apart on, and who hears whom."""
    n = draw(st.integers(1, most))
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    observation = generator.normal(0, draw(st.sampled_from([0.1, 1.0, 3.0])), (n, 9)).astype(np.float32)
    position = draw(st.lists(st.tuples(st.integers(-30, 30), st.integers(-30, 30)), min_size=n, max_size=n))
    observation[:, :2] = 0.137 * np.array(position)  # 2 / 0.137 is not the root of an integer, so none is at the radius
    angle = generator.uniform(0, 2 * np.pi, n)
    observation[:, 7:] = np.stack([np.cos(angle), np.sin(angle)], -1)
    return observation, generator.random((n, n)) < draw(st.sampled_from([0.0, 0.5, 0.9, 1.0]))


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=60)
@given(crowd=crowds(), stochastic=st.booleans(), seed=st.integers(0, 1000))
def test_robots_act_as_the_whole_team_does_with_the_edges_they_have(team, robots, kind, crowd, stochastic, seed):
    observation, heard = crowd
    states, generator = states_of(observation), np.random.default_rng(seed)
    latent = generator.standard_normal((len(states), 2), np.float32) if stochastic else None
    noise = generator.standard_normal((STEPS - 1, len(states), 2), np.float32) if stochastic else None
    expected = batched(team, observation, heard, latent, noise)
    for i, own in enumerate(states):
        drawn = {"latent": latent[i], "noise": noise[:, i]} if stochastic else {}
        mates = [mate for j, mate in enumerate(states) if j != i and heard[i, j]]
        generator.shuffle(mates)
        np.testing.assert_allclose(robots[kind, stochastic](own, mates, **drawn), expected[i], atol=1e-5)


def test_the_tests_teams_differ(team):
    """With saturated actions, or neighbours that make no difference, the test above would show nothing."""
    generator = np.random.default_rng(0)
    observation = generator.standard_normal((200, 9)).astype(np.float32)
    everyone = batched(team, observation, np.ones((200, 200), bool))
    nobody = batched(team, observation, np.zeros((200, 200), bool))
    inside = (everyone > np.array(SMALL.action_low) + 1e-3) & (everyone < np.array(SMALL.action_high) - 1e-3)
    assert inside.mean() > 0.5 and (np.abs(everyone - nobody).max(-1) > 1e-3).mean() > 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_more_neighbours_than_any_team_has_had(team, robots, kind):
    observation = np.random.default_rng(1).standard_normal((60, 9)).astype(np.float32)
    observation[:, 7:] = [1.0, 0.0]
    own, *mates = states_of(observation)
    expected = batched(team, observation, np.ones((60, 60), bool))[0]
    np.testing.assert_allclose(robots[kind, False](own, mates), expected, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_neighbour_out_of_range_makes_no_difference(robots, kind):
    own, near, far = states_of([[0.0] * 9, [1.0] + [0.0] * 8, [2.001] + [0.0] * 8])
    robot = robots[kind, False]
    np.testing.assert_allclose(robot(own, [near, far]), robot(own, [near]), atol=1e-6)
    np.testing.assert_allclose(robot(own, [replace(far, position=(1e6, -1e6))]), robot(own), atol=1e-6)
    assert np.abs(robot(own, [replace(far, position=(1.999, 0.0))]) - robot(own)).max() > 1e-4


@pytest.mark.parametrize(
    "sampler, changes",
    [
        (DDPM(None, 0.5, 7), {"aggregation": "mean"}),
        (DDIM(5, eta=0.7), {"encoder": "linear", "encoder_activation": None}),
        (DPMSolver(4), {"aggregation": "sum"}),
    ],
    ids=str,
)
def test_module_policy_equals_the_exported_one(sampler, changes, tmp_path):
    torch.manual_seed(3)
    policy = build_policy(replace(SMALL, **changes))
    save_policy(tmp_path / "policy.safetensors", policy, replace(SMALL, **changes))
    with_sampler = load_policy(tmp_path / "policy.safetensors", sampler=sampler)
    export_policy(with_sampler, tmp_path / "robot.onnx", stochastic=True, ego=True)
    exported = load_exported(tmp_path / "robot.onnx", seed=5)
    module = ModulePolicy(tmp_path / "policy.safetensors", sampler=sampler, stochastic=True, seed=5)
    generator = np.random.default_rng(0)
    for n in (1, 4):  # the second one shows that both have drawn as many numbers
        observation = generator.standard_normal((n, 9))
        np.testing.assert_allclose(module(observation), exported(observation), atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_five_robots_drive_as_the_shipped_policy_drives_the_team(tmp_path, kind):
    policy, (config, scenario) = load_policy(SHIPPED), read_header(SHIPPED)
    path = SHIPPED
    if kind == "onnx":
        export_policy(policy, path := tmp_path / "robot.onnx", config, scenario, ego=True)
    robot, difference = RobotPolicy(path), []
    assert robot.environment["formation"] == "wedge" and robot.config["radius"] == 2.0
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        drive = make_env(1, seed=3, **scenario).rollout(70, policy)[0]
    for observation, actions in zip(drive[OBSERVATION].numpy(), drive[ACTION].numpy(), strict=True):
        states = states_of(observation)
        ours = [robot(own, [mate for mate in states if mate is not own]) for own in states]
        difference.append(np.abs(np.array(ours) - actions).max())
    assert len(difference) > 30 and max(difference) < 1e-5


def test_policies_of_the_papers_state_leave_the_direction_out(tmp_path):
    config = replace(SMALL, observation_dim=7)
    save_policy(tmp_path / "policy.safetensors", policy := build_policy(config), config)
    robot = RobotPolicy(tmp_path / "policy.safetensors")
    observation = np.random.default_rng(0).standard_normal((3, 9)).astype(np.float32)
    observation[:, 7:] = [0.0, 1.0]
    own, *mates = states_of(observation)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        embedding = policy[0].module(torch.from_numpy(observation[:, :7]))
        expected = policy[1].module(embedding)[0].numpy()
    np.testing.assert_allclose(robot(own, mates), expected, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_malformed_input(robots, kind):
    robot = robots[kind, False]
    own, mate, other = states_of([[0.0] * 9, [1.0] + [0.0] * 8, [0.5] + [0.0] * 8])
    with pytest.raises(ValueError, match="neighbours: got more than one state of robot_1"):
        robot(own, [mate, other, mate])
    with pytest.raises(ValueError, match="neighbours: got more than one state of robot_0"):
        robot(own, [replace(mate, robot="robot_0")])
    with pytest.raises(ValueError, match="velocity of robot_2: got"):
        robot(own, [mate, replace(other, velocity=(np.nan, 0.0))])
    with pytest.raises(ValueError, match="position of robot_0: got"):
        robot(replace(own, position=(np.inf, 0.0)))
    with pytest.raises(ValueError, match="latent: this policy takes none"):
        robot(own, [mate], latent=np.zeros(2))
    with pytest.raises(ValueError, match=r"latent: got shape \[3\], expected \[2\]"):
        robots[kind, True](own, [mate], latent=np.zeros(3))
    with pytest.raises(ValueError, match=r"noise: got shape \[2, 2\], expected \[5, 2\]"):
        robots[kind, True](own, [mate], noise=np.zeros((2, 2)))


def test_module_policy_refuses_other_observations(files):
    network = ModulePolicy(files / "policy.safetensors")
    for shape in ((9,), (0, 9), (3, 7), (1, 3, 9)):
        with pytest.raises(ValueError, match=r"observation: got shape .*, expected \[n, 9\]"):
            network(np.zeros(shape))
    with pytest.raises(ValueError, match="not finite"):
        network(np.full((2, 9), np.nan))


def test_seeds(files):
    own, mate = states_of([[0.0] * 9, [1.0] + [0.0] * 8])
    path = files / "policy.safetensors"
    first, again, other = (RobotPolicy(ModulePolicy(path, stochastic=True, seed=seed)) for seed in (1, 1, 2))
    actions = first(own, [mate])
    assert np.array_equal(actions, again(own, [mate]))
    assert not np.array_equal(actions, first(own, [mate])) and not np.array_equal(actions, other(own, [mate]))


def test_files_that_are_no_policy_of_one_robot(files, tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        RobotPolicy("no/such/policy.onnx")
    with pytest.raises(FileNotFoundError, match="no such file"):
        RobotPolicy("no/such/policy.safetensors")
    with pytest.raises(ValueError, match=r"policy: got policy.pt, must be a .onnx or .safetensors file"):
        RobotPolicy("policy.pt")
    shutil.copy(files / "plain.onnx", tmp_path / "policy.safetensors")
    with pytest.raises(ValueError, match="is not a safetensors file"):
        RobotPolicy(tmp_path / "policy.safetensors")
    network = SimpleNamespace(config=None, environment={}, ego=False, width=9)
    with pytest.raises(ValueError, match="it acts for whole teams; export it with ego=True"):
        RobotPolicy(network)
    network.ego, network.width = True, 6
    with pytest.raises(ValueError, match="reads 6 numbers a robot, those of the scenario are 7 or 9"):
        RobotPolicy(network)


PROGRAM = """
import sys
from redig.deploy import RobotPolicy, RobotState
robot = RobotPolicy(sys.argv[1])
own = RobotState("robot_0", 0.0, (0.0, 0.0), (0.0, 0.0), (5.0, 0.0), 0.9, (0.0, 1.0))
assert robot(own).shape == (2,)
heavy = {"torch", "torchrl", "tensordict", "torch_geometric", "vmas", "safetensors", "onnx"} & set(sys.modules)
assert not heavy, heavy
"""


def test_robots_with_exported_policies_need_no_torch(files):
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(files / "plain.onnx")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
