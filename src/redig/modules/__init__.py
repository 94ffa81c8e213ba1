"""Networks and policies: tensors or TensorDicts in, the same out."""

from redig.modules.actor import DiffusionActor
from redig.modules.best_of import BestOfN
from redig.modules.critic import QNetwork
from redig.modules.denoiser import DenoisingMLP
from redig.modules.encoder import GraphEncoder
from redig.modules.gaussian import GaussianActor
from redig.modules.neighbours import radius_adjacency, radius_edges
from redig.modules.samplers import DDIM, DDPM, DPMSolver, Sampler
from redig.modules.schedule import NoiseSchedule

__all__ = [
    "DDIM",
    "DDPM",
    "BestOfN",
    "DPMSolver",
    "DenoisingMLP",
    "DiffusionActor",
    "GaussianActor",
    "GraphEncoder",
    "NoiseSchedule",
    "QNetwork",
    "Sampler",
    "radius_adjacency",
    "radius_edges",
]
