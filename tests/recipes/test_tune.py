"""Searches for settings: what they vary, measure and store, and that a kill loses nothing."""

import csv
import sys
from pathlib import Path

import optuna
import pytest
from extensions import TINY
from helpers import check_refused
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import TrialState
from stopped_runs import killed_after

from damian.common.errors import InputError, RunError
from damian.recipes import tune
from damian.recipes.known import CONF
from damian.recipes.tune import read_space

SPACE = ["search.learner.lr={low: 1e-4, high: 1e-2, log: true}", "search.model.hidden.choices=[[8],[8,8]]"]
SPACE += [f"~search.learner.{name}" for name in ("entropy_coeff", "gamma", "lmbda", "epochs", "minibatches")]


@pytest.fixture
def search(tmp_path, monkeypatch):
    """Search in an empty folder; returns the run folder."""
    monkeypatch.chdir(tmp_path)

    def run(*words, space=SPACE, folder="found"):
        monkeypatch.setattr(sys, "argv", ["damian tune", *TINY, *space, *words, f"hydra.run.dir={folder}"])
        tune.run()
        return tmp_path / folder

    return run


def rows(path):
    with path.open(newline="") as file:
        return [*csv.DictReader(file)]


def trials_in(folder):
    storage = f"sqlite:///{folder / 'search.db'}"
    return optuna.load_study(study_name="damian", storage=storage).get_trials()


def test_a_search_that_is_continued_draws_new_trials(search):
    for trials in (1, 2, 3):
        folder = search(f"trials={trials}")
    assert len({trial.params["learner.lr"] for trial in trials_in(folder)}) == 3


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
    figures = {"history.png", "slices.png", "importances.png"}
    assert figures <= {path.name for path in folder.iterdir()}
    written = (folder / "trial_0" / "metrics.csv").stat().st_mtime_ns
    assert [row["trial"] for row in rows(search("trials=3") / "trials.csv")] == ["0", "1", "2"]
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
def test_several_processes_share_a_search(search):
    assert len(rows(search("trials=3", "processes=2") / "trials.csv")) == 3


@pytest.mark.slow
def test_a_trial_that_is_worse_than_others_is_pruned(search, monkeypatch):
    hopeless = optuna.pruners.ThresholdPruner(lower=1e9)
    monkeypatch.setattr(tune.optuna.pruners, "MedianPruner", lambda *_, **__: hopeless)
    monkeypatch.setattr(tune, "report", lambda _: None)
    folder = search("trials=2", "episode.max_steps=4")
    assert [trial.state for trial in trials_in(folder)] == [TrialState.PRUNED, TrialState.PRUNED]
    assert not (folder / "trial_0" / "result.csv").exists()
    folder = search("trials=3", "episode.max_steps=4", "prune=false")
    assert trials_in(folder)[2].state == TrialState.COMPLETE


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
        ({"learner": {"lrr": {"low": 1, "high": 2}}}, "learner.lr"),
        ({"learner": {"lr": {"low": 2, "high": 1}}}, r"search.learner.lr: `low <= high` must hold"),
        ({"learner": {"lr": {"low": 0.0, "high": 1, "log": True}}}, "`low > 0` must hold"),
        ({"learner": {"lr": {"low": 1, "high": 2, "choices": [1]}}}, "is neither"),
        ({"learner": {"lr": 3}}, "search.learner.lr: 3 is neither"),
        ({"delay": {"history": {"low": 1, "high": 9, "step": -1}}}, "history: `step > 0` must hold"),
        ({"learner": {"lr": {"low": 0.1, "high": 1, "log": "maybe"}}}, "lr.log: maybe is not true or false"),
    ],
)
def test_a_space_that_cannot_be_searched_is_refused(search, message):
    with pytest.raises(InputError, match=message):
        read_space(search)


def test_ranges_and_choices_are_those_of_optuna():
    space = read_space(
        {
            "learner": {"lr": {"low": 1e-4, "high": 1e-2, "log": True}, "gamma": {"low": 0, "high": 0.5}},
            "model": {"hidden": {"choices": [[8], [8, 8]]}},
            "delay": {"history": {"low": 1, "high": 9, "step": 2}},
        }
    )
    assert space == {
        "learner.lr": FloatDistribution(1e-4, 1e-2, log=True),
        "learner.gamma": FloatDistribution(0, 0.5),
        "model.hidden": CategoricalDistribution(["[8]", "[8,8]"]),
        "delay.history": IntDistribution(1, 9, step=2),
    }


def test_every_learner_has_a_space(capsys):
    names = {path.stem for path in Path(CONF, "learner").glob("*.yaml")}
    assert {path.stem for path in Path(CONF, "search").glob("*.yaml")} == names


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["resume=x"], "resume: x is not for a search"),
        (["trials=0"], "trials: 0"),
        (["checkpoint=first"], "checkpoint: first is not for a search, which trains every policy from"),
        (
            ["score=perceived_success_rate", "scenario=coverage"],
            "score: perceived_success_rate is the same for every policy",
        ),
        (["policy=greedy"], "policy: greedy is not one of sampled, deterministic"),
        (["+search.learner.lrr.low=1", "+search.learner.lrr.high=2"], "search: "),
        (["-m", "seed=0,1"], "-m: "),
    ],
)
def test_what_a_user_can_get_wrong_is_refused_in_one_line(search, words, message, capsys):
    check_refused(lambda: search(*words), message, capsys)


def test_a_storage_that_is_damaged_is_refused_in_one_line(search, tmp_path, capsys):
    (tmp_path / "found").mkdir()
    (tmp_path / "found" / "search.db").write_bytes(b"SQLite format 3\0 and then nonsense" * 100)
    check_refused(lambda: search("trials=1"), "search.db: it does not hold a search", capsys)
