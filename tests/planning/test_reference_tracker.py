import pytest
import torch

from redig.planning.tracking import ReferenceTracker, pad_references


def reference(steps: int = 60) -> torch.Tensor:
    t = 0.1 * torch.arange(steps)
    return torch.stack([t.sin(), 0.5 * (2 * t).cos()], -1).unsqueeze(1)  # [T, 1, 2]


def drive(tracker: ReferenceTracker, position: torch.Tensor, steps: int) -> torch.Tensor:
    track = [position]
    for step in range(steps):
        position = position + 0.1 * tracker(position, torch.full((len(position),), step))
        track.append(position)
    return torch.stack(track, 1)  # [B, T, n, 2]


def test_a_robot_on_its_reference_stays_on_it():
    path = reference().unsqueeze(0)
    assert torch.allclose(drive(ReferenceTracker(path), path[:, 0], 59), path, atol=1e-5)


def test_an_error_decays_as_the_gain_says():
    path, gain = reference().unsqueeze(0), 2.0
    error = drive(ReferenceTracker(path, gain=gain), path[:, 0] + 1.0, 59) - path
    expected = (1 - gain * 0.1) ** torch.arange(60)
    assert torch.allclose(error[0, :, 0, 0], expected, atol=1e-4)


def test_teams_have_their_own_step_and_rest_at_the_end():
    paths = pad_references([reference(5), reference(9)])
    assert torch.equal(paths[0, 4:], reference(5)[-1:].expand(5, 1, 2))
    step = torch.tensor([2, 100])
    command = ReferenceTracker(paths)(paths[[0, 1], step.clamp_max(8)], step)
    assert torch.allclose(command[0], (paths[0, 3] - paths[0, 2]) / 0.1)
    assert torch.equal(command[1], torch.zeros(1, 2))


def test_a_wrong_shape_is_named():
    with pytest.raises(ValueError, match=r"references: got shape \[5, 1, 2\]"):
        ReferenceTracker(reference(5))
