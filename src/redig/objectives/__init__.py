"""Loss modules and the returns they learn from."""

from redig.objectives.dipo import DIPOLoss
from redig.objectives.multi_step import MultiStep
from redig.objectives.refinement import refine_actions

__all__ = ["DIPOLoss", "MultiStep", "refine_actions"]
