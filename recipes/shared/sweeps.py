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
from damian.compare.figures import plot_means
from damian.compare.paired import as_table, means
from damian.runs.run_folder import (
    CONFIG,
    DETERMINISTIC,
    FAILED,
    RANDOM,
    RESULTS,
    SCRIPT,
    TRAINED,
    check_no_links,
    read_results,
)
from damian.runs.run_record import read_record

from ..cli import short
from ..known import key_of
from .comparison_results import FIGURE, MARKDOWN, ROWS
from .runs import JOB, OVERRIDES, SEED


class SweepReport(Callback):
    """Reports on a sweep when all of its runs have ended, whichever processes or machines they were in."""

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        end(short(Path(config.hydra.sweep.dir)))


def end(folder: Path) -> None:
    """Report on a sweep that has ended; the exit code says if something failed, and if nothing began."""
    failed = [*folder.rglob(FAILED)]
    if failed and not any(folder.rglob(CONFIG)):  # wrong input of every run: nothing is kept of it
        for file in failed:
            file.unlink()
            with suppress(OSError):
                file.parent.rmdir()
        sys.exit(2)
    print(f"\nresults of the sweep:\n\n{report(folder)}\n\nresults: {folder}")
    if failed:
        sys.exit(1)


def sweep_rows(folder: Path) -> tuple[list[str], pd.DataFrame]:
    """The settings in which the finished runs in a folder differ, and a row for each policy of each run."""
    runs = [file.parent for file in sorted(folder.rglob(RESULTS))]
    if not runs:
        raise InputError(f"{folder}: there is no {RESULTS} in it, so no run has finished there")
    for run in runs:
        check_no_links(run, "folders")
    records = {run: read_record(run) for run in runs}
    runs.sort(key=lambda run: records[run].get(JOB, 0))  # as the command line names them
    swept, given = _differing([records[run].get(OVERRIDES, []) for run in runs])
    tables = []
    for run, settings in zip(runs, given, strict=True):
        labels = {**settings, "seed": records[run].get(SEED)}
        labels["folder"] = str(run.relative_to(folder))
        rows = read_results(run / RESULTS)
        tables.append(rows.assign(**labels)[[*labels, *rows.columns]])
    return swept, pd.concat(tables, ignore_index=True)


def _differing(words: Sequence[Sequence[str]]) -> tuple[list[str], list[dict[str, Any]]]:
    """The keys, without the seed, that are not the same in all command lines, and their values in each."""
    given = pd.DataFrame([{key_of(word): word.partition("=")[2] for word in line} for line in words])
    given = given.fillna("")
    keys = [str(key) for key in given if given[key].nunique() > 1 and key != "seed"]
    return keys, [{key: _value(line[key]) for key in keys} for _, line in given.iterrows()]


def _value(text: str) -> int | float | str:
    """A swept value as a number if it is one."""
    try:
        return int(text) if text.lstrip("-").isdecimal() else float(text)
    except ValueError:
        return text


def report(folder: Path) -> str:
    """Write rows, table and figure of a sweep into its folder; returns the table."""
    for each in {folder, *(file.parent for file in folder.rglob(FAILED))}:
        check_no_links(each, "folders")
    failed = {file.parent: json.loads(read_text(file)) for file in sorted(folder.rglob(FAILED))}
    errors = pd.DataFrame(
        [{"folder": str(run.relative_to(folder)), "error": each["error"]} for run, each in failed.items()]
    )
    parts, rows = [], errors
    if any(folder.rglob(RESULTS)):
        groups, rows = sweep_rows(folder)
        lines = means(rows, groups)
        parts.append(as_table(lines, groups))
        drawn = lines["policy"].isin((TRAINED, TRAINED + DETERMINISTIC, SCRIPT, RANDOM))
        plot_means(lines[drawn], "return", folder / FIGURE)
        rows = pd.concat([rows, errors], ignore_index=True)
    if failed:
        parts.append(markdown_table(["failed", "why"], errors.to_numpy().tolist(), left=2))
    write_csv(folder / ROWS, rows)
    write_atomically(folder / MARKDOWN, "\n\n".join(parts) + "\n")
    return "\n\n".join(parts)


def compared(folders: Sequence[Path], score: str) -> str:
    """The table of two folders, of runs or sweeps, with the difference of the second to the first."""
    found = [sweep_rows(folder) for folder in folders]
    rows = pd.concat([rows.assign(folder=str(path)) for path, (_, rows) in zip(folders, found, strict=True)])
    shared = [key for key in found[0][0] if key in found[1][0]]
    return as_table(means(rows, ["folder", *shared], score), ["folder", *shared], score)
