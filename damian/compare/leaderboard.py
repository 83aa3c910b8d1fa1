"""The leaderboard of delaybench: checks of a submission."""

import numpy as np
import pandas as pd

from damian.common import checks
from damian.compare.comparison import HELD_OUT_MARK, LATE_DATA, RUN, SIMULATOR
from damian.compare.config import EPISODES, Experiment

NUMBERS = ["frames", "episodes", "return"]
WORDS = ["task", "delay", "method", "authors", "regime", "damian", "commit", "settings"]
COLUMNS = [*RUN, *NUMBERS, "parameters", *WORDS[3:]]
"""Columns of a submission, which has a row for each run; ``settings`` are those of ``damian
train``."""
FEWEST_SEEDS = 5


def check_submission(rows: pd.DataFrame, experiment: Experiment, path: str) -> None:
    """Check a submission: its columns, places, seeds, episodes, numbers and words.

    Raises:
        InputError: the first thing that is wrong, and what would be right.
    """
    missing = [name for name in COLUMNS if name not in rows]
    checks.require(not missing, path, missing, f"are missing; the columns are {', '.join(COLUMNS)}")
    checks.require(len(rows) > 0, path, "it", "has no rows")
    places = [*experiment.tasks]
    places += [
        f"{task}{HELD_OUT_MARK}{name}" for task in experiment.tasks for name in experiment.held_out
    ]
    for task in rows["task"].unique():
        remedy = f'train in one that is, by experiment=delaybench "tasks=[{places[0]}]"'
        should = f"is not of the leaderboard: {remedy}"
        checks.require(task in places, f"{path}: task", task, should)
    for name, known in (("delay", experiment.delays), ("regime", (LATE_DATA, SIMULATOR))):
        for value in rows[name].unique():
            checks.one_of(f"{path}: {name}", value, [*known])
    for name in ("method", "regime", "damian"):
        values = [*rows[name].unique()]
        checks.require(len(values) == 1, f"{path}: {name}", values, "is not one for all rows")
    for name in WORDS:
        empty = rows[name].astype(str).str.strip().isin(["", "nan", "None"])
        checks.require(not empty.any(), f"{path}: {name}", "it", "is empty")
    changed = rows["commit"].astype(str).str.contains("+", regex=False)
    checks.require(
        not changed.any(), f"{path}: commit", rows["commit"].iloc[0], "has changes: commit them"
    )
    finite = np.isfinite(rows[[*NUMBERS, "parameters"]].to_numpy(float)).all()
    checks.require(bool(finite), path, "a number", "is not finite")
    for place, runs in rows.groupby(RUN[:-1], sort=False):
        where = f"{path}: {'/'.join(map(str, place))}"
        seeds = runs["seed"]
        checks.require(
            not seeds.duplicated().any(), f"{where}: seed", [*seeds], "are not all different"
        )
        enough = len(seeds) >= FEWEST_SEEDS and seeds.min() >= experiment.first_seed
        few = f"are too few, or too small: run compare again with keep=true seeds={FEWEST_SEEDS}"
        checks.require(
            bool(enough), f"{where}: seed", [*seeds], f"{few}, from {experiment.first_seed} on"
        )
        checks.in_range(f"{where}: episodes", int(runs["episodes"].min()), EPISODES)
