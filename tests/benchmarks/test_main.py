import importlib.util
import sys
from pathlib import Path

import pytest
import torch

PATH = Path(__file__).parents[2] / "benchmarks" / "__main__.py"


@pytest.fixture
def program(monkeypatch):
    spec = importlib.util.spec_from_file_location("all_benchmarks", PATH)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def write(folder, name, code):
    (folder / f"{name}.py").write_text(code)


def test_each_runs_alone_with_one_thread_and_the_folder(program, tmp_path, monkeypatch, capfd):
    write(tmp_path, "update", "import os, sys; print(sys.argv[1:], os.environ['OMP_NUM_THREADS'])")
    write(tmp_path, "memory", "raise SystemExit(3)")
    write(tmp_path, "gpu", "print('the last')")
    monkeypatch.setattr(program, "__file__", str(tmp_path / "__main__.py"))
    with pytest.raises(SystemExit, match=r"^failed: memory$"):
        program.main(program.Arguments(only=("update", "memory", "gpu"), out=tmp_path / "out"))
    printed = capfd.readouterr().out.splitlines()
    expected = ["--- update", f"['--out', '{tmp_path / 'out'}'] 1", "--- memory", "--- gpu", "the last"]
    assert [line for line in printed if line] == expected


def test_unknown_names_stop_before_anything_runs(program, monkeypatch):
    monkeypatch.setattr(program, "run", lambda *_: pytest.fail("it ran"))
    with pytest.raises(ValueError, match="only: got speed, allowed are action, control, update"):
        program.main(program.Arguments(only=("update", "speed")))


@pytest.mark.skipif(torch.cuda.is_available(), reason="would measure for minutes")
def test_a_real_one(program, tmp_path):
    program.main(program.Arguments(only=("gpu",), out=tmp_path))
