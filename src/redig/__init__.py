"""ReDiG, Reinforced Diffusion on Graphs: robot teams that cross narrow corridors in formation, as TorchRL modules."""

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
