"""The tables of a sweep and of two folders: means over seeds, and paired differences to the first value."""

import json
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError
from damian.common.tables import markdown_table, write_csv
from damian.common.text_files import read_text
from damian.compare.figures import plot_sweep
from damian.compare.paired import as_table, means
from damian.runs.run_folder import FAILED, RESULTS, check_no_links, read_results
from damian.runs.run_record import read_record

from ..cli import one_line_errors, short
from ..known import key_of
from .comparison_runs import FIGURE, MARKDOWN, ROWS
from .runs import JOB, OVERRIDES, SEED


class SweepReport(Callback):
    """Reports on a sweep when all of its runs have ended, wherever they were; exit code 1 if one failed."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        str(config.hydra.sweep.subdir)  # the names of the runs' folders need the words of the whole sweep
        with one_line_errors():
            check_no_links(short(Path(config.hydra.sweep.dir)))  # where Hydra writes, too

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        folder = short(Path(config.hydra.sweep.dir))
        with one_line_errors():
            print(f"\nresults of the sweep:\n\n{report(folder)}\n\nresults: {folder}")
        if any(folder.rglob(FAILED)):
            sys.exit(1)


def sweep_rows(folder: Path) -> tuple[list[str], pd.DataFrame]:
    """The settings in which the finished runs in a folder differ, and a row for each policy of each run."""
    runs = [file.parent for file in sorted(folder.rglob(RESULTS))]
    if not runs:
        raise InputError(f"{folder}: there is no {RESULTS} in it, so no run has finished there")
    for run in runs:
        check_no_links(run)
    records = {run: read_record(run) for run in runs}
    runs.sort(key=lambda run: records[run].get(JOB, 0))  # as the command line names them
    words = [[word.partition("=") for word in records[run].get(OVERRIDES, [])] for run in runs]
    given = pd.DataFrame([{key_of(key): value for key, _, value in line} for line in words]).fillna("")
    given = given[[key for key in given if given[key].nunique() > 1 and key != "seed"]]
    for key in given:
        with suppress(ValueError):  # a setting that is no number
            given[key] = pd.to_numeric(given[key])
    tables = []
    for run, settings in zip(runs, given.to_dict("records"), strict=True):
        labels = {**settings, "seed": records[run].get(SEED), "folder": str(run.relative_to(folder))}
        rows = read_results(run / RESULTS)
        tables.append(rows.assign(**labels)[[*labels, *rows.columns]])
    return [*given], pd.concat(tables, ignore_index=True)


def report(folder: Path) -> str:
    """Write rows, table and figure of a sweep into its folder; returns the table."""
    failed = [file.parent for file in sorted(folder.rglob(FAILED))]
    for each in (folder, *failed):
        check_no_links(each)
    errors = [[str(run.relative_to(folder)), json.loads(read_text(run / FAILED))["error"]] for run in failed]
    parts, rows = [], pd.DataFrame(errors, columns=["folder", "error"])
    if any(folder.rglob(RESULTS)) or not failed:
        groups, finished = sweep_rows(folder)
        lines = means(finished, groups)
        parts.append(as_table(lines, groups))
        plot_sweep(lines, groups, folder / FIGURE)
        rows = pd.concat([finished, rows], ignore_index=True) if failed else finished
    if failed:
        parts.append(markdown_table(["failed", "why"], errors, left=2))
    write_csv(folder / ROWS, rows)
    write_atomically(folder / MARKDOWN, "\n\n".join(parts) + "\n")
    return "\n\n".join(parts)


def compared(folders: Sequence[Path], score: str) -> str:
    """The table of two folders, of runs or sweeps, with the difference of the second to the first."""
    found = [sweep_rows(folder) for folder in folders]
    rows = pd.concat([rows.assign(folder=str(path)) for path, (_, rows) in zip(folders, found, strict=True)])
    shared = [key for key in found[0][0] if key in found[1][0]]
    return as_table(means(rows, ["folder", *shared], score), ["folder", *shared], score)
