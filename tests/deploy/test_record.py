import math

import numpy as np
import pytest

pytest.importorskip("mcap_ros2", reason="needs pip install 'redig[record]'")
pytest.importorskip("rosbags", reason="needs pip install rosbags")

from rosbags.highlevel import AnyReader

from redig.deploy.messages import RobotState
from redig.deploy.record import Recorder, read_run
from redig.deploy.transport import BodyVelocity, Sensed


@pytest.fixture
def made():
    """What two robots sense and are commanded at four times."""
    draw = np.random.default_rng(0)
    made = []
    for step in range(4):
        for robot in ("robot_0", "robot_10"):
            x, y, vx, vy, gx, gy = draw.normal(size=6)
            state = RobotState(robot, 1.7e9 + 0.1 * step, (x, y), (vx, vy), (gx, gy), 0.5, (0.6, -0.8))
            made.append((Sensed(state, heading=draw.uniform(-3, 3)), BodyVelocity(*draw.normal(size=3))))
    return made


@pytest.fixture
def path(made, tmp_path):
    with Recorder(tmp_path / "run.mcap") as recorder:
        for sensed, command in made:
            recorder.write(sensed, command)
    return tmp_path / "run.mcap"


def test_run_comes_back(made, path):
    run = read_run(path)
    assert run.robots == ["robot_0", "robot_10"]
    shaped = {
        "position": [sensed.state.position for sensed, _ in made],
        "velocity": [sensed.state.velocity for sensed, _ in made],
        "goal": [sensed.state.goal for sensed, _ in made],
        "obstacle": [(0.3, -0.4)] * 8,
        "command": [tuple(command) for _, command in made],
        "heading": [sensed.heading for sensed, _ in made],
    }
    for name, values in shaped.items():
        value = np.array(values)
        np.testing.assert_allclose(getattr(run, name), value.reshape(4, 2, *value.shape[1:]), atol=1e-12, err_msg=name)
    np.testing.assert_allclose(run.stamp - 1.7e9, 0.1 * np.arange(4), atol=1e-6)


def test_another_library_reads_it(made, path):
    """rosbags has its own reader of MCAP, and takes the definitions from the file."""
    heard = {}
    with AnyReader([path]) as reader:
        for connection, time, raw in reader.messages():
            heard.setdefault((connection.topic, connection.msgtype), []).append(
                (time, reader.deserialize(raw, connection.msgtype))
            )
    kinds = {topic: kind for topic, kind in heard}
    assert kinds["/robot_10/pose"] == kinds["/robot_0/goal"] == "geometry_msgs/msg/PoseStamped"
    assert kinds["/robot_0/twist"] == kinds["/robot_0/cmd_vel_stamped"] == "geometry_msgs/msg/TwistStamped"
    assert kinds["/robot_0/obstacle"] == "geometry_msgs/msg/Vector3Stamped" and len(kinds) == 10
    poses = heard["/robot_10/pose", "geometry_msgs/msg/PoseStamped"]
    assert len(poses) == 4
    for (sensed, _), (time, message) in zip(made[1::2], poses, strict=True):
        position, turned, stamp = message.pose.position, message.pose.orientation, message.header.stamp
        assert (position.x, position.y) == sensed.state.position
        assert math.isclose(2 * math.atan2(turned.z, turned.w), sensed.heading)
        assert time == stamp.sec * 10**9 + stamp.nanosec == round(sensed.state.stamp * 1e9)
        assert message.header.frame_id == "map"
    commands = heard["/robot_0/cmd_vel_stamped", "geometry_msgs/msg/TwistStamped"]
    for (_, command), (_, message) in zip(made[::2], commands, strict=True):
        assert (message.twist.linear.x, message.twist.linear.y, message.twist.angular.z) == command


def test_an_error_leaves_no_file(tmp_path, made):
    with pytest.raises(RuntimeError), Recorder(tmp_path / "run.mcap") as recorder:
        recorder.write(*made[0])
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_files_that_are_no_run(tmp_path, path):
    with pytest.raises(FileNotFoundError, match="run: no such file"):
        read_run(tmp_path / "other.mcap")
    (tmp_path / "text.mcap").write_text("no run")
    with pytest.raises(ValueError, match="is not an MCAP file"):
        read_run(tmp_path / "text.mcap")
    (tmp_path / "torn.mcap").write_bytes(path.read_bytes()[:300])
    with pytest.raises(ValueError, match="run: "):
        read_run(tmp_path / "torn.mcap")
    with Recorder(tmp_path / "empty.mcap"):
        pass
    with pytest.raises(ValueError, match="expected pose, twist"):
        read_run(tmp_path / "empty.mcap")
