import runpy
import subprocess
import sys
from pathlib import Path

import pytest

RECIPES = Path(__file__).parents[2] / "recipes"
sys.path.insert(0, str(RECIPES))


def command(name, *arguments):
    return [sys.executable, str(RECIPES / name), *map(str, arguments)]


@pytest.fixture
def printed_help(monkeypatch, capsys):
    """What a recipe prints when it is run with ``--help``, in this process, which has its imports already."""

    def printed(name):
        monkeypatch.setattr(sys, "argv", [name, "--help"])
        monkeypatch.setenv("COLUMNS", "200")
        with pytest.raises(SystemExit) as end:
            runpy.run_path(str(RECIPES / name), run_name="__main__")
        assert end.value.code == 0
        return capsys.readouterr().out

    return printed


@pytest.fixture(scope="session")
def smoke(tmp_path_factory):
    """One complete run at toy size, shared by all tests: its folder and what it printed."""
    folder = tmp_path_factory.mktemp("runs") / "smoke"
    done = subprocess.run(
        command("redig_wedge.py", "--smoke", "--out", folder, "--threads", 1), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder, done.stdout
