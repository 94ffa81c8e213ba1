"""Loss modules and the returns they learn from."""

from redig.objectives.actor_critic import DiffusionActorCriticLoss
from redig.objectives.dipo import DIPOLoss
from redig.objectives.multi_step import MultiStep
from redig.objectives.q_weighted import QWeightedLoss
from redig.objectives.refinement import refine_actions

__all__ = ["DIPOLoss", "DiffusionActorCriticLoss", "MultiStep", "QWeightedLoss", "refine_actions"]
