import os
import signal
import sys
import threading
from functools import partial
from pathlib import Path

import cloudpickle
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import AdditiveGaussianModule

from redig.envs import make_env
from redig.objectives import MultiStep
from redig.ray_collection import RayCollection

on_request = pytest.mark.skipif(
    "REDIG_TEST_RAY" not in os.environ, reason="starts a Ray cluster, which takes minutes; set REDIG_TEST_RAY=1"
)

OBSERVATION, ACTION, BASE = ("agents", "observation"), ("agents", "action"), ("agents", "policy_action")
ENV = partial(make_env, formation="line", n_robots=3)


def die_once(action, flag):
    """Kill this process without notice if there is a flag; only one process finds it. Raise if there is a fault."""
    if flag.exists():
        flag.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    if flag.with_name("fault").exists():
        raise RuntimeError("a fault of the policy")
    return action.clone()


def collection(flag=Path("no flag"), **options):
    """Two workers with eight teams; the policy's action is the bias of ``linear``, and noise is added to it."""
    linear = nn.Linear(9, 2)
    nn.init.zeros_(linear.weight)
    nn.init.constant_(linear.bias, 0.1)
    noise = AdditiveGaussianModule(ENV(1).action_spec, 0.1, 0.1, action_key=ACTION)
    policy = TensorDictSequential(
        TensorDictModule(linear, [OBSERVATION], [ACTION]),
        TensorDictModule(partial(die_once, flag=flag), [ACTION], [BASE]),
        noise,
    )
    given = {
        "num_envs": 8,
        "num_steps": 5,
        "num_workers": 2,
        "address": os.environ.get("RAY_ADDRESS", "local"),
        "seed": 0,
    }
    return RayCollection(ENV, policy, **{**given, **options}), linear


@on_request
def test_a_worker_that_dies_while_it_collects_costs_no_batch(tmp_path):
    pytest.importorskip("ray", reason="needs ray: pip install 'redig[ray]'")
    cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers cannot import this file
    experience, linear = collection(tmp_path / "flag", postproc=MultiStep(3, 0.9, keep=[ACTION, BASE]))
    try:
        data = next(experience)
        assert data.shape == (2, 4, 5)
        assert (data[BASE] == 0.1).all() and not torch.equal(data[ACTION][0], data[ACTION][1])
        assert data["steps_to_next_obs"][0, 0, :, 0, 0].tolist() == [3, 3, 3, 2, 1]

        nn.init.constant_(linear.bias, 0.2)
        assert (next(experience)[BASE] == 0.2).all()  # the weights have arrived

        (tmp_path / "flag").touch()
        nn.init.constant_(linear.bias, 0.3)
        with pytest.warns(UserWarning, match="lost a worker, all are started again: The actor died"):
            again = next(experience)
        assert not (tmp_path / "flag").exists() and experience.restarts == 1
        assert again.shape == data.shape and (again[BASE] == 0.3).all()
        assert not torch.allclose(again[ACTION] - 0.3, data[ACTION] - 0.1)  # no repetition
        assert (next(experience)[BASE] == 0.3).all()

        (tmp_path / "fault").touch()
        with pytest.raises(RuntimeError, match="a fault of the policy"):
            next(experience)
        assert experience.restarts == 1
    finally:
        experience.shutdown()


@pytest.fixture
def slow_start(monkeypatch):
    """A function that makes a collection without a cluster, whose workers fail to start so many times."""
    ray = pytest.importorskip("ray", reason="needs ray: pip install 'redig[ray]'")
    released, connected = threading.Event(), []

    def make(failures):
        def start(experience):
            if experience.restarts < failures:
                released.wait(60)  # as RayCollector was seen to
            return [torch.tensor(experience.restarts)]

        monkeypatch.setattr(RayCollection, "START_TIMEOUT", 0.05)
        monkeypatch.setattr(RayCollection, "_start", start)
        monkeypatch.setattr(RayCollection, "shutdown", lambda experience: setattr(experience, "collector", None))
        monkeypatch.setattr(ray, "is_initialized", lambda: False)
        monkeypatch.setattr(ray, "init", lambda *_, **__: connected.append("init"))
        monkeypatch.setattr(ray, "shutdown", lambda: connected.append("shutdown"))
        return collection()[0], connected

    yield make
    released.set()


def test_workers_that_never_start_are_given_up_and_started_again(slow_start):
    experience, connected = slow_start(failures=2)
    with pytest.warns(UserWarning, match="workers did not start within 0.05 s"):
        assert next(experience) == 2
    assert connected == ["init", "shutdown", "init", "shutdown", "init"]


def test_workers_that_never_start_at_all_are_an_error(slow_start):
    experience, _ = slow_start(failures=3)
    with pytest.warns(UserWarning), pytest.raises(TimeoutError, match="workers did not start within 0.05 s"):
        next(experience)


@pytest.mark.parametrize("workers", [0, 3])
def test_workers_share_the_environments_equally(workers):
    with pytest.raises(ValueError, match=f"num_workers: got {workers}, must be at least 1 and divide num_envs = 8"):
        collection(num_workers=workers)


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"pip install 'redig\[ray\]'"):
        collection()
