"""Deployment: policies as ONNX files, and what a robot does with one, without torch.

Names are imported when they are first asked for: only ``export_policy`` and ``ModulePolicy`` import torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from redig.deploy.dds import DDSTransport, DDSWorld
    from redig.deploy.drive import LIMO, WARTHOG, Base, DifferentialDrive
    from redig.deploy.export import export_policy
    from redig.deploy.hearing import Hearing
    from redig.deploy.messages import RobotState
    from redig.deploy.module import ModulePolicy
    from redig.deploy.node import RobotNode, Wheels, holonomic
    from redig.deploy.pilot import Deadline, Pilot
    from redig.deploy.proximity import LaserScan, OccupancyGrid, Proximity, to_robot, to_world
    from redig.deploy.record import Recorder, Run, read_run
    from redig.deploy.robot import RobotPolicy
    from redig.deploy.ros1 import ROS1Transport
    from redig.deploy.runtime import ExportedPolicy, load_policy
    from redig.deploy.transport import BodyVelocity, Faults, Radio, Sensed, Transport
else:  # as in redig/__init__.py
    HOMES = {
        "dds": ["DDSTransport", "DDSWorld"],
        "drive": ["LIMO", "WARTHOG", "Base", "DifferentialDrive"],
        "export": ["export_policy"],
        "hearing": ["Hearing"],
        "messages": ["RobotState"],
        "module": ["ModulePolicy"],
        "node": ["RobotNode", "Wheels", "holonomic"],
        "pilot": ["Deadline", "Pilot"],
        "proximity": ["LaserScan", "OccupancyGrid", "Proximity", "to_robot", "to_world"],
        "record": ["Recorder", "Run", "read_run"],
        "robot": ["RobotPolicy"],
        "ros1": ["ROS1Transport"],
        "runtime": ["ExportedPolicy", "load_policy"],
        "transport": ["BodyVelocity", "Faults", "Radio", "Sensed", "Transport"],
    }

    def __getattr__(name: str) -> Any:
        for home, names in HOMES.items():
            if name in names:
                return getattr(import_module(f"{__name__}.{home}"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "LIMO",
    "WARTHOG",
    "Base",
    "BodyVelocity",
    "DDSTransport",
    "DDSWorld",
    "Deadline",
    "DifferentialDrive",
    "ExportedPolicy",
    "Faults",
    "Hearing",
    "LaserScan",
    "ModulePolicy",
    "OccupancyGrid",
    "Pilot",
    "Proximity",
    "ROS1Transport",
    "Radio",
    "Recorder",
    "RobotNode",
    "RobotPolicy",
    "RobotState",
    "Run",
    "Sensed",
    "Transport",
    "Wheels",
    "export_policy",
    "holonomic",
    "load_policy",
    "read_run",
    "to_robot",
    "to_world",
]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
