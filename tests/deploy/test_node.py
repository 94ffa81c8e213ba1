import math
from threading import Event, Thread

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.deploy.drive import LIMO, DifferentialDrive
from redig.deploy.messages import RobotState
from redig.deploy.module import ModulePolicy
from redig.deploy.node import REST, RobotNode, Wheels, holonomic
from redig.deploy.pilot import Pilot
from redig.deploy.robot import RobotPolicy
from redig.deploy.transport import BodyVelocity, Radio, Sensed
from redig.policy import PolicyConfig, build_policy, save_policy

NAMES = [f"robot_{i}" for i in range(5)]


def state_of(robot, row, stamp=0.0):
    x, y, vx, vy, gx, gy, distance, ox, oy = row
    return RobotState(robot, stamp, (x, y), (vx, vy), (x + gx, y + gy), distance, (ox, oy))


@pytest.fixture(scope="module")
def policy_file(tmp_path_factory):
    torch.manual_seed(0)
    config = PolicyConfig(observation_dim=9, sampling_steps=5, noise_ratio=0.0, hidden=(32, 32))
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    save_policy(path, build_policy(config), config)
    return path


@pytest.fixture(scope="module")
def robot_policy(policy_file):
    return RobotPolicy(ModulePolicy(policy_file))


def test_nodes_command_what_the_policy_of_the_team_does(policy_file, robot_policy):
    from redig.policy import load_policy

    rows = torch.randn(5, 9) / 2
    rows[:, 7:] /= rows[:, 7:].norm(dim=-1, keepdim=True)
    rows[:, 4:6] += 3
    team = TensorDict({"agents": {"observation": rows.unsqueeze(0)}}, [1])
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        expected = load_policy(policy_file)(team)["agents", "action"][0]
    radio = Radio()
    transports = [radio.join(name) for name in NAMES]
    nodes = [
        RobotNode(transport, Pilot(name, NAMES, robot_policy, max_speed=10.0), clock=lambda: 0.0)
        for name, transport in zip(NAMES, transports, strict=True)
    ]
    for name, transport, row, node in zip(NAMES, transports, rows.tolist(), nodes, strict=True):
        transport.sensed = Sensed(state_of(name, row), heading=0.0)
        node.tell()
    for node in nodes:
        node.act()
    commands = torch.tensor([[transport.commanded.forward, transport.commanded.left] for transport in transports])
    torch.testing.assert_close(commands, expected, rtol=0, atol=5e-5)  # float32 all the way


anything = st.one_of(st.floats(), st.none(), st.text(max_size=3), st.integers())
pair = st.one_of(st.tuples(anything, anything), st.tuples(st.floats(-1, 1), st.floats(-1, 1)), anything)
garbage = st.builds(RobotState, st.one_of(st.sampled_from(NAMES), anything), anything, pair, pair, pair, anything, pair)


@given(messages=st.lists(garbage, max_size=20), own=garbage, heading=st.floats())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_nothing_that_is_sent_breaks_it_or_its_limits(robot_policy, messages, own, heading):
    radio = Radio()
    transport = radio.join("robot_0")
    node = RobotNode(transport, Pilot("robot_0", NAMES, robot_policy, max_speed=0.5), clock=lambda: radio.now)
    for step, message in enumerate([*messages, own]):
        radio.now = 0.1 * step
        good = state_of("robot_0", [0.0, 0.0, 0.1, 0.0, 5.0, 0.0, 1.0, 0.0, 1.0], stamp=radio.now)
        transport.sensed = Sensed(own if message is own else good, heading if message is own else 0.3)
        radio.send("someone", message)
        node.step()
        assert all(map(math.isfinite, transport.commanded))
        assert math.hypot(transport.commanded.forward, transport.commanded.left) <= 0.5 + 1e-9


class Broken:
    """A transport that fails now and then."""

    def __init__(self):
        self.rounds, self.commands, self.stop = 0, [], Event()

    def sense(self):
        self.rounds += 1
        if self.rounds > 20:
            self.stop.set()
        if self.rounds % 2:
            raise OSError("network is down")
        return Sensed(state_of("robot_0", [0.0, 0.0, 0.0, 0.0, 5.0, 0.0, 1.0, 0.0, 1.0], self.rounds), 0.0)

    def send(self, sensed):
        pass

    def receive(self):
        return []

    def command(self, velocity):
        self.commands.append(velocity)


def test_loop_goes_on_when_a_round_fails_and_ends_at_rest(caplog):
    transport = Broken()
    node = RobotNode(transport, Pilot("robot_0", [], lambda own, neighbours: (0.5, 0.0), own_timeout=60.0))
    loop = Thread(target=node.run, args=(1000.0, transport.stop))
    loop.start()
    loop.join(30)
    assert not loop.is_alive()
    assert transport.commands[:2] == [REST, BodyVelocity(0.5, 0.0, 0.0)] and transport.commands[-1] == REST
    assert [record.message for record in caplog.records] == ["standing: OSError: network is down"]


def test_bad_rate():
    with pytest.raises(ValueError, match="rate: got 0 Hz"):
        RobotNode(Broken(), Pilot("robot_0", [], lambda own, neighbours: (0, 0))).run(0, Event())


@given(speed=st.floats(0, 2), angle=st.floats(-4, 4), heading=st.floats(-10, 10))
def test_holonomic_is_the_velocity_along_the_axes_of_the_robot(speed, angle, heading):
    forward, left, turn = holonomic((speed * math.cos(angle), speed * math.sin(angle)), heading)
    back = complex(forward, left) * complex(math.cos(heading), math.sin(heading))
    assert abs(back - speed * complex(math.cos(angle), math.sin(angle))) < 1e-9 and turn == 0


def test_wheels_follow_the_drive_and_stand_at_once():
    now = [0.0]
    wheels, oracle = Wheels(DifferentialDrive(LIMO), clock=lambda: now[0]), DifferentialDrive(LIMO)
    wheels((0.0, 0.0), 0.0)
    for _ in range(10):
        now[0] += 0.05
        linear, angular = oracle((0.5, 0.2), 0.1, 0.05)
        assert wheels((0.5, 0.2), 0.1) == pytest.approx((linear, 0.0, angular))
    now[0] += 0.05
    assert wheels((0.0, 0.0), 0.1) == REST
