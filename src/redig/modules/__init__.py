"""Networks and policies: tensors or TensorDicts in, the same out."""

from redig.modules.actor import DiffusionActor
from redig.modules.critic import QNetwork
from redig.modules.denoiser import DenoisingMLP
from redig.modules.encoder import GraphEncoder, radius_adjacency
from redig.modules.samplers import DDPM
from redig.modules.schedule import NoiseSchedule

__all__ = [
    "DDPM",
    "DenoisingMLP",
    "DiffusionActor",
    "GraphEncoder",
    "NoiseSchedule",
    "QNetwork",
    "radius_adjacency",
]
