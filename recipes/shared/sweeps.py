"""Many runs, of a sweep or of a comparison: several at a time, and the tables of what they have
found.

The rows of all evaluations of a comparison and its learning curves are two CSV files, which are
enough for all its tables and figures, without the folders of the runs.
"""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from tqdm import tqdm

from damian.common import checks
from damian.common.atomic_files import make_folder, not_linked, write_atomically
from damian.common.errors import InputError
from damian.common.tables import markdown_table, write_csv
from damian.common.text_files import read_text
from damian.compare.comparison import OF_METHOD, RUN, Method, regime
from damian.compare.figures import LABELS
from damian.compare.paired import as_table, means
from damian.runs.metrics_log import read_metrics
from damian.runs.processes import each_in_processes
from damian.runs.run_folder import FAILED, RESULTS, check_no_links, read_results
from damian.runs.run_record import read_record

from ..cli import one_line_errors, short
from ..known import key_of
from .runs import JOB, OVERRIDES, SEED, Run, errors_kept_in

LOG = "log.txt"
"""Output of a run of a comparison."""
ROWS = "results.csv"
POINTS = "curves.csv"
MARKDOWN = "table.md"
"""What follows from the rows."""


def perform_all(runs: Sequence[Run], processes: int) -> list[Run]:
    """Carry out the runs that are not finished, stage after stage; returns those that failed."""
    todo = [run for run in runs if not run.finished]
    with tqdm(
        total=len(runs), initial=len(runs) - len(todo), unit=" runs", disable=not todo
    ) as bar:
        for stage in sorted({run.stage for run in todo}):
            of_stage = [run for run in todo if run.stage == stage]
            for _ in each_in_processes(_carry_out, of_stage, processes):
                bar.update()
    return [run for run in todo if (run.folder / FAILED).exists()]


def _carry_out(run: Run) -> None:
    """Carry out a run, with its output in its log."""
    make_folder(run.folder, below=run.folder.parents[3])
    with (
        not_linked(run.folder / LOG).open("a", encoding="utf-8", buffering=1) as log,
        redirect_stdout(log),
        redirect_stderr(log),
        errors_kept_in(run.folder, run.config.overrides),
    ):
        try:
            run.carry_out()
        except SystemExit:  # a signal has stopped the training
            raise KeyboardInterrupt from None
        finally:
            # Torch compiles a function at most eight times in a process. Policies with different
            # observations share one, so that the ninth would be slow without saying so.
            torch.compiler.reset()


def labelled_rows(folder: Path, labels: Mapping[str, Any]) -> pd.DataFrame:
    """A row for each policy of a finished run, which begins with these labels."""
    rows = read_results(folder / RESULTS)
    return rows.assign(**labels)[[*labels, *rows.columns]]


class SweepReport(Callback):
    """Reports on a sweep when all of its runs have ended, wherever they were; exit code 1 if one
    failed."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        str(
            config.hydra.sweep.subdir
        )  # the names of the runs' folders need the words of the whole sweep
        with one_line_errors():
            check_no_links(short(Path(config.hydra.sweep.dir)))  # where Hydra writes, too

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        folder = short(Path(config.hydra.sweep.dir))
        with one_line_errors():
            print(f"\nresults of the sweep:\n\n{report(folder)}\n\nresults: {folder}")
        if any(folder.rglob(FAILED)):
            sys.exit(1)


def sweep_rows(folder: Path) -> tuple[list[str], pd.DataFrame]:
    """The settings in which the finished runs in a folder differ, and a row for each policy of each
    run."""
    records = {}
    for file in sorted(folder.rglob(RESULTS)):
        check_no_links(file.parent)
        records[file.parent] = read_record(file.parent)
    if not records:
        raise InputError(f"{folder}: there is no {RESULTS} in it, so no run has finished there")
    runs = sorted(
        records, key=lambda run: records[run].get(JOB, 0)
    )  # as the command line names them
    words = [records[run].get(OVERRIDES, []) for run in runs]
    given = pd.DataFrame([{key_of(x): x.partition("=")[2] for x in each} for each in words]).fillna(
        ""
    )
    given = given[[key for key in given if given[key].nunique() > 1 and key != "seed"]]
    for key in given:
        with suppress(ValueError):  # a setting that is no number
            given[key] = pd.to_numeric(given[key])
    tables = []
    for run, settings in zip(runs, given.to_dict("records"), strict=True):
        labels = {
            **settings,
            "seed": records[run].get(SEED),
            "folder": str(run.relative_to(folder)),
        }
        tables.append(labelled_rows(run, labels))
    return [*given], pd.concat(tables, ignore_index=True)


def report(folder: Path) -> str:
    """Write rows and table of a sweep into its folder; returns the table."""
    failed = [file.parent for file in sorted(folder.rglob(FAILED))]
    for each in (folder, *failed):
        check_no_links(each)
    errors = [
        [str(run.relative_to(folder)), json.loads(read_text(run / FAILED))["error"]]
        for run in failed
    ]
    parts = []
    rows = pd.DataFrame(errors, columns=["folder", "error"])
    if any(folder.rglob(RESULTS)) or not failed:
        groups, finished = sweep_rows(folder)
        parts.append(as_table(means(finished, groups), groups))
        rows = pd.concat([finished, rows], ignore_index=True) if failed else finished
    if failed:
        parts.append(markdown_table(["failed", "why"], errors, left=2))
    write_csv(folder / ROWS, rows)
    write_atomically(folder / MARKDOWN, "\n\n".join(parts) + "\n")
    return "\n\n".join(parts)


def compared(folders: Sequence[Path], score: str) -> str:
    """The table of two folders, of runs or sweeps, with the difference of the second to the
    first."""
    found = [sweep_rows(folder) for folder in folders]
    rows = pd.concat(
        [rows.assign(folder=str(path)) for path, (_, rows) in zip(folders, found, strict=True)]
    )
    shared = [key for key in found[0][0] if key in found[1][0]]
    return as_table(means(rows, ["folder", *shared], score), ["folder", *shared], score)


MOST_POINTS = 50
"""Largest number of points of a stored learning curve, evenly spaced over its updates."""
CURVE = [*RUN, "frames", "episodes", *LABELS]
"""Columns of the points of learning curves."""


class Results(NamedTuple):
    """Results of the finished runs of a comparison, as ``Comparison`` reads them."""

    rows: pd.DataFrame
    points: pd.DataFrame


NO_RESULTS = Results(pd.DataFrame(columns=RUN), pd.DataFrame(columns=CURVE))


def results_of(runs: Sequence[Run], methods: Mapping[str, Method], kept: Results) -> Results:
    """The results of finished runs, and the kept ones of the others."""
    again = pd.MultiIndex.from_frame(pd.DataFrame(map(names_of, runs), columns=RUN))
    others = [old[~pd.MultiIndex.from_frame(old[RUN]).isin(again)] for old in kept]
    new = [_of_run(run, methods) for run in runs]
    return Results(*map(_joined, zip(others, *new, strict=True)))


def _joined(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Tables below each other; those without rows tell pandas nothing about the columns."""
    return pd.concat([table for table in tables if len(table)] or [tables[0]], ignore_index=True)


def names_of(run: Run) -> dict[str, Any]:
    """Task, delay, method and seed of a run of a comparison."""
    return dict(zip(RUN, (*run.folder.parts[-4:-1], run.config.seed), strict=True))


def _of_run(run: Run, methods: Mapping[str, Method]) -> Results:
    names = names_of(run)
    metrics = read_metrics(run.folder)
    of_run = {
        "regime": regime(methods, names["method"]),
        "frames": metrics["frames"].max() if len(metrics) else 0.0,
        "seconds": read_record(run.folder).get("wall_time_s", math.nan),
        "backupdated": fmean(metrics["backupdated"]) if "backupdated" in metrics else math.nan,
    }
    rows = labelled_rows(run.folder, names | of_run)
    rows.loc[~rows["policy"].isin(OF_METHOD[:2]), "backupdated"] = math.nan
    spread = np.linspace(0, len(metrics) - 1, min(len(metrics), MOST_POINTS)).round().astype(int)
    points = metrics.iloc[spread].reindex(columns=CURVE[len(RUN) :])
    points = points.map(lambda number: float(f"{number:.5g}")).assign(**names)[CURVE]
    if not run.config.episode.can_succeed:  # nothing can succeed, and a share of it means nothing
        for table in (rows, points):
            table[table.filter(like="success_rate").columns] = math.nan
    return Results(rows, points)


def stored_results(folder: Path, key: str = "folder") -> Results:
    """Read the results that a folder stores, but no curves of a version that drew perceived
    returns.

    Raises:
        InputError: it is not the folder of a comparison; ``key`` is the setting that names it.
    """
    is_whole = all((folder / name).is_file() for name in (ROWS, POINTS))
    checks.require(
        is_whole,
        key,
        folder,
        f"has no {ROWS} beside {POINTS}: give the folder of damian compare, not one of a run or a "
        "sweep",
    )
    check_no_links(folder)
    rows, points = (read_results(folder / name) for name in (ROWS, POINTS))
    return Results(rows, points if LABELS.keys() <= {*points} else NO_RESULTS.points)
