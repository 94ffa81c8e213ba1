import csv

import samplers


def test_tables_of_a_policy(smoke, tmp_path, monkeypatch):
    folder, _ = smoke
    monkeypatch.setattr(samplers, "STEPS", (1, 5))
    arguments = samplers.Arguments(
        [folder / "policy.safetensors"] * 2, out=tmp_path, starts=2, max_steps=3, critics=[folder] * 2
    )
    samplers.main(arguments)
    rows = list(csv.DictReader((tmp_path / "samplers.csv").open()))
    assert len(rows) == 2 * 3 * 2
    assert {row["sampler"] for row in rows} == {"DDPM, noise 0", "DDIM", "DPM-Solver++(2M)"}
    assert all(float(row["latency_ms"]) > 0 and float(row["action_error"]) >= 0 for row in rows)
    settings = {row["setting"] for row in csv.DictReader((tmp_path / "smoothness.csv").open())}
    assert any("best of 4 by min Q" in setting for setting in settings)
    assert "± 0.000" in (tmp_path / "samplers.md").read_text()  # the same policy twice
