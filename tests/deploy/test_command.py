import os
import subprocess
import sys
import time
from threading import Event, Thread

import pytest
import torch
import tyro

pytest.importorskip("cyclonedds", reason="needs pip install 'redig[ros2]'")

from redig.deploy.command import Arguments, make_drive, run
from redig.deploy.dds import DDSWorld
from redig.deploy.messages import RobotState
from redig.deploy.transport import BodyVelocity, Sensed
from redig.policy import PolicyConfig, build_policy, save_policy

DOMAIN = 1 + os.getpid() % 99
REST = BodyVelocity(0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    torch.manual_seed(0)
    config = PolicyConfig(observation_dim=9, sampling_steps=2, noise_ratio=0.0, hidden=(16,))
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    save_policy(path, build_policy(config), config, {"max_speed": 0.4, "goal_radius": 0.2})
    return path


def test_a_robot_drives_stands_without_state_and_stands_when_it_is_stopped(policy):
    arguments = tyro.cli(
        Arguments,
        args=f"--policy {policy} --namespace robot_0 --neighbours robot_0 robot_1 --domain-id {DOMAIN} "
        "--rate 50 --goal 5 0 --deadline 5 --own-timeout 1".split(),
    )
    world, stop = DDSWorld(["robot_0"], domain_id=DOMAIN), Event()
    robot = Thread(target=run, args=(arguments, stop))
    robot.start()

    def until(condition, speak=True):
        end = time.monotonic() + 60
        while time.monotonic() < end:
            if speak:
                state = RobotState("robot_0", time.time(), (0.0, 0.0), (0.0, 0.0), (5.0, 0.0), 1.0, (0.0, 1.0))
                world.publish(Sensed(state, heading=0.0))
            time.sleep(0.02)
            command = world.commands().get("robot_0")
            if command is not None and condition(command):
                return command
        raise AssertionError("the robot did not do it")

    moving = until(lambda command: command != REST)
    assert 0 < (moving.forward**2 + moving.left**2) ** 0.5 <= 0.4 + 1e-9  # the limit of the policy's training
    until(lambda command: command == REST, speak=False)
    until(lambda command: command != REST)
    stop.set()
    robot.join(30)
    assert not robot.is_alive()
    assert until(lambda command: True, speak=False) == REST
    world.close()


def test_domain_is_needed(policy):
    with pytest.raises(ValueError, match="domain_id: got None"):
        run(Arguments(policy, "robot_0"), Event())


@pytest.mark.parametrize("drive", ["limo", "warthog"])
def test_differential_drives_do_not_go_sideways(policy, drive):
    command = make_drive(Arguments(policy, "robot_0", drive=drive))((0.0, 0.5), 0.0)
    assert command.left == 0.0 and command.turn > 0


def test_a_turn_is_limited_as_asked(policy):
    drive = make_drive(Arguments(policy, "robot_0", drive="limo", max_angular=0.3))
    turns = [drive((0.0, 0.5), 0.0).turn for _ in range(200)]  # at least 1 ms each, by the clock of the drive
    assert max(turns) == pytest.approx(0.3)


def test_a_pace_reaches_the_drive(policy):
    drive = make_drive(Arguments(policy, "robot_0", drive="limo", pace=0.5))
    assert drive((0.03, 0.0), 0.0).forward > 0  # at its own pace it does not start below 0.05 m/s
    assert make_drive(Arguments(policy, "robot_0", drive="limo"))((0.03, 0.0), 0.0).forward == 0


@pytest.mark.parametrize("drive, limit", [("holonomic", 1.0), ("limo", 0.0), ("limo", -1.0)])
def test_a_bad_limit_of_turning_is_refused(policy, drive, limit):
    with pytest.raises(ValueError, match="max_angular"):
        make_drive(Arguments(policy, "robot_0", drive=drive, max_angular=limit))


def test_help_is_shown_without_torch():
    program = (
        "import sys; sys.argv = ['redig-robot', '--help']\ntry:\n    from redig.deploy.command import main; main()"
    )
    program += "\nfinally:\n    assert 'torch' not in sys.modules and 'cyclonedds' not in sys.modules"
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert shown.returncode == 0, shown.stderr
    for word in ("--domain-id", "--neighbours", "cmd_vel", "(m/s)", "authenticated"):
        assert word in shown.stdout
