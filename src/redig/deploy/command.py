"""``redig-robot``: the program on a robot; see ``redig-robot --help`` and ``docs/robots.md``."""

from __future__ import annotations

import logging
import signal
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import Literal

import tyro

from redig.deploy.drive import LIMO, WARTHOG, DifferentialDrive
from redig.deploy.node import Drive, RobotNode, Wheels, holonomic
from redig.deploy.pilot import Deadline, Pilot
from redig.deploy.robot import RobotPolicy
from redig.deploy.transport import Transport

DESCRIPTION = """Drive one robot of a team with a trained policy.

It reads the robot's own pose, twist, goal and nearest obstacle from topics in its namespace, tells them to its
neighbours on topics under team/, hears theirs, and publishes cmd_vel (geometry_msgs/Twist, along the robot's axes). It
publishes zero while its own state is stale, and never more than its limits. Run one such process for each robot.

Nothing on the network is authenticated: whoever reaches it can send states. The default reaches this machine only."""


@dataclass
class Arguments:
    """Options of ``redig-robot``; their help is under each.

    Examples:
        >>> Arguments(Path("robot.onnx"), "robot_0").rate
        20.0
    """

    policy: Path
    """Policy file: .onnx of one robot (recipes/export.py --ego; needs no torch) or .safetensors."""
    namespace: str
    """This robot's namespace, such as robot_0; its topics are /robot_0/pose, /robot_0/cmd_vel, ..."""
    neighbours: tuple[str, ...] = ()
    """Namespaces of the other robots: robot_1 robot_2 ...; no others are listened to. Its own may be among them."""
    domain_id: int | None = None
    """DDS domain, from 0 to 232 (ROS_DOMAIN_ID of ROS 2). ROS 2 only, and required there."""
    interface: str = "lo"
    """Network interface, such as wlan0; lo: this machine only. ROS 2 only."""
    peers: tuple[str, ...] = ()
    """Addresses of the other robots' computers, on networks without multicast. ROS 2 only."""
    ros: Literal[2, 1] = 2
    """2: DDS with ROS 2's messages, no ROS needed. 1: rospy, which must be installed; ROS_MASTER_URI says where."""
    rate: float = 20.0
    """Commands per second (Hz)."""
    goal: tuple[float, float] | None = None
    """Where to go (m), in the frame of the pose, until a message on the goal topic says otherwise."""
    pose_topic: str = "pose"
    """Own pose, geometry_msgs/PoseStamped. A topic that begins with / is not in the namespace."""
    twist_topic: str = "twist"
    """Own velocity, geometry_msgs/TwistStamped; along the robot's axes if its frame is not that of the pose."""
    goal_topic: str = "goal"
    """Goal, geometry_msgs/PoseStamped."""
    obstacle_topic: str = "obstacle"
    """Vector to the nearest obstacle (m), geometry_msgs/Vector3Stamped; frames as for the twist."""
    command_topic: str = "cmd_vel"
    """Where commands go."""
    neighbour_timeout: float = 0.5
    """Forget a neighbour that has not been heard for so long (s), by this robot's clock."""
    own_timeout: float = 0.3
    """Stand when the own state is older than this (s)."""
    deadline: float = 0.1
    """Stand when a step of the policy takes longer than this (s)."""
    max_speed: float | None = None
    """Speed limit (m/s); default: that of the policy's training, times the pace."""
    goal_radius: float | None = None
    """Hold within this distance of the goal (m); default: that of the policy's training."""
    drive: Literal["holonomic", "limo", "warthog"] = "holonomic"
    """How the robot moves: in all directions, or with the differential drive and the limits of such a base."""
    pace: float = 1.0
    """Drive in slow motion: 0.5 takes twice the time, with a quarter of the acceleration and half the turning. For
    slippery ground and bases that turn slowly; the same for the whole team."""
    max_angular: float | None = None
    """With a differential drive, the fastest turn (rad/s); default: that of the base."""


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of ``redig-robot``; ``args`` are those of the command line.

    Examples:
        >>> main("--policy no/such/robot.onnx --namespace robot_0 --domain-id 7".split())
        Traceback (most recent call last):
        ...
        FileNotFoundError: policy: no such file: no/such/robot.onnx
    """
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO)
    arguments, stop = tyro.cli(Arguments, prog="redig-robot", description=DESCRIPTION, args=args), Event()
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        run(arguments, stop)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run(arguments: Arguments, stop: Event) -> None:
    """Drive until ``stop`` is set.

    Raises:
        ValueError: for an argument that is not allowed.
        FileNotFoundError: if there is no such policy.
        ImportError: naming the extra that is not installed.

    Examples:
        >>> run(Arguments(Path("no/such/robot.onnx"), "robot_0", domain_id=7), Event())
        Traceback (most recent call last):
        ...
        FileNotFoundError: policy: no such file: no/such/robot.onnx
    """
    policy = RobotPolicy(arguments.policy, arguments.pace)
    trained = policy.environment
    pilot = Pilot(
        arguments.namespace.strip("/"),
        [mate.strip("/") for mate in arguments.neighbours],
        Deadline(policy, arguments.deadline),
        max_speed=arguments.max_speed or arguments.pace * trained.get("max_speed", 1.0),
        timeout=arguments.neighbour_timeout,
        own_timeout=arguments.own_timeout,
        goal_radius=arguments.goal_radius or trained.get("goal_radius", 0.1),
    )
    transport = make_transport(arguments)
    logging.info("%s drives with %s at %g Hz", pilot.robot, arguments.policy, arguments.rate)
    try:
        RobotNode(transport, pilot, make_drive(arguments)).run(arguments.rate, stop)
    finally:
        transport.close()


def make_drive(arguments: Arguments) -> Drive:
    """How this robot moves.

    Examples:
        >>> make_drive(Arguments(Path("robot.onnx"), "robot_0"))((0.5, 0.25), 0.0)
        BodyVelocity(forward=0.5, left=0.25, turn=0.0)

    Raises:
        ValueError: for a limit of turning that is not positive, or of a robot that does not turn.
    """
    if arguments.drive == "holonomic":
        if arguments.max_angular is not None:
            raise ValueError(f"max_angular: got {arguments.max_angular} for a holonomic drive, which does not turn")
        return holonomic
    base = {"limo": LIMO, "warthog": WARTHOG}[arguments.drive]
    if arguments.max_angular is not None:
        base = replace(base, max_angular=arguments.max_angular)
    return Wheels(DifferentialDrive(base, pace=arguments.pace))


def make_transport(arguments: Arguments) -> Transport:
    """The network that the arguments ask for.

    Examples:
        >>> make_transport(Arguments(Path("robot.onnx"), "robot_0"))
        Traceback (most recent call last):
        ...
        ValueError: domain_id: got None; ROS 2 needs --domain-id, the same for the whole team
    """
    given = {name: getattr(arguments, f"{name}_topic") for name in ("pose", "twist", "goal", "obstacle")}
    topics = given | {"cmd_vel": arguments.command_topic}
    if arguments.ros == 1:
        from redig.deploy.ros1 import ROS1Transport

        return ROS1Transport(arguments.namespace, arguments.neighbours, topics=topics, goal=arguments.goal)
    if arguments.domain_id is None:
        raise ValueError("domain_id: got None; ROS 2 needs --domain-id, the same for the whole team")
    from redig.deploy.dds import DDSTransport

    return DDSTransport(
        arguments.namespace,
        arguments.neighbours,
        domain_id=arguments.domain_id,
        interface=arguments.interface,
        peers=arguments.peers,
        topics=topics,
        goal=arguments.goal,
    )


if __name__ == "__main__":
    main()
