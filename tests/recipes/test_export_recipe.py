import export
import pytest

from redig.deploy import load_policy


@pytest.mark.parametrize("options", [{}, {"sampler": "ddim", "sampling_steps": 3, "ego": True}])
def test_figures_of_the_shipped_policy(options, tmp_path, capsys):
    path = tmp_path / "wedge.onnx"
    arguments = export.Arguments(export.Path("recipes/policies/wedge.safetensors"), out=path, repeats=3, **options)
    figures = export.main(arguments)
    assert figures["largest difference to the module (m/s)"] < 1e-5
    assert figures["size (kB)"] == path.stat().st_size / 1e3
    assert f"{path}: D" in capsys.readouterr().out
    policy = load_policy(path)
    assert policy.environment["formation"] == "wedge" and policy.config["observation_dim"] == 9
    assert policy.ego == options.get("ego", False)
    assert policy.sampler["num_steps"] == options.get("sampling_steps", 5)


def test_stochastic(tmp_path):
    path = tmp_path / "wedge.onnx"
    export.main(export.Arguments(export.Path("recipes/policies/wedge.safetensors"), path, stochastic=True, repeats=3))
    assert load_policy(path).stochastic
