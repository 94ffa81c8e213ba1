import json
import re
import shutil
import subprocess
import sys
from dataclasses import asdict

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from redig.deploy import export_policy, load_policy
from redig.modules import DDIM
from redig.policy import PolicyConfig, build_policy

CONFIG = PolicyConfig(9, embedding_dim=6, encoder_hidden=6, hidden=(8,), diffusion_steps=10, sampling_steps=5)
SCENARIO = {"formation": "wedge", "n_robots": 5}


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    folder, policy = tmp_path_factory.mktemp("files"), build_policy(CONFIG)
    export_policy(policy, folder / "plain.onnx", CONFIG, SCENARIO)
    export_policy(policy, folder / "stochastic.onnx", stochastic=True)
    return folder / "plain.onnx", folder / "stochastic.onnx"


def changed(path, tmp_path, change):
    """The same file after a change of the model in it."""
    model = onnx.load(path)
    change(model)
    onnx.save(model, tmp_path / "changed.onnx")
    return tmp_path / "changed.onnx"


def test_header(paths):
    policy = load_policy(paths[0])
    assert policy.config == json.loads(json.dumps(asdict(CONFIG))) and policy.environment == SCENARIO
    assert policy.sampler == {"name": "DDPM", "num_steps": 5, "noise_ratio": 1.0, "early_stop": None}
    assert not policy.stochastic and not policy.ego
    policy = load_policy(paths[1])
    assert policy.config is None and policy.environment == {} and policy.stochastic


def test_header_names_the_sampler_in_use(tmp_path):
    actor = build_policy(CONFIG)[-1].with_sampler(DDIM(3, 0.5))
    export_policy(actor, tmp_path / "actor.onnx", CONFIG)
    policy = load_policy(tmp_path / "actor.onnx")
    assert policy.sampler == {"name": "DDIM", "num_steps": 3, "eta": 0.5}
    with pytest.raises(ValueError, match=re.escape("embedding: got shape [5, 9], expected [*B, n, 6]")):
        policy(np.zeros((5, 9)))


PROGRAM = """
import sys
import redig.deploy
robots = redig.deploy.load_policy(sys.argv[1])
assert robots([[0.0] * 9] * 5).shape == (5, 2)
heavy = {"torch", "torchrl", "tensordict", "torch_geometric", "vmas", "onnx", "onnx_ir"} & set(sys.modules)
assert not heavy, heavy
"""


def test_robots_need_no_torch(paths):
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(paths[0])], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "missing, module", [("onnxruntime", "redig.deploy.runtime"), ("onnxscript", "redig.deploy.export")]
)
def test_missing_package_names_the_extra(missing, module):
    program = f"import sys; sys.modules['{missing}'] = None; import {module}"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "pip install 'redig[onnx]'" in done.stderr


def test_seeds(paths):
    team = np.random.default_rng(0).standard_normal((5, 9))
    first, again, other = (load_policy(paths[1], seed=seed) for seed in (1, 1, 2))
    actions = [first(team), first(team)]
    assert np.array_equal(actions, [again(team), again(team)])
    assert not np.array_equal(actions[0], actions[1])
    assert not np.array_equal(actions[0], other(team))
    assert not np.array_equal(load_policy(paths[1])(team), load_policy(paths[1])(team))


def test_threads(paths):
    team = np.random.default_rng(0).standard_normal((5, 9))
    np.testing.assert_allclose(load_policy(paths[0], threads=2)(team), load_policy(paths[0])(team), atol=1e-6)
    with pytest.raises(ValueError, match="threads: got 0, must be at least 1"):
        load_policy(paths[0], threads=0)


@pytest.mark.parametrize("shape", [(5, 7), (9,), (0, 9), (2, 5, 9, 1)])
def test_wrong_observation_names_what_is_expected(paths, shape):
    message = f"observation: got shape {list(shape)}, expected [*B, n, 9] with n of at least 1"
    with pytest.raises(ValueError, match=re.escape(message)):
        load_policy(paths[0])(np.zeros(shape))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_observation_that_is_not_finite(paths, value):
    team = np.zeros((5, 9))
    team[3, 4] = value
    with pytest.raises(ValueError, match="observation: got values that are not finite"):
        load_policy(paths[0])(team)


def test_wrong_latent_and_noise(paths):
    team = np.zeros((3, 5, 9))
    plain, stochastic = map(load_policy, paths)
    for name in ("latent", "noise"):
        with pytest.raises(ValueError, match=f"{name}: this policy takes none"):
            plain(team, **{name: np.zeros((3, 5, 2))})
    with pytest.raises(ValueError, match=re.escape("latent: got shape [5, 2], expected [3, 5, 2]")):
        stochastic(team, latent=np.zeros((5, 2)))
    with pytest.raises(ValueError, match=re.escape("noise: got shape [5, 3, 5, 2], expected [4, 3, 5, 2]")):
        stochastic(team, noise=np.zeros((5, 3, 5, 2)))


def test_missing_file(tmp_path):
    for path in (tmp_path / "absent.onnx", tmp_path):
        with pytest.raises(FileNotFoundError, match=re.escape(f"policy: no such file: {path}")):
            load_policy(path)


@pytest.mark.parametrize("part", [0.0, 0.01, 0.3, 0.6, 0.9, 0.999])
def test_truncated_file(paths, tmp_path, part):
    content = paths[0].read_bytes()
    path = tmp_path / "truncated.onnx"
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(ValueError, match=re.escape(str(path))):
        load_policy(path)


def test_other_files(tmp_path):
    path = tmp_path / "policy.onnx"
    shutil.copy("recipes/policies/wedge.safetensors", path)
    with pytest.raises(ValueError, match=re.escape(f"{path} is not an ONNX file, or is damaged")):
        load_policy(path)


@pytest.mark.parametrize(
    "key, value, message",
    [
        ("format", "redig-onnx-0", "has format 'redig-onnx-0', expected 'redig-onnx-1'"),
        ("format", None, "has format None"),
        ("policy", "{", "the header of .* is damaged"),
        ("sampler", None, "the header of .* is damaged"),
    ],
)
def test_header_that_does_not_fit(paths, tmp_path, key, value, message):
    def change(model):
        kept = [prop for prop in model.metadata_props if prop.key != key]
        del model.metadata_props[:]
        model.metadata_props.extend(kept)
        if value is not None:
            model.metadata_props.add(key=key, value=value)

    with pytest.raises(ValueError, match=message):
        load_policy(changed(paths[0], tmp_path, change))


def test_weights_in_another_file_are_refused(paths, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def change(model):
        weight = max(model.graph.initializer, key=lambda tensor: np.prod(tensor.dims))
        (tmp_path / "weights.bin").write_bytes(numpy_helper.to_array(weight).tobytes())
        weight.ClearField("raw_data")
        weight.data_location = TensorProto.EXTERNAL
        weight.external_data.add(key="location", value="weights.bin")

    model = onnx.load(paths[0])
    change(model)
    (tmp_path / "changed.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(ValueError, match=r"changed\.onnx is not an ONNX file, or is damaged .*[Ee]xternal data"):
        load_policy("changed.onnx")


def test_operators_of_someones_own_are_refused(paths, tmp_path):
    def change(model):
        model.graph.node.append(helper.make_node("Surprise", ["observation"], ["unused"], domain="elsewhere"))
        model.opset_import.append(helper.make_opsetid("elsewhere", 1))

    with pytest.raises(ValueError, match="elsewhere:Surprise"):
        load_policy(changed(paths[0], tmp_path, change))
