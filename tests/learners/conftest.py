"""The recipes, started as from the command line."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from damian.recipes.shared.launch import launch


@pytest.fixture
def run(tmp_path, monkeypatch) -> Callable[..., Path]:
    """Run a recipe with overrides in an empty folder; returns its run folder."""
    monkeypatch.chdir(tmp_path)

    def run_recipe(recipe, *overrides: str, folder: str = "run") -> Path:
        monkeypatch.setattr(sys, "argv", ["recipe.py", *overrides, f"hydra.run.dir={folder}"])
        launch(recipe.main)
        return tmp_path / folder

    return run_recipe
