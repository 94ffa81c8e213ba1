"""Evaluation: the metrics of the paper, and the driver that measures a policy with them."""

from redig.evaluation.evaluate import evaluate, rollout_trajectories
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
    "contextual_formation_integrity",
    "evaluate",
    "format_table",
    "gap_term",
    "jerk",
    "rollout_trajectories",
    "success",
    "team_success",
    "travel_time",
    "write_metrics",
]
