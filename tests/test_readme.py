import re
from pathlib import Path

import torch

README = (Path(__file__).parents[1] / "README.md").read_text()


def example():
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    return code


def test_the_composition_example_runs_and_learns_something():
    torch.manual_seed(0)
    names = {}
    exec(example(), names)
    assert torch.isfinite(names["losses"]["loss_qvalue"]) and torch.isfinite(names["losses"]["loss_actor"])
    assert len(names["buffer"]) == 1600
    fresh = names["QNetwork"](64, 2)
    assert names["loss"].qvalue_network_params.numel() > 0 and isinstance(fresh, torch.nn.Module)
    moved = names["loss"].target_actor_network_params.flatten_keys(), names["loss"].actor_network_params.flatten_keys()
    assert any(not torch.equal(moved[0][key], moved[1][key]) for key in moved[0].keys())  # noqa: SIM118


def test_the_composition_example_is_short():
    lines = [line for line in example().splitlines() if line and not line.startswith(("from ", "import "))]
    assert len(lines) <= 25


def test_files_that_the_readme_links_exist():
    root = Path(__file__).parents[1]
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (root / target).exists(), target
