"""Pictures of rollouts and of training; the only part of the library that draws."""

from redig.viz.animation import animate
from redig.viz.curves import plot_learning_curves
from redig.viz.trajectories import plot_trajectories

__all__ = ["animate", "plot_learning_curves", "plot_trajectories"]
