"""The programs, started as from the command line."""

import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest


@pytest.fixture
def run(tmp_path, monkeypatch) -> Callable[..., Path]:
    """Run a program with words in an empty folder; returns its run folder."""
    monkeypatch.chdir(tmp_path)

    def start(*words: str, program: str = "train", folder: str = "run") -> Path:
        words = (*words, *[f"hydra.run.dir={folder}"] * bool(folder))
        monkeypatch.setattr(sys, "argv", [f"damian {program}", *words])
        import_module(f"damian.recipes.{program}").main()
        return tmp_path / folder

    return start
