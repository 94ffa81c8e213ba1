"""Loss modules and the returns they learn from."""

from redig.objectives.dipo import DIPOLoss
from redig.objectives.multi_step import MultiStep

__all__ = ["DIPOLoss", "MultiStep"]
