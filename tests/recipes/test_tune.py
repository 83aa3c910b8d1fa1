"""Searches for settings: what they vary, measure and store, and that a kill loses nothing."""

import csv
import sys
from pathlib import Path

import optuna
import pytest
from extensions import TINY
from optuna.trial import TrialState
from stopped_runs import killed_after

from damian.common.errors import InputError, RunError
from damian.recipes import tune
from damian.recipes.tune import read_space

SPACE = ["search.learner.lr={low: 1e-4, high: 1e-2, log: true}", "search.model.hidden.choices=[[8],[8,8]]"]
SPACE += [f"~search.learner.{name}" for name in ("entropy_coeff", "gamma", "lmbda", "epochs", "minibatches")]


@pytest.fixture
def search(tmp_path, monkeypatch):
    """Search in an empty folder; returns the run folder."""
    monkeypatch.chdir(tmp_path)

    def run(*words, space=SPACE, folder="found"):
        monkeypatch.setattr(sys, "argv", ["damian tune", *TINY, *space, *words, f"hydra.run.dir={folder}"])
        tune.main()
        return tmp_path / folder

    return run


def rows(path):
    with path.open(newline="") as file:
        return [*csv.DictReader(file)]


def trials_in(folder):
    storage = f"sqlite:///{folder / 'search.db'}"
    return optuna.load_study(study_name="damian", storage=storage).get_trials()


def test_a_search_stores_what_its_trainings_measure_and_continues(search, capsys):
    folder = search("trials=2")
    printed = capsys.readouterr().out
    found = rows(folder / "trials.csv")
    assert [row["state"] for row in found] == ["complete", "complete"]
    assert found[0]["learner.lr"] != found[1]["learner.lr"]
    for row, trial in zip(found, trials_in(folder), strict=True):
        results = {each["policy"]: each for each in rows(folder / f"trial_{row['trial']}" / "result.csv")}
        assert trial.value == pytest.approx(float(results["trained"]["return"]))
        assert float(row["return"]) == pytest.approx(trial.value, rel=1e-3)
        assert float(row["learner.lr"]) == pytest.approx(trial.params["learner.lr"], rel=1e-5)
        text = (folder / f"trial_{row['trial']}" / "run.json").read_text()
        assert f"learner.lr={row['learner.lr']}" in text
        assert f"model.hidden={row['model.hidden']}" in text
    best = max(found, key=lambda row: float(row["return"]))
    assert f"learner.lr={best['learner.lr']}" in printed.split("The best:")[1]
    written = (folder / "trial_0" / "metrics.csv").stat().st_mtime_ns
    assert [row["trial"] for row in rows(search("trials=3") / "trials.csv")] == ["0", "1", "2"]
    assert len({trial.params["learner.lr"] for trial in trials_in(folder)}) == 3
    assert (folder / "trial_0" / "metrics.csv").stat().st_mtime_ns == written


@pytest.mark.slow
def test_a_killed_search_goes_on_with_the_trial_that_it_was_training(search):
    folder = search("trials=1")
    with killed_after(1):
        search("trials=3")
    first, killed = trials_in(folder)
    assert (first.state, killed.state) == (TrialState.COMPLETE, TrialState.RUNNING)
    search("trials=3")
    trials = trials_in(folder)
    states = [TrialState.COMPLETE, TrialState.FAIL, TrialState.COMPLETE, TrialState.COMPLETE]
    assert [trial.state for trial in trials] == states
    assert trials[2].params == killed.params
    assert trials[2].user_attrs["folder"] == "trial_1"
    assert [row["frames"] for row in rows(folder / "trial_1" / "metrics.csv")] == ["64.0", "128.0"]


@pytest.mark.slow
def test_settings_that_are_refused_and_trainings_that_fail_are_told_and_the_search_goes_on(
    search, capsys, monkeypatch
):
    def diverge(*_):
        raise RunError("the learner has diverged")

    monkeypatch.setattr(tune, "train", diverge)
    for n_trials, lr, why in ((1, 1e20, "is not between"), (2, 1e-3, "the learner has diverged")):
        space = ["~search", f"+search={{learner: {{lr: {{choices: [{lr}]}}}}}}"]
        with pytest.raises(SystemExit):
            search(f"trials={n_trials}", space=space, folder=why)
        printed = capsys.readouterr().err
        assert printed.count("failed: ") == n_trials
        assert why in printed
        assert "has a value: see the log.txt of each" in printed
        assert {trial.state for trial in trials_in(Path(why))} == {TrialState.FAIL}


@pytest.mark.parametrize(
    ("search", "message"),
    [
        ({}, "search: it is empty"),
        ({"learner": {"lr": {"low": 2, "high": 1}}}, r"search.learner.lr: .*: `low <= high` must hold"),
        ({"learner": {"lr": 3}}, "search.learner.lr: 3 is neither"),
    ],
)
def test_a_space_that_cannot_be_searched_is_refused(search, message):
    with pytest.raises(InputError, match=message):
        read_space(search)
