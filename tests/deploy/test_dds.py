"""Robots over DDS: between themselves, byte for byte as ROS 2 writes it, and with a real ROS 2 peer if there is one.

The last needs ``REDIG_RCLPY_PYTHON``: a Python with rclpy, such as of a virtual environment with
``pip install ros-rclpy ros-geometry-msgs ros-rmw-fastrtps-cpp``.
"""

import json
import logging
import math
import os
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("cyclonedds", reason="needs pip install 'redig[ros2]'")

from redig.deploy import ros2_types
from redig.deploy.dds import DDSTransport, DDSWorld, Network, _Reader, _StateWriter
from redig.deploy.events import Events
from redig.deploy.messages import RobotState
from redig.deploy.node import RobotNode
from redig.deploy.pilot import Pilot
from redig.deploy.transport import BodyVelocity, Sensed

DOMAIN = 1 + os.getpid() % 99  # of this process alone
PEER = Path(__file__).with_name("ros2_peer.py")
STATE = RobotState("robot_0", 1.5, (1.0, 2.0), (0.25, 0.0), (6.0, 0.0), 0.5, (0.0, -1.0))
MATE = RobotState("robot_1", 1.5, (1.5, 2.0), (0.0, 0.5), (6.5, 0.0), 0.75, (0.0, -1.0))


def until(condition, seconds=20.0):
    """Tries until it is true, and returns what it gives."""
    end = time.monotonic() + seconds
    while not (result := condition()) and time.monotonic() < end:
        time.sleep(0.02)
    assert result
    return result


@pytest.fixture
def world():
    world = DDSWorld(["robot_0", "robot_1"], domain_id=DOMAIN)
    yield world
    world.close()


@pytest.fixture
def transport():
    transport = DDSTransport("/robot_0", ["robot_0", "robot_1"], domain_id=DOMAIN)
    yield transport
    transport.close()


def test_own_state_and_command(world, transport):
    def sense():
        world.publish(Sensed(STATE, heading=0.5))
        return transport.sense()

    state, heading = until(sense)
    assert (state, heading) == (STATE, pytest.approx(0.5))
    assert transport.sense() is None  # each once

    def commanded():
        transport.command(BodyVelocity(0.5, -0.25, 0.125))
        return world.commands()

    assert until(commanded) == {"robot_0": BodyVelocity(0.5, -0.25, 0.125)}


def test_states_between_neighbours(transport):
    mate = DDSTransport("robot_1", ["robot_0"], domain_id=DOMAIN)

    def receive():
        mate.send(Sensed(MATE, heading=0.0))
        return transport.receive()

    assert until(receive)[0] == MATE
    mate.close()
    until(lambda: transport.receive() == [])  # what a writer that has left says is no message


def test_topics_by_other_names():
    world = DDSWorld(["base", "robot_0"], domain_id=DOMAIN)
    names = {"pose": "/base/pose", "twist": "/base/twist", "cmd_vel": "/base/cmd_vel"}
    transport = DDSTransport("robot_0", [], domain_id=DOMAIN, topics=names, goal=(9.0, 9.0))

    def sense():
        world.publish(Sensed(replace(STATE, robot="base", goal=(0.0, 0.0)), heading=0.0))
        world.publish(Sensed(replace(STATE, position=(5.0, 5.0), goal=(0.0, 0.0)), heading=0.0))
        return transport.sense()

    state, _ = until(sense)
    assert state.robot == "robot_0" and state.position == STATE.position

    def commanded():
        transport.command(BodyVelocity(0.5, 0.0, 0.0))
        return world.commands()

    assert list(until(commanded)) == ["base"]
    transport.close()
    world.close()


def test_obstacle_and_goal_of_the_robot_itself():
    transport = DDSTransport(
        "robot_0", [], domain_id=DOMAIN, goal=(9.0, 9.0), obstacle=lambda position: (position[0], (1.0, 0.0))
    )
    network = Network(DOMAIN)
    pose = network.writer("robot_0/pose", ros2_types.PoseStamped)
    twist = network.writer("robot_0/twist", ros2_types.TwistStamped)
    header = ros2_types.Header(ros2_types.Time.of(2.0), "map")

    def sense():
        pose.write(ros2_types.PoseStamped(header, ros2_types.Pose(ros2_types.Point(3.0, 4.0))))
        twist.write(ros2_types.TwistStamped(header))
        return transport.sense()

    state, _ = until(sense)
    assert (state.goal, state.obstacle_distance, state.obstacle_direction) == ((9.0, 9.0), 3.0, (1.0, 0.0))
    transport.close()


class Torn:
    """What a reader of Cyclone does with bytes that are not of its type: it raises, and they are gone."""

    def __init__(self, samples):
        self.samples, self.topic = samples, SimpleNamespace(name="rt/robot_1/team/pose")

    def take(self, count):
        if not self.samples:
            return []
        sample = self.samples.pop(0)
        if isinstance(sample, Exception):
            raise sample
        return [SimpleNamespace(text=sample, sample_info=SimpleNamespace(valid_data=sample != "left"))]


def test_bytes_that_cannot_be_decoded_are_passed_over_and_logged_once(caplog):
    error = UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte")
    reader = _Reader(Torn(["a", error, error, "left", "b"]), Events(logging.getLogger("test")))
    assert [sample.text for sample in reader.take()] == ["a", "b"] and list(reader.take()) == []
    assert len(caplog.records) == 1 and "rt/robot_1/team/pose that cannot be decoded" in caplog.text


def test_what_arrives_between_two_looks_stays_in_step(world, transport):
    def three():
        for stamp in (1.0, 2.0, 3.0):
            world.publish(Sensed(replace(STATE, stamp=stamp, velocity=(stamp, 0.0)), heading=0.0))
        time.sleep(0.05)
        states = [sensed.state for sensed in transport._own.take()]
        return states if len(states) == 3 else None

    states = until(three)
    assert [(state.stamp, state.velocity[0]) for state in states] == [(1.0, 1.0), (2.0, 2.0), (3.0, 3.0)]


def test_other_domains_are_not_heard(transport):
    network = Network(DOMAIN + 1)
    writer = _StateWriter(network, "robot_1/team")
    for _ in range(20):
        writer.write(Sensed(MATE, 0.0), "map")
        time.sleep(0.02)
        assert transport.receive() == []


@pytest.mark.parametrize("domain_id", [-1, 233])
def test_bad_domain(domain_id):
    with pytest.raises(ValueError, match=f"domain_id: got {domain_id}, must be from 0 to 232"):
        DDSTransport("robot_0", [], domain_id=domain_id)


@pytest.mark.parametrize(("namespace", "mate"), [("robot 0", "robot_1"), ("", "robot_1"), ("robot_0", "1robot")])
def test_bad_names(namespace, mate):
    with pytest.raises(ValueError, match="must be letters, digits and underscores"):
        DDSTransport(namespace, [mate], domain_id=DOMAIN)


@pytest.mark.parametrize("name", ["Time", "Header", "PoseStamped", "Twist", "TwistStamped", "Vector3Stamped"])
def test_bytes_are_those_of_ros(name):
    """Against rosbags, which has its own definitions and its own encoder."""
    stores = pytest.importorskip("rosbags.typesys")
    store = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    types = store.types
    package = {"Time": "builtin_interfaces", "Header": "std_msgs"}.get(name, "geometry_msgs")

    def theirs(message):
        if not hasattr(message, "__idl_typename__"):
            return message
        kind = type(message).__idl_typename__.replace("::msg::dds_::", "/msg/").removesuffix("_")
        return types[kind](**{field: theirs(value) for field, value in vars(message).items()})

    header = ros2_types.Header(ros2_types.Time.of(1234.5), "map")
    pose = ros2_types.Pose(ros2_types.Point(1.0, -2.0, 3.5), ros2_types.Quaternion(0.0, 0.0, 0.6, 0.8))
    twist = ros2_types.Twist(ros2_types.Vector3(0.5, 0.25), ros2_types.Vector3(z=-1.5))
    message = {
        "Time": header.stamp,
        "Header": header,
        "PoseStamped": ros2_types.PoseStamped(header, pose),
        "Twist": twist,
        "TwistStamped": ros2_types.TwistStamped(header, twist),
        "Vector3Stamped": ros2_types.Vector3Stamped(header, twist.linear),
    }[name]
    expected = bytes(store.serialize_cdr(theirs(message), f"{package}/msg/{name}"))
    mine = bytes(message.serialize())
    assert mine[4:].rstrip(b"\0") == expected[4:].rstrip(b"\0")  # less the encapsulation header, and padding at the end
    assert abs(len(mine) - len(expected)) < 8


@pytest.mark.parametrize("stamp", [0.0, 1.5, 1.7e9 + 0.25, -1.25])
def test_time(stamp):
    assert ros2_types.Time.of(stamp).seconds() == pytest.approx(stamp, abs=1e-6)


@pytest.mark.skipif(
    "REDIG_RCLPY_PYTHON" not in os.environ, reason="REDIG_RCLPY_PYTHON does not name a Python with rclpy"
)
def test_a_real_ros_2_peer_in_both_directions():
    environment = {
        **{name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        "ROS_DOMAIN_ID": str(DOMAIN),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_STATIC_PEERS": "127.0.0.1",
    }
    peer = subprocess.Popen(
        [os.environ["REDIG_RCLPY_PYTHON"], PEER, "60"], env=environment, stdout=subprocess.PIPE, text=True
    )
    transport = DDSTransport("robot_0", ["robot_1"], domain_id=DOMAIN)
    seen = []

    def policy(own, neighbours):
        seen.append((own, list(neighbours)))
        return 0.3, -0.4

    node = RobotNode(transport, Pilot("robot_0", ["robot_1"], policy, own_timeout=5.0, timeout=5.0))
    while peer.poll() is None:
        node.step()
        time.sleep(0.02)
    transport.close()
    heard = json.loads(peer.communicate()[0])
    own, neighbours = next(both for both in reversed(seen) if both[1])
    assert abs(own.stamp - time.time()) < 60
    assert replace(own, stamp=1.5) == STATE and [replace(mate, stamp=1.5) for mate in neighbours] == [MATE]
    heading = 2 * math.asin(0.6)
    turned = complex(0.3, -0.4) * complex(math.cos(heading), -math.sin(heading))
    assert [turned.real, turned.imag, 0.0] in [pytest.approx(command) for command in heard["cmd_vel"]]
    del heard["cmd_vel"]
    last = {name: messages[-1] for name, messages in heard.items()}
    pose = ["map", 1.0, 2.0, pytest.approx(0.6)]
    assert last == {"pose": pose, "twist": [0.25, 0.0], "goal": [6.0, 0.0], "obstacle": [0.0, -0.5]}
