"""Deployment: policies as ONNX files, and what a robot does with one, without torch.

Names are imported when they are first asked for: only ``export_policy`` and ``ModulePolicy`` import torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from redig.deploy.drive import LIMO, WARTHOG, Base, DifferentialDrive
    from redig.deploy.export import export_policy
    from redig.deploy.messages import RobotState
    from redig.deploy.module import ModulePolicy
    from redig.deploy.proximity import LaserScan, OccupancyGrid, Proximity, to_robot, to_world
    from redig.deploy.robot import RobotPolicy
    from redig.deploy.runtime import ExportedPolicy, load_policy
else:  # as in redig/__init__.py
    HOMES = {
        "drive": ["LIMO", "WARTHOG", "Base", "DifferentialDrive"],
        "export": ["export_policy"],
        "messages": ["RobotState"],
        "module": ["ModulePolicy"],
        "proximity": ["LaserScan", "OccupancyGrid", "Proximity", "to_robot", "to_world"],
        "robot": ["RobotPolicy"],
        "runtime": ["ExportedPolicy", "load_policy"],
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
    "DifferentialDrive",
    "ExportedPolicy",
    "LaserScan",
    "ModulePolicy",
    "OccupancyGrid",
    "Proximity",
    "RobotPolicy",
    "RobotState",
    "export_policy",
    "load_policy",
    "to_robot",
    "to_world",
]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
