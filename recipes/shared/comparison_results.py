"""Results of a comparison: the rows of all evaluations and the learning curves, which are also two CSV files.

The files are enough for all tables and figures, without the folders of the runs.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import numpy as np

from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError
from damian.common.tables import csv_table
from damian.compare.comparison import OF_ARM, Arm, Row, regime
from damian.compare.figures import LABELS
from damian.runs.metrics_log import read_metrics
from damian.runs.run_folder import RESULTS
from damian.runs.run_record import read_record

from ..cli import reason
from .many_runs import Run, read_rows

ROWS, CURVES = "results.csv", "curves.csv"
MARKDOWN, FIGURE = "table.md", "figure.png"
"""What follows from the rows, also of a sweep."""
POINTS = 50
"""Largest number of points of a stored learning curve, evenly spaced over its updates."""


@dataclass(frozen=True)
class Results:
    """Results of the finished runs of a comparison."""

    rows: Sequence[Row]
    """Evaluations, see ``damian.compare.comparison.Row``."""
    points: Sequence[Row]
    """Points of the learning curves: task, delay, arm, seed, frames, episodes, and ``LABELS``."""

    @property
    def curves(self) -> dict[tuple[str, str, str], list[list[Row]]]:
        """Points by task, delay and arm, a list for each seed."""
        found: dict[tuple[str, str, str], dict[int, list[Row]]] = {}
        for point in self.points:
            seeds = found.setdefault((point["task"], point["delay"], point["arm"]), {})
            seeds.setdefault(point["seed"], []).append(point)
        return {name: list(seeds.values()) for name, seeds in found.items()}

    def with_those_of(self, new: "Results") -> "Results":
        """Both results; where both have a run, the new ones."""

        def run(row: Row) -> tuple[str, ...]:
            return tuple(str(row[name]) for name in ("task", "delay", "arm", "seed"))

        again = {*map(run, new.rows)}
        pairs = ((self.rows, new.rows), (self.points, new.points))
        return Results(*([*(row for row in old if run(row) not in again), *added] for old, added in pairs))

    def only(self, included: Callable[[Row], bool]) -> "Results":
        """Those of the rows that are included."""
        return Results(*([*filter(included, rows)] for rows in (self.rows, self.points)))

    def write(self, folder: Path) -> None:
        """Write both files."""
        write_csv(folder / ROWS, self.rows)
        write_csv(folder / CURVES, self.points)


def results_of(runs: Sequence[Run], arms: Mapping[str, Arm]) -> Results:
    """The results of finished runs."""
    rows, points = [], []
    for run in runs:
        succeeds = run.config.episode.success_share is not None
        label = {"task": run.task, "delay": run.delay, "arm": run.arm, "seed": run.config.seed}
        metrics = read_metrics(run.folder) if run.trains else []
        unknown = {} if succeeds else {"perceived_success_rate": math.nan}
        spread = np.linspace(0, len(metrics) - 1, min(len(metrics), POINTS)).round().astype(int)
        for row in [metrics[index] for index in spread]:
            numbers = {name: float(f"{row[name]:.5g}") for name in ("frames", "episodes", *LABELS)}
            points.append(label | numbers | unknown)
        shares = [row["backupdated"] for row in metrics if "backupdated" in row]
        of_run = {
            "regime": regime(arms, run.arm),
            "frames": metrics[-1]["frames"] if metrics else 0,
            "seconds": read_record(run.folder).get("wall_time_s", math.nan),
        }
        for row in read_rows(run.folder / RESULTS):
            learns = shares and row["policy"] in OF_ARM[:2]
            learnt = {"backupdated": fmean(shares) if learns else math.nan}
            without = {} if succeeds else {name: math.nan for name in row if name.endswith("success_rate")}
            rows.append(label | of_run | learnt | row | without)
    return Results(rows, points)


def stored_results(folder: Path) -> Results:
    """Read the results that a folder stores, but no curves of a version that drew perceived returns."""
    rows, points = (_read(folder / name) for name in (ROWS, CURVES))
    return Results(rows, [point for point in points if "hindsight_return" in point])


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows, which all have the same columns; without a row the file is empty."""
    names = list(rows[0]) if rows else []
    write_atomically(path, csv_table([names, *([row[name] for name in names] for row in rows)]))


def _read(path: Path) -> Sequence[Row]:
    try:
        return read_rows(path)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: it does not hold the results of a comparison ({reason(error)})") from error
