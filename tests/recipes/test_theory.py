import csv
import math
import subprocess

import pytest
import torch
from conftest import command
from PIL import Image
from theory import compare_schedules, two_modes

from redig.modules import NoiseSchedule

TERMS = (
    "prior_mismatch", "matching_error", "matching_divergence", "discretization_error",
    "bellman_residual", "coverage", "algorithmic_error",
)  # fmt: skip


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Everything that the command writes at toy size: the rows of each CSV file, and the path of the figure."""
    out = tmp_path_factory.mktemp("theory")
    done = subprocess.run(
        command("theory.py", "--smoke", "--threads", 1, "--out", out, "--figure", out / "images" / "figure.png"),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = {}
    for path in out.glob("*.csv"):
        with open(path, newline="") as file:
            rows[path.stem] = list(csv.DictReader(file))
    return rows, out / "images" / "figure.png"


def test_every_term_of_every_run_is_written(tables):
    rows, _ = tables
    assert set(rows) == {"terms", "steps", "samplers", "updates", "schedules"}
    assert len({row["run"] for row in rows["terms"]}) == len(rows["terms"]) == 7
    assert all(math.isfinite(float(row[term])) for row in rows["terms"] for term in TERMS)
    steps = [row["k"] for row in rows["steps"] if row["run"] == "linear schedule, K = 20"]
    assert steps == [str(k) for k in range(1, 21)]


def test_what_needs_no_training_is_found_even_at_toy_size(tables):
    rows, _ = tables
    terms = {row["run"]: {term: float(row[term]) for term in TERMS} for row in rows["terms"]}
    healthy = terms["as it should be"]
    assert terms["linear schedule, K = 20"]["prior_mismatch"] > 1e5 * healthy["prior_mismatch"]
    assert terms["few critic updates"]["algorithmic_error"] > healthy["algorithmic_error"]


def test_the_figure_is_drawn(tables):
    with Image.open(tables[1]) as picture:
        assert picture.width > 1000
        assert len(picture.convert("RGB").getcolors(2**24)) > 100


def test_a_linear_schedule_loses_mass_that_cosine_keeps():
    rows = {(row["schedule"], row["K"]): row for row in compare_schedules((20, 100), samples=20_000)}
    # five standard errors of the count, sqrt(0.25 / 20,000) = 0.0035, and of 20 steps' discretization on top
    assert rows["cosine", 100]["mass_sampled"] == pytest.approx(0.8, abs=0.02)
    assert rows["linear", 100]["mass_sampled"] == pytest.approx(0.729, abs=0.02)
    assert rows["linear", 20]["mass_sampled"] == pytest.approx(0.569, abs=0.02)
    assert rows["linear", 20]["prior_mismatch"] > rows["linear", 100]["prior_mismatch"] > 0.1


def test_the_exact_score_is_the_gradient_of_the_log_density():
    """``eps = -sqrt(1 - alpha) d log q(a^k) / d a^k``, by finite differences of the mixture's density."""
    schedule, x, h = NoiseSchedule(50), torch.linspace(-2, 2, 41, dtype=torch.float64).unsqueeze(-1), 1e-5
    for k in (5, 25, 49):
        alpha = schedule.signal(k)
        spread = math.sqrt(alpha * 0.05**2 + 1 - alpha)

        def log_density(at, alpha=alpha, spread=spread):
            parts = [
                weight * torch.distributions.Normal(math.sqrt(alpha) * mode, spread).log_prob(at).exp()
                for mode, weight in ((0.8, 0.8), (-0.8, 0.2))
            ]
            return sum(parts).log()

        gradient = (log_density(x + h) - log_density(x - h)) / (2 * h)
        torch.testing.assert_close(
            two_modes(schedule)(x, k), -math.sqrt(1 - alpha) * gradient, rtol=1e-4, atol=1e-6, check_dtype=False
        )
