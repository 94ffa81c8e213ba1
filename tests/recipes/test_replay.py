import csv
import json
from pathlib import Path

import pytest

pytest.importorskip("mcap_ros2", reason="needs pip install 'redig[record]'")

import torch
from replay import Arguments, main
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from redig.deploy.messages import RobotState
from redig.deploy.record import Recorder
from redig.deploy.transport import BodyVelocity, Sensed
from redig.envs.factory import make_env
from redig.evaluation import evaluate_teams
from redig.policy import ACTION, OBSERVATION, load_policy, read_header

WEDGE = Path(__file__).parents[2] / "recipes/policies/wedge.safetensors"
ROBOTS = [f"robot_{i}" for i in range(5)]


def recorded(path: Path, drive, starts: int, period: float = 0.1) -> dict[str, Tensor]:
    """Record what ``drive`` does in the scenario of the wedge; the metrics of each start."""
    env = make_env(1, **read_header(WEDGE)[1])
    now = 100.0
    with Recorder(path) as recorder:

        def act(observation: Tensor) -> Tensor:
            nonlocal now
            now += period
            command = drive(observation)
            for robot, row, (x, y) in zip(ROBOTS, observation[0].tolist(), command[0].tolist(), strict=True):
                recorder.write(Sensed(RobotState.of_observation(robot, now, row), heading=0.0), BodyVelocity(x, y, 0.0))
            return command

        return evaluate_teams(TensorDictModule(act, [OBSERVATION], [ACTION]), env, seed=1_000_003, num_starts=starts)


def wedge_policy():
    policy = load_policy(WEDGE)
    return lambda observation: policy(TensorDict({"agents": {"observation": observation}}, [1]))[ACTION]


def test_a_replayed_run_has_the_metrics_that_it_had_when_it_was_driven(tmp_path):
    expected = recorded(tmp_path / "run.mcap", wedge_policy(), starts=3)
    main(Arguments(tmp_path / "run.mcap", WEDGE, start=1, out=tmp_path / "replay"))
    rows = list(csv.DictReader((tmp_path / "replay/starts.csv").read_text().splitlines()))
    assert len(rows) == 3
    for key, values in expected.items():
        tolerance = 0.02 if key.startswith("jerk") else 1e-4  # a third difference of single precision, over 1e-3 s³
        replayed = torch.tensor([float(row[key]) for row in rows])
        torch.testing.assert_close(replayed, values, rtol=0, atol=tolerance, msg=lambda text, key=key: f"{key}: {text}")
    metrics = json.loads((tmp_path / "replay/metrics.json").read_text())
    assert metrics["team_success_rate"] == 1.0 and metrics["num_starts"] == 3
    assert {path.name for path in (tmp_path / "replay").iterdir()} == {
        "starts.csv", "metrics.json", "trajectories.png", "trajectories.mp4", "jerk.png",
    }  # fmt: skip


def test_robots_that_run_into_the_wall_have_collided(tmp_path):
    def straight(observation: Tensor) -> Tensor:
        return torch.tensor([1.0, 0.0]).expand(1, 5, 2)

    expected = recorded(tmp_path / "run.mcap", straight, starts=1)
    metrics = main(Arguments(tmp_path / "run.mcap", WEDGE, out=tmp_path / "replay"))
    assert (
        metrics["collision_rate"] == pytest.approx(expected["collision_rate"].item())
        and metrics["collision_rate"] > 0.3
    )
    assert metrics["success_rate"] == pytest.approx(expected["success_rate"].item())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": 1}, "start: got 1, the run has starts 0 to 0"),
        ({"speed": 2.0}, "speed: got 2, at which samples should be 0.05 s apart, but they are 0.1 s"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, change, message):
    recorded(tmp_path / "run.mcap", lambda observation: torch.zeros(1, 5, 2), starts=1)
    with pytest.raises(ValueError, match=message):
        main(Arguments(tmp_path / "run.mcap", WEDGE, out=tmp_path / "replay", **change))
    assert not (tmp_path / "replay").exists()
