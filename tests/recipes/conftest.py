"""The programs, started as from the command line."""

import sys
from importlib import import_module

import pytest


@pytest.fixture
def run(tmp_path, monkeypatch, few_figures):
    """Run a program with words in an empty folder; returns its run folder."""
    monkeypatch.chdir(tmp_path)

    def start(*words, program="train", folder="run"):
        words = (*words, *[f"hydra.run.dir={folder}"] * bool(folder))
        monkeypatch.setattr(sys, "argv", [f"damian {program}", *words])
        import_module(f"damian.recipes.{program}").main()
        return tmp_path / folder

    return start
