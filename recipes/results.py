"""One table of the results in a folder: of a run, of a sweep, or of a comparison (docs/runs.md).

damian results runs/FOLDER
damian.results("runs/FOLDER")   # in Python
"""

import sys
from pathlib import Path

import pandas as pd

from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError
from damian.common.tables import markdown_table, write_csv
from damian.compare.comparison import means_over_seeds, shown
from damian.compare.figures import plot_means
from damian.compare.statistics import FEWEST
from damian.runs.run_folder import DETERMINISTIC, RANDOM, RESULTS, SCRIPT, TRAINED, read_results
from damian.runs.run_record import read_record

from .known import key_of
from .shared.comparison_results import FIGURE, MARKDOWN, ROWS, stored_results
from .shared.runs import OVERRIDES

MEASURES = ["return", "success_rate", "steps", "perceived_return", "age"]
"""Measures of the table of a sweep; success and steps only where some run succeeds."""


def results(folder: str | Path) -> pd.DataFrame:
    """The results in a folder, a row for each policy of each run.

    A comparison has the columns task, delay, arm, regime and seed, a sweep one for each setting in which its
    runs differ. ``return`` and other measures are true values, those that begin with ``perceived_`` what the
    server knew.

    Raises:
        InputError: there is no result in the folder.
    """
    folder = Path(folder)
    return stored_results(folder).rows if is_comparison(folder) else sweep_rows(folder)[1]


def sweep_rows(folder: Path) -> tuple[list[str], pd.DataFrame]:
    """The settings in which the finished runs of a sweep differ, and a row for each policy of each run."""
    runs = [file.parent for file in sorted(folder.rglob(RESULTS))]
    if not runs:
        raise InputError(f"{folder}: there is no {RESULTS} in it, so no run has finished there")
    words = [read_record(run).get(OVERRIDES, []) for run in runs]
    given = pd.DataFrame(
        [{key_of(word): word.partition("=")[2] for word in of_run} for of_run in words]
    ).fillna("")
    swept = [key for key in given if given[key].nunique() > 1]
    tables = []
    for run, (_, settings) in zip(runs, given[swept].iterrows(), strict=True):
        rows, labels = read_results(run / RESULTS), {str(k): _value(x) for k, x in settings.items()}
        labels["folder"] = str(run.relative_to(folder))
        tables.append(rows.assign(**labels)[[*labels, *rows.columns]])
    return swept, pd.concat(tables, ignore_index=True)


def is_comparison(folder: Path) -> bool:
    """Whether a comparison has stored its results in a folder; a sweep stores them under the same name."""
    path = folder / ROWS
    return path.is_file() and "arm" in path.read_text(encoding="utf-8").partition("\n")[0].split(",")


def _value(text: str) -> int | float | str:
    """A swept value as a number if it is one."""
    try:
        return int(text) if text.lstrip("-").isdecimal() else float(text)
    except ValueError:
        return text


def report(folder: Path) -> str:
    """Write rows, table and figure of a sweep into its folder; returns the table."""
    swept, rows = sweep_rows(folder)
    write_csv(folder / ROWS, rows)
    groups, succeeds = [key for key in swept if key != "seed"], (rows["success_rate"] > 0).any()
    measures = [name for name in MEASURES if succeeds or name not in ("success_rate", "steps")]
    lines = []
    for names, runs in rows.groupby([*groups, "policy"], sort=False):
        group = ", ".join(f"{key}={value}" for key, value in zip(groups, names, strict=False)) or "all runs"
        labels = dict(zip([*groups, "policy"], names, strict=True))
        lines.append({**labels, "group": group, "n": len(runs), **means_over_seeds(runs[measures])})
    note = (
        f"n: runs, one for each seed; [95 % interval over runs, none below {FEWEST}]; "
        "perceived: as far as the server knew"
    )
    head = [*groups, "policy", "n"]
    cells = [[*(line[name] for name in head), *(shown(line, name) for name in measures)] for line in lines]
    table = markdown_table([*head, *measures], cells, left=len(groups) + 1) + f"\n\n{note}"
    write_atomically(folder / MARKDOWN, table + "\n")
    means = pd.DataFrame(lines)
    drawn = means["policy"].isin((TRAINED, TRAINED + DETERMINISTIC, SCRIPT, RANDOM))
    plot_means(means[drawn], "return", folder / FIGURE)
    return table


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
        rows = results(folder)
        cells = rows.map(lambda x: f"{x:.4g}" if isinstance(x, float) else str(x))
        print(markdown_table([*map(str, rows)], cells.to_numpy()))
    else:
        print(f"{report(folder)}\n\nresults: {folder}")
