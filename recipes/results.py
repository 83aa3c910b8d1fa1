"""One table of the results in a folder: of a run, of a sweep, or of a comparison (docs/runs.md).

damian results runs/FOLDER
damian.results("runs/FOLDER")   # in Python
"""

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError
from damian.common.tables import markdown_table
from damian.compare.comparison import Estimate, Row, mean_over_seeds
from damian.compare.figures import plot_means
from damian.compare.statistics import FEWEST
from damian.runs.run_folder import DETERMINISTIC, RANDOM, RESULTS, SCRIPT, TRAINED
from damian.runs.run_record import read_record

from .known import key_of
from .shared.comparison_results import FIGURE, MARKDOWN, ROWS, stored_results, write_csv
from .shared.many_runs import read_rows
from .shared.runs import OVERRIDES

MEASURES = ("return", "success_rate", "steps", "perceived_return", "age")
"""Measures of the table of a sweep; success and steps only where some run succeeds."""


def results(folder: str | Path) -> Any:
    """The results in a folder, a row for each policy of each run.

    A comparison has the columns task, delay, arm, regime and seed, a sweep one for each setting in which its
    runs differ. ``return`` and other measures are true values, those that begin with ``perceived_`` what the
    server knew.

    Returns:
        A pandas ``DataFrame`` if pandas is installed, else a list of dictionaries.

    Raises:
        InputError: there is no result in the folder.
    """
    rows = rows_of(Path(folder))
    return import_module("pandas").DataFrame(rows) if find_spec("pandas") else rows


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """The results in a folder, a row for each policy of each run."""
    if is_comparison(folder):
        return [dict(row) for row in stored_results(folder).rows]
    return sweep_rows(folder)[1]


def sweep_rows(folder: Path) -> tuple[list[str], list[dict[str, Any]]]:
    """The settings in which the finished runs of a sweep differ, and a row for each policy of each run."""
    runs = [file.parent for file in sorted(folder.rglob(RESULTS))]
    if not runs:
        raise InputError(f"{folder}: there is no {RESULTS} in it, so no run has finished there")
    words = {run: read_record(run).get(OVERRIDES, []) for run in runs}
    given = {run: {key_of(word): word.partition("=")[2] for word in words[run]} for run in runs}
    keys = dict.fromkeys(key for settings in given.values() for key in settings)
    swept = [key for key in keys if len({settings.get(key) for settings in given.values()}) > 1]
    return swept, [
        {**{key: _value(given[run].get(key)) for key in swept}, "folder": str(run.relative_to(folder)), **row}
        for run in runs
        for row in read_rows(run / RESULTS)
    ]


def is_comparison(folder: Path) -> bool:
    """Has a comparison stored its results in a folder? A sweep stores them under the same name."""
    path = folder / ROWS
    return path.is_file() and "arm" in path.read_text(encoding="utf-8").partition("\n")[0].split(",")


def _value(text: str | None) -> Any:
    """A swept value as a number if it is one."""
    try:
        return None if text is None else int(text) if text.lstrip("-").isdecimal() else float(text)
    except ValueError:
        return text


def report(folder: Path) -> str:
    """Write rows, table and figure of a sweep into its folder; returns the table."""
    swept, rows = sweep_rows(folder)
    groups = [key for key in swept if key != "seed"]
    write_csv(folder / ROWS, rows)
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault((*(row[key] for key in groups), row["policy"]), []).append(row)
    succeeds = any(row["success_rate"] > 0 for row in rows)
    shown = [name for name in MEASURES if succeeds or name not in ("success_rate", "steps")]
    means = {
        group: {name: mean_over_seeds([run[name] for run in runs], name) for name in shown}
        for group, runs in found.items()
    }
    lines = [[*group, len(found[group]), *estimates.values()] for group, estimates in means.items()]
    note = (
        f"n: runs, one for each seed; [95 % interval over runs, none below {FEWEST}]; "
        "perceived: as far as the server knew"
    )
    table = markdown_table([*groups, "policy", "n", *shown], lines, left=len(groups) + 1) + f"\n\n{note}"
    write_atomically(folder / MARKDOWN, table + "\n")
    plot_means(_points(groups, means), "return", folder / FIGURE)
    return table


def _points(
    groups: Sequence[str], means: Mapping[tuple[Any, ...], Mapping[str, Estimate]]
) -> dict[str, dict[str, Estimate]]:
    """Returns by policy and by the settings of the runs."""
    found: dict[str, dict[str, Estimate]] = {}
    for (*values, policy), estimates in means.items():
        if policy in (TRAINED, TRAINED + DETERMINISTIC, SCRIPT, RANDOM):
            name = (
                ", ".join(f"{key}={value}" for key, value in zip(groups, values, strict=True)) or "all runs"
            )
            found.setdefault(policy, {})[name] = estimates["return"]
    return found


def show_sweep(folder: Path) -> None:
    """Report on a sweep, if any run of it has results."""
    if any(folder.rglob(RESULTS)):
        print(f"\nresults of the sweep:\n\n{report(folder)}\n\nresults: {folder}")


def run() -> None:
    """Show the results of the folder that the command line names."""
    words = sys.argv[1:]
    if len(words) != 1:
        raise InputError("damian results FOLDER: give one folder, of a run, a sweep or a comparison")
    folder = Path(words[0])
    if is_comparison(folder) and (folder / MARKDOWN).exists():
        print((folder / MARKDOWN).read_text(encoding="utf-8"))
    elif is_comparison(folder) or (folder / RESULTS).exists():
        print(_listed(rows_of(folder)))
    else:
        print(f"{report(folder)}\n\nresults: {folder}")


def _listed(rows: Sequence[Row]) -> str:
    """All rows as a table."""
    cells = ([f"{x:.4g}" if isinstance(x, float) else str(x) for x in row.values()] for row in rows)
    return markdown_table(list(rows[0]), cells)
