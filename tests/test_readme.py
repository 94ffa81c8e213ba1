import re
from pathlib import Path

import pytest
import torch

README = Path(__file__).parents[1] / "README.md"


@pytest.fixture
def example(python_blocks):
    (code,) = python_blocks(README)
    return code


def test_the_composition_example_runs_and_trains_every_network(example):
    torch.manual_seed(0)
    names = {}
    exec(example, names)
    assert torch.isfinite(names["losses"]["loss_qvalue"]) and torch.isfinite(names["losses"]["loss_actor"])
    assert len(names["buffer"]) == 1600
    for network in ("encoder_network", "actor_network", "qvalue_network"):
        learned = getattr(names["loss"], f"{network}_params").flatten_keys()
        target = getattr(names["loss"], f"target_{network}_params").flatten_keys()
        assert any(not torch.equal(learned[key], target[key]) for key in learned.keys()), network  # noqa: SIM118


def test_the_composition_example_is_short(example):
    lines = [line for line in example.splitlines() if line and not line.startswith(("from ", "import "))]
    assert len(lines) <= 25


def test_files_that_the_readme_links_exist():
    for target in re.findall(r"\]\(([^)#:]+)\)", README.read_text()):
        assert (README.parent / target).exists(), target
