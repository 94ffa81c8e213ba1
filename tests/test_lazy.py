"""``import redig`` imports nothing heavy, and yet every name and submodule is there when asked for."""

import subprocess
import sys

import pytest

import redig


def test_names_are_imported_when_asked_for():
    program = """
import sys
import redig
assert redig.__version__ and "torch" not in sys.modules
assert set(redig.__all__) <= set(dir(redig)) and "torch" not in sys.modules
assert redig.policy.PolicyConfig is redig.PolicyConfig
from redig import DDPM, corridor
from redig.modules import DDPM as same
assert DDPM is same
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", redig.__all__)
def test_every_name_is_that_of_its_module(name):
    thing = getattr(redig, name)
    assert thing is getattr(sys.modules[thing.__module__], name)


def test_unknown_name():
    with pytest.raises(AttributeError, match="module 'redig' has no attribute 'nothing'"):
        redig.nothing  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'nothing'"):
        from redig import nothing  # noqa: F401
