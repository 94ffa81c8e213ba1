"""Pictures of rollouts, of policies and of training; the only part of the library that draws."""

from redig.viz.animation import animate
from redig.viz.comparison import plot_comparison
from redig.viz.curves import plot_learning_curves
from redig.viz.denoising import plot_denoising
from redig.viz.denoising_film import animate_denoising
from redig.viz.importance import plot_importance
from redig.viz.jerk import plot_jerk
from redig.viz.trajectories import plot_trajectories

__all__ = [
    "animate",
    "animate_denoising",
    "plot_comparison",
    "plot_denoising",
    "plot_importance",
    "plot_jerk",
    "plot_learning_curves",
    "plot_trajectories",
]
