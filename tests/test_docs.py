"""The site builds without a warning, its code runs, and it has every public name with an example."""

import doctest
import importlib
import inspect
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from mkdocstrings import Inventory

import redig

ROOT = Path(__file__).parents[1]
PAGES = [page for page in sorted((ROOT / "docs").rglob("*.md")) if "```python" in page.read_text()]
MODULES = ["redig", *sorted(module.name for module in pkgutil.walk_packages(redig.__path__, "redig."))]
PUBLIC = [
    "redig",
    *(
        f"redig.{name}"
        for name in ("modules", "objectives", "envs", "planning", "baselines", "evaluation", "viz", "deploy", "physics")
    ),
]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}  # the theme's advertisement of its successor
    build = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert build.returncode == 0, build.stderr
    assert "WARNING" not in build.stderr, build.stderr
    return folder


def is_documentable(thing):
    return inspect.isclass(thing) or inspect.isfunction(thing)


def public(module):
    """Functions and classes that a module defines, by name."""
    things = vars(importlib.import_module(module)).items()
    return {
        name: thing
        for name, thing in things
        if is_documentable(thing) and not name.startswith("_") and thing.__module__ == module
    }


def test_the_site_asks_no_other_server_for_anything(site):
    for page in site.rglob("*.html"):
        for attribute in ('src="http', 'rel="stylesheet" href="http', 'rel="preconnect" href="http'):
            assert attribute not in page.read_text(), page


def test_no_markup_of_a_docstring_is_left_unread(site):
    """A Returns section whose text has an early colon is taken for a type and stays as it was typed."""
    for page in site.glob("api/**/*.html"):
        for markup in ("``", ":class:", ":func:", ":meth:", ":mod:"):
            assert markup not in page.read_text(), page


@pytest.mark.parametrize("package", PUBLIC)
def test_every_exported_name_is_on_the_site(site, package):
    with open(site / "objects.inv", "rb") as file:
        documented = Inventory.parse_sphinx(file)
    module = importlib.import_module(package)
    for name in module.__all__:
        thing = getattr(module, name)
        if is_documentable(thing):
            assert f"{thing.__module__}.{thing.__qualname__}" in documented, name


@pytest.mark.parametrize("module", MODULES)
def test_every_public_function_and_class_has_an_example_with_a_result(module):
    for name, thing in public(module).items():
        (found,) = doctest.DocTestFinder(recurse=False, exclude_empty=False).find(thing, name)
        assert any(example.want for example in found.examples), f"{module}.{name}"


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_code_on_the_pages_runs(page, python_blocks, tmp_path, monkeypatch):
    (tmp_path / "recipes").symlink_to(ROOT / "recipes")  # examples are run in the folder of the repository
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    names = {"__name__": "page"}
    for number, block in enumerate(python_blocks(page)):
        exec(compile(block, f"{page.name}, block {number}", "exec"), names)
