from dataclasses import replace
from pathlib import Path

import figures
import imageio.v2 as imageio
import pytest
import torch
from PIL import Image

from redig.envs import corridor, random_map
from redig.evaluation import jerk
from redig.policy import build_policy, load_policy, read_header, save_policy

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


def test_other_policies_have_the_figures_that_they_can_have(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(figures, "SUFFIXES", (".png",))
    monkeypatch.setattr(figures, "FRAMES", 2)
    config, scenario = read_header(SHIPPED)
    policies, out = [f"ReDiG={SHIPPED}", "L&F=leader_follower"], tmp_path / "figures"
    for kind in ("gaussian", "deterministic", "ppo"):
        other = replace(config, kind=kind)
        save_policy(tmp_path / kind, build_policy(other), other, {**scenario, "max_steps": 20})
        policies.append(f"{kind}={tmp_path / kind}")
    arguments = figures.Arguments(tuple(policies), out=out, starts=1, seed=77, latents=4)
    crossings = figures.drive(arguments)
    state, _ = figures.situation(crossings["ReDiG"], 0.2)
    for kind in ("gaussian", "deterministic", "ppo"):
        importance = figures.ask(crossings[kind], state)
        assert torch.equal(importance, figures.ask(crossings[kind], state))  # nothing is random
        assert importance.isfinite().all()
        assert figures.others(importance) > 0
    monkeypatch.setattr(figures, "drive", lambda _: crossings)
    figures.main(arguments)
    names = ["denoising-ReDiG.gif", "denoising-ReDiG.png", "importance.png", "jerk.png", "trajectories.png"]
    assert sorted(file.name for file in out.iterdir()) == names
    printed = capsys.readouterr().out
    assert "importance: left out L&F (leader_follower)" in printed
    for name in ("L&F (leader_follower)", "gaussian (gaussian)", "deterministic (deterministic)", "ppo (ppo)"):
        assert printed.count(f"denoising: left out {name}, as it is of diffusion policies only") == 1


def test_planners_alone(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(figures, "SUFFIXES", (".png",))
    figures.main(figures.Arguments(("a=uncoordinated", "b=leader_follower"), out=tmp_path, starts=1))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["jerk.png", "trajectories.png"]
    assert capsys.readouterr().out.count("left out") == 4


@pytest.fixture
def drawn(monkeypatch):
    """The map that each figure was asked for, and the places of the importance; nothing is drawn."""
    maps, monkey = {}, monkeypatch.setattr
    monkey(figures, "SUFFIXES", (".png",))
    monkey(figures, "plot_comparison", lambda *a: maps.update(trajectories=a[4]))
    monkey(figures, "plot_importance", lambda *a: maps.update(importance=a[4], values=a[1], places=a[2]))
    monkey(figures, "animate_denoising", lambda *a: maps.update(denoising=a[4]))
    monkey(figures, "plot_jerk", lambda *a: None)
    monkey(figures, "plot_denoising", lambda *a: None)
    return maps


def test_of_several_maps_that_of_the_start_is_drawn(tmp_path, drawn):
    config, scenario = read_header(SHIPPED)
    file = tmp_path / "policy.safetensors"
    save_policy(file, load_policy(SHIPPED), config, {**scenario, "obstacle_map": "doorway:train", "max_steps": 100})
    arguments = figures.Arguments(("planner=uncoordinated", f"ReDiG={file}"), out=tmp_path, starts=2, start=1, seed=77)
    figures.main(arguments)
    expected = random_map("doorway", 1, "evaluation")
    for name in ("trajectories", "importance", "denoising"):
        assert torch.equal(drawn[name].obstacles, expected.obstacles)
    assert list(drawn["values"]) == ["ReDiG"]
    team = figures.drive(arguments)["planner"].team(1)["position"]
    for place in drawn["places"]:
        assert (team == place).all(-1).all(-1).any()  # where that team once was


def test_a_map_from_a_file_is_drawn(tmp_path, drawn):
    centres = 0.05 * torch.arange(160) - 3.975
    cells = torch.cartesian_prod(centres, centres).flip(-1)
    occupied = (corridor().signed_distance(cells) < 0).reshape(160, 160)
    imageio.imwrite(tmp_path / "map.png", (~occupied).flip(0).numpy().astype("uint8") * 254)
    settings = "image: map.png\nresolution: 0.05\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\ngap: 1.1\n"
    config, scenario = read_header(SHIPPED)
    files = []
    for name, origin in (("a", -4.0), ("b", -4.05)):
        (tmp_path / f"{name}.yaml").write_text(f"{settings}origin: [{origin}, -4.0, 0.0]\n")
        files.append(tmp_path / f"{name}.safetensors")
        place = {"obstacle_map": str(tmp_path / f"{name}.yaml")}
        save_policy(files[-1], load_policy(SHIPPED), config, {**scenario, **place})
    figures.main(figures.Arguments((f"ReDiG={files[0]}",), out=tmp_path, starts=1, seed=77, latents=2))
    for name in ("trajectories", "importance", "denoising"):
        assert torch.equal(drawn[name].occupied, occupied)
    assert drawn["values"]["ReDiG"].isfinite().all()
    assert figures.others(drawn["values"]["ReDiG"]) > 0
    with pytest.raises(ValueError, match="'b' was trained in another scenario than 'a'"):
        figures.drive(figures.Arguments((f"a={files[0]}", f"b={files[1]}"), starts=1))


def test_bad_input_is_named(idle, tmp_path):
    for entry in ("no-name", "=file", "name="):
        with pytest.raises(ValueError, match=f"policy: got '{entry}', expected NAME=FILE or NAME=METHOD"):
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
