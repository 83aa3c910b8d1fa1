"""Search for better settings of a learner with Optuna; the same command continues a search.

damian tune scenario=delaybench/tracking delay=paper aware=belief trials=30 processes=2
damian tune aware=both "search.learner.gamma.choices=[0.9,0.99]" "+search.delay.history={low: 1, high: 8}"

All trials have the same seed: what they find must be shown with other seeds (damian compare).
"""

__package__ = "damian.recipes"  # also of a script: python recipes/tune.py

import json
import shlex
import sys
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import hydra
import pandas as pd
from omegaconf import DictConfig
from tqdm import tqdm

from damian.common import checks
from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError, RunError
from damian.common.tables import markdown_table, write_csv
from damian.runs.interrupt import end_interrupted, number_of
from damian.runs.processes import each_in_processes

from . import cli
from .compare import POLICIES
from .config import TrainConfig, TuneConfig
from .known import is_known, key_of, no_such_key
from .shared.many_runs import Run, perform_run
from .shared.runs import start
from .shared.settings import check_learning
from .train import train

try:
    import optuna
    from optuna import distributions
    from optuna.trial import Trial, TrialState
except ImportError as error:
    raise InputError("damian tune: optuna is not installed; pip install optuna") from error

NAME = "damian"
"""Of the search in Optuna's storage."""
FOLDER, CHOSEN, OVERRIDES = "folder", "chosen", "overrides"
"""What is stored with a trial: its folder, and the settings that it varies; with a search: its overrides."""
SHOWN = 10
"""Trials in the table."""
OWN = {each.name for each in fields(TuneConfig)} - {each.name for each in fields(TrainConfig)}
"""Settings that a training does not have."""


def read_space(search: Mapping[str, Any], path: str = "") -> dict[str, distributions.BaseDistribution]:
    """The values of each setting that a search varies, by its dotted key."""
    space = {}
    for name, written in search.items():
        key = f"{path}{name}"
        should = "is neither {low: ..., high: ...}, with log or step, nor {choices: [...]}"
        checks.require(isinstance(written, Mapping), f"search.{key}", written, should)
        if not {*written} & {"low", "high", "choices"}:
            space |= read_space(written, f"{key}.")
        elif not is_known(key, "train"):
            raise InputError(f"search: {no_such_key(key, 'train')}")
        else:
            try:
                space[key] = _distribution(**written)
            except (TypeError, ValueError) as error:
                raise InputError(f"search.{key}: {written} {should}: {cli.reason(error)}") from error
    if not space and not path:
        raise InputError("search: it is empty: name a setting, such as search.learner.lr")
    return space


def _distribution(choices: Any = None, **values: Any) -> distributions.BaseDistribution:
    """The values of a setting, for Optuna; choices are as they are written on a command line."""
    if choices is not None and not values:
        return distributions.CategoricalDistribution(
            [json.dumps(each, separators=(",", ":")) for each in choices]
        )
    whole = all(isinstance(value, int) for value in values.values())
    return (distributions.IntDistribution if whole else distributions.FloatDistribution)(**values)


class Search:
    """A search for settings, whose trials are trainings."""

    def __init__(self, config: TuneConfig, overrides: list[str], folder: Path) -> None:
        self.config, self.overrides, self.folder = config, overrides, folder
        self.space = read_space(config.search)
        self.study = optuna.create_study(
            study_name=NAME,
            storage=f"sqlite:///{(folder / 'search.db').resolve()}",
            direction="maximize" if config.sign > 0 else "minimize",
            load_if_exists=True,
        )
        # A sampler with the same seed would draw the trials again that the study has already.
        self.study.sampler = optuna.samplers.TPESampler(seed=config.seed + len(self.study.trials))
        stored, asked = self.study.user_attrs.get(OVERRIDES), [*overrides, f"search={config.search}"]
        should = f"is not {stored}, with which {folder} was begun; choose another folder with hydra.run.dir"
        checks.require(stored in (None, asked), OVERRIDES, asked, should)
        self.study.set_user_attr(OVERRIDES, asked)
        for trial in self.study.get_trials(states=(TrialState.RUNNING,)):  # when the search was stopped
            self.study.tell(trial.number, state=TrialState.FAIL)
            self.study.enqueue_trial(trial.params, {FOLDER: trial.user_attrs.get(FOLDER)})
        self.trials: dict[Path, Trial] = {}

    @property
    def n_finished(self) -> int:
        """Number of trainings that have ended."""
        return len(self.study.get_trials(states=(TrialState.COMPLETE,)))

    def runs(self) -> Iterator[Run]:
        """The trainings that are still to be done, each asked for when the ones before have been told."""
        for _ in range(self.config.trials - self.n_finished):
            trial = self.study.ask(self.space)
            folder = Path(trial.user_attrs.get(FOLDER) or f"trial_{trial.number}").name
            trial.set_user_attr(FOLDER, folder)
            written = {key: trial.params[key] for key in self.space}
            chosen = {k: f"{x:.6g}" if isinstance(x, float) else str(x) for k, x in written.items()}
            trial.set_user_attr(CHOSEN, chosen)
            words = ["logger=csv", *self.words(chosen)]
            try:
                config = cli.settings(*words)
            except InputError as error:
                print(f"failed: {folder}: {error}", file=sys.stderr)
                self.study.tell(trial, state=TrialState.FAIL)
                continue
            config.overrides = words
            run = Run("tune", "", "", config, self.folder / folder, train)
            self.trials[run.folder] = trial
            yield run

    def words(self, chosen: Mapping[str, str]) -> list[str]:
        """The overrides of a trial that has chosen these settings."""
        others = [word for word in self.overrides if key_of(word) not in chosen]
        return [*others, *(f"{key}={value}" for key, value in chosen.items())]

    def tell(self, run: Run, error: BaseException | None) -> float | None:
        """Store the end of a trial; returns its value, or None if it failed."""
        trial = self.trials.pop(run.folder)
        if error is not None or not run.finished:
            self.study.tell(trial, state=TrialState.FAIL)
            return None
        value = run.score(POLICIES[self.config.policy], self.config.score)
        self.study.tell(trial, value)
        return value


def report(found: Search) -> None:
    """Write the table, and print how to train with the best settings."""
    trials = found.study.get_trials(states=(TrialState.COMPLETE, TrialState.FAIL))
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    if not complete:
        raise RunError(f"no trial of {found.folder} has a value: see the log.txt of each")
    complete.sort(key=lambda trial: -found.config.sign * (trial.value or 0.0))

    def row(trial: optuna.trial.FrozenTrial) -> list[str]:
        value = "" if trial.state != TrialState.COMPLETE else f"{trial.value:.4g}"
        return [str(trial.number), trial.state.name.lower(), value, *trial.user_attrs[CHOSEN].values()]

    head = ["trial", "state", found.config.score, *found.space]
    write_csv(found.folder / "trials.csv", pd.DataFrame([*map(row, trials)], columns=head))
    lines = [
        f"`{cli.command()}`",
        f"{len(trials)} trials: {len(complete)} with a value, the others failed. All have the seed "
        f"{found.config.seed}, and the value of the best is flattered by having been chosen.",
        markdown_table(head, [row(trial) for trial in complete[:SHOWN]]),
        f"The best: `damian train {shlex.join(found.words(complete[0].user_attrs[CHOSEN]))}`",
    ]
    text = "\n\n".join(lines) + "\n"
    write_atomically(found.folder / "table.md", text)
    print(text)


def search_all(config: TuneConfig, folder: Path) -> None:
    """Search for settings until there are as many trials as were asked for, and report on all of them."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    check_learning(config)
    overrides = [word for word in config.overrides if key_of(word).split(".")[0] not in OWN]
    found = Search(config, overrides, folder)
    done = found.n_finished
    try:
        with tqdm(total=config.trials, initial=done, unit=" trials", disable=done >= config.trials) as bar:
            for run, error in each_in_processes(perform_run, found.runs(), config.processes):
                value = found.tell(run, error)
                bar.set_postfix({config.score: "-" if value is None else f"{value:.3g}"})
                bar.update()
                if error is not None:
                    print(f"failed: {run.folder}: {cli.reason(error)}", file=sys.stderr)
    except KeyboardInterrupt as error:
        end_interrupted(number_of(error), "run the same command again to continue")
    report(found)
    print(f"results: {folder}")


@cli.one_line_errors("tune")
@hydra.main(config_path="../conf", config_name="tune", version_base=None)
def main(given: DictConfig) -> None:
    start(search_all, given, "tune", again=True)


if __name__ == "__main__":
    main()
