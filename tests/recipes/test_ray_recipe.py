import os

import pytest
import redig_wedge
from config import Config

from redig.checkpoint import load_checkpoint
from redig.ray_collection import RayCollection

on_request = pytest.mark.skipif(
    "REDIG_TEST_RAY" not in os.environ, reason="starts a Ray cluster, which takes minutes; set REDIG_TEST_RAY=1"
)


@on_request
def test_a_run_that_loses_a_worker_midway_trains_to_its_end(tmp_path, monkeypatch):
    ray = pytest.importorskip("ray", reason="needs ray: pip install 'redig[ray]'")
    monkeypatch.setattr(redig_wedge, "finish", lambda run, config: {})
    collect, batches = RayCollection.__next__, []

    def collect_and_lose(experience):
        if len(batches) == 1:
            ray.kill(experience.collector.remote_collectors[1])
        batches.append(collect(experience))
        return batches[-1]

    monkeypatch.setattr(RayCollection, "__next__", collect_and_lose)
    address = os.environ.get("RAY_ADDRESS", "local")
    with pytest.warns(UserWarning, match="lost a worker, all are started again"):
        redig_wedge.train(Config(smoke=True, out=tmp_path / "run", threads=1, ray=address))
    assert [tuple(batch.shape) for batch in batches] == [(2, 4, 20)] * 3
    saved = load_checkpoint(tmp_path / "run" / "checkpoint.pt")
    assert saved["counters"]["online"] == 2 and "collection" not in saved
    assert saved["buffer"]["size"] == 3 * 8 * 20
    assert saved["buffer"]["data"]["steps_to_next_obs"].max() == 5
    assert (tmp_path / "run" / "last.safetensors").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ray_workers": 0}, "ray_workers: got 0"),
        ({"ray": "local", "ray_workers": 5}, "ray_workers: got 5, must divide num_envs = 64"),
        ({"ray": "local", "best_of_n": 2}, "best_of_n: with ray it must be 1"),
    ],
)
def test_bad_options_stop_before_any_training(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        redig_wedge.train(Config(out=tmp_path / "run", **options))
    assert not (tmp_path / "run").exists()
