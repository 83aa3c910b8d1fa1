"""Results of a comparison: the rows of all evaluations and the learning curves, which are also two CSV files.

The files are enough for all tables and figures, without the folders of the runs.
"""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from damian.common.atomic_files import write_atomically
from damian.common.csv_table import csv_table
from damian.common.errors import InputError
from damian.compare.comparison import OF_ARM, Arm, Row, regime
from damian.compare.figures import LABELS
from damian.runs.metrics_log import read_metrics
from damian.runs.run_record import read_record

from ..cli import reason
from .many_runs import Run

ROWS, CURVES = "results.csv", "curves.csv"
WORDS = ("task", "delay", "arm", "regime", "policy")
"""Columns that are not numbers."""
POINTS = 50
"""Largest number of points of a stored learning curve."""


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
        points += [label | _point(row, succeeds) for row in _thinned(metrics)]
        of_run = {
            "regime": regime(arms, run.arm),
            "frames": metrics[-1]["frames"] if metrics else 0,
            "seconds": read_record(run.folder).get("wall_time_s", math.nan),
        }
        for row in run.results():
            learnt = {"backupdated": _share_backupdated(metrics) if row["policy"] in OF_ARM[:2] else math.nan}
            without = {} if succeeds else {name: math.nan for name in row if name.endswith("success_rate")}
            rows.append(label | of_run | learnt | row | without)
    return Results(rows, points)


def stored_results(folder: Path, included: Callable[[Row], bool]) -> Results:
    """Read the results that a folder stores; ``included`` says which rows."""
    return Results(*([*filter(included, _read(folder / name))] for name in (ROWS, CURVES)))


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows, which all have the same columns; without a row the file is empty."""
    names = list(rows[0]) if rows else []
    write_atomically(path, csv_table([names, *([row[name] for name in names] for row in rows)]))


def _read(path: Path) -> list[Row]:
    try:
        with path.open(newline="") as file:
            return [{name: _value(name, text) for name, text in row.items()} for row in csv.DictReader(file)]
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: it does not hold the results of a comparison ({reason(error)})") from error


def _value(name: str, text: str) -> Any:
    if name in WORDS:
        return text
    return int(text) if name == "seed" else float(text)


def _point(row: Mapping[str, float], succeeds: bool) -> dict[str, float]:
    numbers = {name: float(f"{row[name]:.5g}") for name in ("frames", "episodes", *LABELS)}
    return numbers if succeeds else numbers | {"perceived_success_rate": math.nan}


def _thinned(rows: Sequence[Mapping[str, float]]) -> list[Mapping[str, float]]:
    """At most ``POINTS`` rows, evenly spaced, with the first and the last one."""
    if len(rows) <= POINTS:
        return list(rows)
    return [rows[round(index * (len(rows) - 1) / (POINTS - 1))] for index in range(POINTS)]


def _share_backupdated(rows: Sequence[Mapping[str, float]]) -> float:
    """Share of the messages in training that late ones have replaced; nan without back-updating."""
    shares = [row["backupdated"] for row in rows if "backupdated" in row]
    return fmean(shares) if shares else math.nan
