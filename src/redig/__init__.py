"""ReDiG, Reinforced Diffusion on Graphs: robot teams that cross narrow corridors in formation, as TorchRL modules.

Names are imported when they are first asked for, so that a robot with ``redig.deploy`` needs no torch.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from redig.envs import FormationNavigation, ObstacleMap, corridor, formation_offsets
    from redig.modules import (
        DDIM,
        DDPM,
        DenoisingMLP,
        DiffusionActor,
        DPMSolver,
        GraphEncoder,
        NoiseSchedule,
        QNetwork,
    )
    from redig.objectives import DIPOLoss, MultiStep, QWeightedLoss
    from redig.policy import PolicyConfig, build_policy, load_policy, save_policy
else:  # not for type checkers, to whom every name would exist

    def __getattr__(name: str) -> Any:
        if name in __all__:
            for home in ("redig.modules", "redig.objectives", "redig.policy", "redig.envs"):
                if hasattr(module := import_module(home), name):
                    return getattr(module, name)
        if not name.startswith("_") and find_spec(f"redig.{name}"):  # a submodule, as in redig.policy
            return import_module(f"redig.{name}")
        raise AttributeError(f"module 'redig' has no attribute {name!r}")


__version__ = "0.1.0"

__all__ = [
    "DDIM",
    "DDPM",
    "DIPOLoss",
    "DPMSolver",
    "DenoisingMLP",
    "DiffusionActor",
    "FormationNavigation",
    "GraphEncoder",
    "MultiStep",
    "NoiseSchedule",
    "ObstacleMap",
    "PolicyConfig",
    "QNetwork",
    "QWeightedLoss",
    "build_policy",
    "corridor",
    "formation_offsets",
    "load_policy",
    "save_policy",
]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
