from pathlib import Path

import figures
import pytest
import torch
from PIL import Image

from redig.evaluation import jerk
from redig.policy import build_policy, read_header, save_policy

SHIPPED = Path(figures.__file__).parent / "policies" / "wedge.safetensors"


@pytest.fixture(scope="module")
def idle(tmp_path_factory):
    """A policy file for the same scenario, of robots that stay where they are."""
    config, scenario = read_header(SHIPPED)
    policy = build_policy(config)
    for weight in policy[-1].parameters():
        weight.data.zero_()  # no noise is seen in the zero latent
    path = tmp_path_factory.mktemp("policies") / "idle.safetensors"
    save_policy(path, policy, config, scenario)
    return path


def test_every_figure_is_drawn(idle, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(figures, "SUFFIXES", (".png",))
    monkeypatch.setattr(figures, "FRAMES", 3)
    policies = (f"ReDiG={SHIPPED}", f"at rest={idle}")
    figures.main(figures.Arguments(policies, out=tmp_path, starts=2, seed=77, latents=4))
    names = ["trajectories", "jerk", "importance", "denoising-ReDiG", "denoising-at-rest"]
    expected = [f"{name}.png" for name in names]
    expected += ["denoising-ReDiG.gif", "denoising-at-rest.gif"]
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(expected)
    for name in names:
        with Image.open(tmp_path / f"{name}.png") as image:
            assert image.width == 1400
    assert "2 of 2 teams come there" in capsys.readouterr().out


def test_situations_are_those_of_the_crossing(idle):
    arguments = figures.Arguments((f"ReDiG={SHIPPED}", f"b={idle}"), starts=3, seed=77)
    crossings = figures.drive(arguments)
    first, second = crossings.values()
    assert torch.equal(first.rollout["position"][:, 0], second.rollout["position"][:, 0])
    state, reached = figures.situation(first, 0.5)
    assert reached.all()
    assert state["position"].mean(-2).norm(dim=-1).max() < 0.3  # half way is the middle of the map
    assert not figures.situation(first, 1.5)[1].any()
    observation = first.observe(state, state["position"])
    torch.testing.assert_close(observation[..., :2], state["position"])
    torch.testing.assert_close(observation[..., 2:4], state["velocity"])
    # the command at a state of the rollout is the one that was given there: the next velocity is nearer to it
    team = first.team(0)
    sample = int((team["position"] - state["position"][0]).norm(dim=-1).sum(-1).argmin())
    command = first.act(observation)[0]
    before, after = ((team["velocity"][k] - command).norm(dim=-1) for k in (sample, sample + 1))
    assert (after <= before + 1e-6).all()
    assert (after < 0.2).all()
    assert jerk(team["position"], 0.1).shape == team["arrived"][2:-1].shape


def test_bad_input_is_named(idle, tmp_path):
    for entry in ("no-name", "=file", "name="):
        with pytest.raises(ValueError, match=f"policy: got '{entry}', expected NAME=FILE"):
            figures.drive(figures.Arguments((entry,), out=tmp_path))
    with pytest.raises(ValueError, match="start: got 4"):
        figures.drive(figures.Arguments((f"a={SHIPPED}",), starts=4, start=4))
    with pytest.raises(ValueError, match="name of its own"):
        figures.drive(figures.Arguments((f"a={SHIPPED}", f"a={idle}"), starts=1))
    config, scenario = read_header(SHIPPED)
    other = tmp_path / "other.safetensors"
    save_policy(other, build_policy(config), config, {**scenario, "corridor_width": 1.5})
    with pytest.raises(ValueError, match="policy: 'b' was trained in another scenario than 'a'"):
        figures.drive(figures.Arguments((f"a={SHIPPED}", f"b={other}"), starts=1))
    with pytest.raises(ValueError, match="no team of 'a' gets there"):
        arguments = figures.Arguments((f"a={idle}",), starts=1, out=tmp_path)
        figures.draw_importance(arguments, figures.drive(arguments))
    assert list(tmp_path.iterdir()) == [other]
