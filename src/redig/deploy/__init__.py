"""Deployment: policies as ONNX files, which robots run without torch; only :func:`export_policy` imports it."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from redig.deploy.export import export_policy
    from redig.deploy.runtime import ExportedPolicy, load_policy
else:  # as in redig/__init__.py

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        home = "export" if name == "export_policy" else "runtime"
        return getattr(import_module(f"{__name__}.{home}"), name)


__all__ = ["ExportedPolicy", "export_policy", "load_policy"]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
