"""A folder with the files of examples/extending/, and programs that are started from it."""

import importlib
import shutil
from pathlib import Path

import pytest

from damian.recipes.command import main

EXAMPLES = Path(__file__).parents[2] / "examples" / "extending"


@pytest.fixture
def example(request, monkeypatch):
    """The module of the examples that a test module tests, test_NAME.py."""
    name = request.module.__name__.removeprefix("test_")
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module(name)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder with a copy of the examples, from which programs are started."""
    shutil.copytree(
        EXAMPLES, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__")
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(folder, few_figures):
    """Run a program of the command with overrides; returns its run folder."""

    def run_program(*overrides, program="train", name="run"):
        main([program, *overrides, f"hydra.run.dir={name}"])
        return folder / name

    return run_program
