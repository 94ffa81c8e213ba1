"""Evaluation: the metrics of the paper, the driver that measures a policy with them, and the terms of its theorems."""

from redig.evaluation.critic_bound import (
    algorithmic_error,
    bellman_residual,
    coverage,
    coverage_constant,
    density_ratio,
    statistical_error,
)
from redig.evaluation.denoising import denoising_path
from redig.evaluation.diffusion_bound import (
    discretization_error,
    discretization_term,
    matching_divergence,
    matching_error,
    prior_mismatch,
    prior_mismatch_floor,
)
from redig.evaluation.evaluate import evaluate, evaluate_teams, mean_metrics, rollout_trajectories, team_metrics
from redig.evaluation.message_importance import message_importance
from redig.evaluation.metrics import (
    contextual_formation_integrity,
    gap_term,
    jerk,
    success,
    team_success,
    travel_time,
)
from redig.evaluation.report import format_table, write_metrics

__all__ = [
    "algorithmic_error",
    "bellman_residual",
    "contextual_formation_integrity",
    "coverage",
    "coverage_constant",
    "denoising_path",
    "density_ratio",
    "discretization_error",
    "discretization_term",
    "evaluate",
    "evaluate_teams",
    "format_table",
    "gap_term",
    "jerk",
    "matching_divergence",
    "matching_error",
    "mean_metrics",
    "message_importance",
    "prior_mismatch",
    "prior_mismatch_floor",
    "rollout_trajectories",
    "statistical_error",
    "success",
    "team_metrics",
    "team_success",
    "travel_time",
    "write_metrics",
]
