"""Deployment: policies as ONNX files, and what a robot does with one, without torch.

Names are imported when they are first asked for: only ``export_policy`` and ``ModulePolicy`` import torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from redig.deploy.export import export_policy
    from redig.deploy.messages import RobotState
    from redig.deploy.module import ModulePolicy
    from redig.deploy.robot import RobotPolicy
    from redig.deploy.runtime import ExportedPolicy, load_policy
else:  # as in redig/__init__.py
    HOMES = {
        "ExportedPolicy": "runtime",
        "ModulePolicy": "module",
        "RobotPolicy": "robot",
        "RobotState": "messages",
        "export_policy": "export",
        "load_policy": "runtime",
    }

    def __getattr__(name: str) -> Any:
        if name not in HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{HOMES[name]}"), name)


__all__ = ["ExportedPolicy", "ModulePolicy", "RobotPolicy", "RobotState", "export_policy", "load_policy"]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
