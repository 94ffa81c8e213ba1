"""A robot in a real ROS 1 graph; needs Debian's python3-rospy, python3-geometry-msgs and python3-rosmaster."""

import json
import math
import os
import shutil
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from redig.deploy.messages import RobotState

PEER = Path(__file__).with_name("ros1_peer.py")
ROBOT = """
import json, sys, time
from redig.deploy.node import RobotNode
from redig.deploy.pilot import Pilot
from redig.deploy.ros1 import ROS1Transport

transport = ROS1Transport("robot_0", ["robot_0", "robot_1"])
seen = []

def policy(own, neighbours):
    seen.append([vars(own), [vars(mate) for mate in neighbours]])
    return 0.3, -0.4

node = RobotNode(transport, Pilot("robot_0", ["robot_1"], policy, own_timeout=5.0, timeout=5.0))
end = time.monotonic() + 60
while time.monotonic() < end and sum(bool(mates) for _, mates in seen) < 200:
    node.step()
    time.sleep(0.02)
transport.close()
print(json.dumps(next(both for both in reversed(seen) if both[1])))
"""


@pytest.fixture
def graph(tmp_path):
    """The environment of a roscore's own graph."""
    if shutil.which("rosmaster") is None or not Path("/usr/lib/python3/dist-packages/rospy").is_dir():
        pytest.skip("no ROS 1 here: apt install python3-rospy python3-geometry-msgs python3-rosmaster")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {**os.environ, "ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1"}
    environment |= {"ROS_HOME": str(tmp_path), "ROS_LOG_DIR": str(tmp_path)}
    bare = {name: value for name, value in environment.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    master = subprocess.Popen(["rosmaster", "--core", "-p", str(port)], env=bare, stdout=subprocess.DEVNULL)
    end = time.monotonic() + 30
    while time.monotonic() < end:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                break
        time.sleep(0.1)
    yield environment, bare
    master.terminate()
    master.wait(10)


def test_a_real_ros_1_peer_in_both_directions(graph):
    environment, bare = graph
    peer = subprocess.Popen(["/usr/bin/python3", PEER, "60"], env=bare, stdout=subprocess.PIPE, text=True)
    robot = subprocess.run([sys.executable, "-c", ROBOT], env=environment, capture_output=True, text=True, timeout=120)
    assert robot.returncode == 0, robot.stderr
    own, mates = json.loads(robot.stdout.splitlines()[-1])
    heard = json.loads(peer.communicate(timeout=90)[0].splitlines()[-1])

    def state(fields):
        return RobotState(**{name: tuple(x) if isinstance(x, list) else x for name, x in fields.items()})

    assert abs(own["stamp"] - time.time()) < 300
    expected = RobotState("robot_0", 1.5, (1.0, 2.0), (0.25, 0.0), (6.0, 0.0), 0.5, (0.0, -1.0))
    mate = RobotState("robot_1", 1.5, (1.5, 2.0), (0.0, 0.5), (6.5, 0.0), 0.75, (0.0, -1.0))
    assert replace(state(own), stamp=1.5) == expected
    assert [replace(state(fields), stamp=1.5) for fields in mates] == [mate]
    turned = complex(0.3, -0.4) * complex(math.cos(2 * math.asin(0.6)), -math.sin(2 * math.asin(0.6)))
    assert [turned.real, turned.imag, 0.0] in [pytest.approx(command) for command in heard["cmd_vel"]]
    assert heard["team"][-1] == ["map", 1.0, 2.0, pytest.approx(0.6)]
