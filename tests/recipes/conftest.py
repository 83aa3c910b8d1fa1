"""The training recipe, started as from the command line."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from damian.recipes.train import main


@pytest.fixture
def run(tmp_path, monkeypatch) -> Callable[..., Path]:
    """Run the recipe with overrides in an empty folder; returns its run folder."""
    monkeypatch.chdir(tmp_path)

    def run_recipe(*overrides: str, folder: str = "run") -> Path:
        monkeypatch.setattr(sys, "argv", ["damian train", *overrides, f"hydra.run.dir={folder}"])
        main()
        return tmp_path / folder

    return run_recipe
