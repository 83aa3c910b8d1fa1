"""Trainings whose numbers go to Weights & Biases, without a network."""

import pytest
from extensions import TINY

pytestmark = pytest.mark.slow
pytest.importorskip("wandb")


def test_weights_and_biases_keeps_an_offline_run_that_a_resumed_one_continues(run, monkeypatch):
    monkeypatch.setenv("WANDB_SILENT", "true")
    folder = run(
        *TINY, "logger.custom=[{logger: wandb, project: mine, offline: true}]", folder="first"
    )
    (kept,) = (folder / "wandb").glob("offline-run-*/*.wandb")
    written = kept.read_bytes()
    assert all(word in written for word in (b"perceived_return", b"delay.obs", b"mine"))
    number = kept.stem.removeprefix("run-")
    run(f"resume={folder}", "frames=384", folder="second")
    assert all(number in each.name for each in (folder / "wandb").glob("offline-run-*/*.wandb"))
