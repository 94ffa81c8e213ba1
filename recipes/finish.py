"""The end of a run: the final evaluation on starts never trained on, the tables and the figures."""

from __future__ import annotations

import platform

import torch
from evaluate import draw_crossing
from run import Run
from task import Task

from redig.envs.factory import make_env
from redig.evaluation import evaluate, format_table, write_metrics
from redig.policy import load_policy
from redig.viz import plot_learning_curves

TEST_SEED = 2_000_000  # starts of the final evaluation, the same for every training seed


def score(metrics: dict[str, float]) -> float:
    """What the best policy has most of: robots and teams that arrive, then formation and speed, then smoothness.

    A tenth of a second weighs as much as 0.01 of CFI. Formation and jerk count for the share of robots that arrive, and
    jerk costs at most 0.5: a team that stands still in perfect formation is worth less than any robot that arrives.
    """
    time = metrics["travel_time"] if metrics["travel_time_teams"] > 0 else 20.0
    excess_jerk = min(max(metrics["jerk_mean"] - 2.0, 0.0), 5.0)
    arrived = metrics["success_rate"]
    success = 2 * arrived + 2 * metrics["team_success_rate"]
    return success + arrived * (metrics["cfi_0.5"] - 0.1 * excess_jerk) - 0.1 * time


def finish(run: Run, config: Task) -> dict[str, float]:
    """Evaluate the cloned, the last and the best policy of a run, and leave its metrics and pictures."""
    scenario = config.scenario("evaluation")
    env = make_env(config.num_starts, **scenario)
    results = {}
    for name in ("cloned", "last", "policy"):
        if name == "cloned" and not (run.folder / "cloned.safetensors").exists():
            continue  # a baseline that starts from nothing
        results[name] = evaluate(load_policy(run.folder / f"{name}.safetensors"), env, seed=TEST_SEED)
        title = {"cloned": "cloned (before online training)", "policy": "best by validation"}.get(name, name)
        print(f"\n{title}, {config.num_starts} starts never trained on\n{format_table(results[name])}")
    metrics = results["policy"]
    others = {f"{name}_{key}": value for name in results if name != "policy" for key, value in results[name].items()}
    write_metrics(run.folder / "metrics.json", {**metrics, **others})
    plot_learning_curves(run.folder / "learning_curve.png", run.evaluations)
    draw_crossing(run.folder, load_policy(run.folder / "policy.safetensors"), make_env(1, **scenario), TEST_SEED)
    print(f"\neverything is in {run.folder} ({platform.machine()}, {torch.get_num_threads()} threads)")
    return metrics
