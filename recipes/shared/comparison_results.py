"""Results of a comparison: the rows of all evaluations and the learning curves, which are also two CSV files.

The files are enough for all tables and figures, without the folders of the runs.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np
import pandas as pd

from damian.common.tables import write_csv
from damian.compare.comparison import OF_ARM, RUN, Arm, regime
from damian.compare.figures import LABELS
from damian.runs.metrics_log import read_metrics
from damian.runs.run_folder import RESULTS, read_results
from damian.runs.run_record import read_record

from .many_runs import Run

ROWS, POINTS = "results.csv", "curves.csv"
MARKDOWN, FIGURE = "table.md", "figure.png"
"""What follows from the rows, also of a sweep."""
MOST_POINTS = 50
"""Largest number of points of a stored learning curve, evenly spaced over its updates."""
CURVE = [*RUN, "frames", "episodes", *LABELS]
"""Columns of the points of learning curves."""


class Results(NamedTuple):
    """Results of the finished runs of a comparison, as ``Comparison`` reads them."""

    rows: pd.DataFrame
    points: pd.DataFrame

    def with_those_of(self, new: "Results") -> "Results":
        """Both results; where both have a run, the new ones."""
        again = pd.MultiIndex.from_frame(new.rows[RUN])
        kept = (old[~pd.MultiIndex.from_frame(old[RUN]).isin(again)] for old in self)
        return Results(*map(_joined, zip(kept, new, strict=True)))

    def only(self, included: Callable[[pd.DataFrame], "pd.Series[bool]"]) -> "Results":
        """Those of the rows that are included."""
        return Results(*(rows[included(rows)] for rows in self))

    def write(self, folder: Path) -> None:
        """Write both files."""
        for name, rows in zip((ROWS, POINTS), self, strict=True):
            write_csv(folder / name, rows)


NO_RESULTS = Results(pd.DataFrame(columns=RUN), pd.DataFrame(columns=CURVE))


def results_of(runs: Sequence[Run], arms: Mapping[str, Arm]) -> Results:
    """The results of finished runs."""
    found = [NO_RESULTS, *(_of_run(run, arms) for run in runs)]
    return Results(*map(_joined, zip(*found, strict=True)))


def _joined(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Tables below each other; those without rows tell pandas nothing about the columns."""
    return pd.concat([table for table in tables if len(table)] or [tables[0]], ignore_index=True)


def _of_run(run: Run, arms: Mapping[str, Arm]) -> Results:
    label = {"task": run.task, "delay": run.delay, "arm": run.arm, "seed": run.config.seed}
    rows, metrics = read_results(run.folder / RESULTS), read_metrics(run.folder)
    of_run = {
        "regime": regime(arms, run.arm),
        "frames": metrics["frames"].max() if len(metrics) else 0.0,
        "seconds": read_record(run.folder).get("wall_time_s", math.nan),
        "backupdated": fmean(metrics["backupdated"]) if "backupdated" in metrics else math.nan,
    }
    names = [*rows.columns]
    rows = rows.assign(**label, **of_run)[[*label, *of_run, *names]]
    rows.loc[~rows["policy"].isin(OF_ARM[:2]), "backupdated"] = math.nan
    spread = np.linspace(0, len(metrics) - 1, min(len(metrics), MOST_POINTS)).round().astype(int)
    points = metrics.iloc[spread].reindex(columns=CURVE[len(RUN) :])
    points = points.map(lambda number: float(f"{number:.5g}")).assign(**label)[CURVE]
    if (
        run.config.episode.success_share is None
    ):  # where nothing can succeed, a share of successes means nothing
        for table in (rows, points):
            table[table.filter(like="success_rate").columns] = math.nan
    return Results(rows, points)


def stored_results(folder: Path) -> Results:
    """Read the results that a folder stores, but no curves of a version that drew perceived returns."""
    rows, points = (read_results(folder / name) for name in (ROWS, POINTS))
    return Results(rows, points if LABELS.keys() <= {*points} else NO_RESULTS.points)
