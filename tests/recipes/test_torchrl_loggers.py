"""Trainings whose numbers go to Weights & Biases, without a network, and to MLflow."""

import pytest
from extensions import TINY

from damian.runs.metrics_log import read_metrics

pytestmark = pytest.mark.slow
mlflow = pytest.importorskip("mlflow")
pytest.importorskip("wandb")


def test_weights_and_biases_keeps_an_offline_run_that_a_resumed_one_continues(run, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    folder = run(*TINY, "logger=wandb", folder="first")
    (kept,) = (folder / "wandb").glob("offline-run-*/*.wandb")
    written = kept.read_bytes()
    assert all(word in written for word in (b"perceived_return", b"delay.obs", b"histogram"))
    number = (folder / "wandb_id.txt").read_text()
    assert number in kept.name
    run(f"resume={folder}", "frames=384", folder="second")
    assert all(number in each.name for each in (folder / "wandb").glob("offline-run-*/*.wandb"))


@pytest.mark.filterwarnings(
    "ignore:.*:sqlalchemy.exc.SADeprecationWarning", "ignore:::mlflow", "ignore:::alembic"
)
def test_mlflow_gets_every_number_and_setting(run, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    folder = run(*TINY, "logger=mlflow", folder="first")
    client = mlflow.MlflowClient("sqlite:///mlflow.db")
    (found,) = client.search_runs([client.get_experiment_by_name("damian").experiment_id])
    assert found.info.run_name == "first"
    assert found.data.params["learner.name"] == "mappo"
    for row in read_metrics(folder):
        values = {
            each.step: each.value for each in client.get_metric_history(found.info.run_id, "loss_critic")
        }
        assert values[row["frames"]] == row["loss_critic"]
