"""The leaderboard of delaybench: checks of a submission, and the tables of all submissions."""

from collections.abc import Collection, Sequence

import numpy as np
import pandas as pd

from damian.common import checks
from damian.common.tables import markdown_table
from damian.compare.comparison import (
    HELD_OUT_MARK,
    LATE_DATA,
    RUN,
    SIMULATOR,
    means_over_seeds,
    shown,
)
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


def leaderboard(submissions: Sequence[pd.DataFrame], delays: Collection[str]) -> str:
    """Tables of all submissions, as Markdown: for each track and task, and of flights elsewhere."""
    rows = pd.concat(submissions, ignore_index=True)
    away = rows["task"].str.contains(HELD_OUT_MARK, regex=False)
    parts = []
    for regime in (LATE_DATA, SIMULATOR):
        for task in rows.loc[~away & (rows["regime"] == regime), "task"].unique():
            of_task = rows[~away & (rows["regime"] == regime) & (rows["task"] == task)]
            parts += [f"## {task}, {regime}", _methods(of_task, [*delays])]
    for method in rows.loc[away, "method"].unique():
        flights = _flights(rows[away & (rows["method"] == method)])
        parts += [f"## {method}, flown where it was not trained", flights]
    return "\n\n".join(parts) + "\n"


def _methods(rows: pd.DataFrame, delays: Sequence[str]) -> str:
    """A line for each method, the best one under the first delay first, with a column for each
    delay."""
    present = [delay for delay in delays if (rows["delay"] == delay).any()]
    means = rows.pivot_table(values="return", index="method", columns="delay")
    lines = []
    for method in means.sort_values(present, ascending=False).index:
        runs = rows[rows["method"] == method]
        cells = [_mean(runs[runs["delay"] == delay]) for delay in present]
        one = runs.iloc[0]
        steps = f"{runs['frames'].max() / 1e6:.2g}"
        size = f"{int(one['parameters']):,}"
        version = f"{one['damian']} ({str(one['commit'])[:7]})".removesuffix(" (several)")
        lines.append((method, *cells, one["authors"], steps, size, version))
    return markdown_table(
        ["method", *present, "authors", "million steps", "parameters", "damian"], lines
    )


def _flights(rows: pd.DataFrame) -> str:
    """A line for each held-out task, with a column for each delay of the training."""
    trained = [*rows["delay"].unique()]
    lines = []
    for task, runs in rows.groupby("task", sort=False):
        lines.append((task, *(_mean(runs[runs["delay"] == delay]) for delay in trained)))
    return markdown_table(["flown in", *(f"trained under {delay}" for delay in trained)], lines)


def _mean(runs: pd.DataFrame) -> str:
    """Mean return with its interval and the number of seeds."""
    if runs.empty:
        return "-"
    return f"{shown(means_over_seeds(runs[['return']]), 'return')} ({len(runs)})"
