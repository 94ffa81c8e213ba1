import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from redig.planning.tracking import PathTracker, pad_paths

PATH = torch.tensor([[0.0, 0.0], [1.5, 0.5], [3.0, 0.5], [4.0, -0.5]])


def drive(tracker: PathTracker, position: torch.Tensor, steps: int, limit: float = 2.0, dt: float = 0.1):
    """Robots whose velocity follows the command within an acceleration limit: positions and velocities of all steps."""
    velocity, positions, velocities = torch.zeros_like(position), [], []
    for _ in range(steps):
        change = tracker(position) - velocity
        norm = change.norm(dim=-1, keepdim=True)
        velocity = velocity + change * (limit * dt / norm.clamp_min(limit * dt))
        position = position + dt * velocity
        positions.append(position)
        velocities.append(velocity)
    return torch.stack(positions), torch.stack(velocities)


def distance_to_path(point: torch.Tensor, path: torch.Tensor) -> float:
    share = torch.linspace(0, 1, 1000).unsqueeze(-1)
    dense = torch.cat([a + share * (b - a) for a, b in pairwise(path)])
    return (dense - point).norm(dim=-1).min().item()


@pytest.mark.parametrize("speed", [0.5, 0.75, 1.0])
def test_robot_arrives_stops_and_stays_near_its_path(speed):
    tracker = PathTracker(PATH.unsqueeze(0), torch.tensor([speed]))
    length = PATH.diff(dim=0).norm(dim=-1).sum().item()
    positions, velocities = drive(tracker, torch.zeros(1, 2), steps=math.ceil((length / speed + 2) / 0.1))
    assert (positions[-1, 0] - PATH[-1]).norm() < 0.02
    assert velocities[-1].norm() < 0.05
    assert velocities.norm(dim=-1).max() <= speed + 1e-5
    assert max(distance_to_path(p, PATH) for p in positions[:, 0]) < 0.08
    beyond = ((positions[:, 0] - PATH[-1]) * torch.tensor([1.0, -1.0]) / math.sqrt(2)).sum(-1)
    assert beyond.max() < 0.05  # no overshoot


@pytest.mark.parametrize("speed", [0.5, 0.75, 1.0])
def test_own_speed_is_kept_along_a_straight_path(speed):
    tracker = PathTracker(torch.tensor([[[0.0, 0.0], [6.0, 0.0]]]), torch.tensor([speed]))
    positions, velocities = drive(tracker, torch.zeros(1, 2), steps=50)
    steady = (positions[..., 0] > 1) & (positions[..., 0] < 5.5)
    assert torch.allclose(velocities.norm(dim=-1)[steady], torch.tensor(speed), atol=1e-4)


@given(x=st.floats(-0.5, 4.5), y=st.floats(-1, 1), speed=st.floats(0.1, 1))
@settings(max_examples=60, deadline=None)
def test_command_equals_a_search_along_the_densely_sampled_path(x, y, speed):
    share = torch.linspace(0, 1, 3001).unsqueeze(-1)
    dense = torch.cat([a + share * (b - a) for a, b in pairwise(PATH)])
    travelled = torch.cat([torch.zeros(1), dense.diff(dim=0).norm(dim=-1).cumsum(0)])
    position = torch.tensor([x, y])
    gap = (dense - position).norm(dim=-1)
    nearest = int(gap.argmin())
    rival = (travelled - travelled[nearest]).abs() > 0.1
    if gap[rival].min() < gap[nearest] + 1e-3:
        return  # two places of the path are equally near: either is right
    target = dense[(travelled - travelled[nearest] - 0.3).abs().argmin()]
    left = max((travelled[-1] - travelled[nearest]).item(), (PATH[-1] - position).norm().item())
    if left < 1e-2:
        return  # the heading of a robot that stands at its goal is arbitrary
    expected = (target - position) / (target - position).norm() * min(speed, math.sqrt(3.0 * left), left / 0.2)
    command = PathTracker(PATH.unsqueeze(0), torch.tensor([speed]))(position.unsqueeze(0))[0]
    assert torch.allclose(command, expected, atol=2e-2)


def test_padding_changes_no_command():
    generator = torch.Generator().manual_seed(0)
    paths = [PATH, PATH[:2], PATH[:3]]
    speed = torch.tensor([0.5, 0.8, 1.0])
    padded = pad_paths(paths)
    assert padded.shape == (3, 4, 2)
    for _ in range(20):
        position = torch.rand(3, 2, generator=generator) * 4
        together = PathTracker(padded, speed)(position)
        for i, path in enumerate(paths):
            alone = PathTracker(path.unsqueeze(0), speed[i : i + 1])(position[i : i + 1])
            assert torch.allclose(together[i], alone[0], atol=1e-5)


def test_a_robot_already_at_its_goal_stands_still():
    here = torch.ones(1, 2, 2)
    assert torch.equal(PathTracker(here, torch.ones(1))(torch.ones(1, 2)), torch.zeros(1, 2))


@pytest.mark.parametrize(
    ("paths", "speed", "message"),
    [
        (torch.zeros(3, 1, 2), torch.ones(3), "paths: got shape"),
        (torch.zeros(4, 2), torch.ones(1), "paths: got shape"),
        (torch.zeros(3, 4, 2), torch.ones(2), "speed: got shape"),
    ],
)
def test_wrong_shapes_are_named(paths, speed, message):
    with pytest.raises(ValueError, match=message):
        PathTracker(paths, speed)
