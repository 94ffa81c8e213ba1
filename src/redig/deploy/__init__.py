"""Deployment: policies as ONNX files, which robots run without torch; only :func:`export_policy` imports it."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from redig.deploy.export import export_policy
    from redig.deploy.runtime import ExportedPolicy, load_policy

__all__ = ["ExportedPolicy", "export_policy", "load_policy"]

_MODULES = {"ExportedPolicy": "runtime", "export_policy": "export", "load_policy": "runtime"}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
