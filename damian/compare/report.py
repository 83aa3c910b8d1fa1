"""Report of a comparison as Markdown: the tables of all methods, and the time that the runs
took."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from damian.common.tables import markdown_table
from damian.compare.comparison import (
    COMPARED,
    HELD_OUT_MARK,
    NOT_LATE,
    RUN,
    SCRIPTED,
    Comparison,
    shown,
)
from damian.compare.figures import curve


def markdown(comparison: Comparison, notes: Sequence[str]) -> str:
    """Return the whole comparison as Markdown, with ``notes`` as lines at the top."""
    table = comparison.table
    runs = comparison.rows.drop_duplicates(RUN)
    hours = f"{len(runs)} runs, which took {runs['seconds'].sum() / 3600:.2f} hours"
    parts = ["\n".join(f"- {note}" for note in (*notes, hours))]
    for task in comparison.tasks():
        frames = runs.loc[runs["task"] == task, "frames"].max()
        trained = f"Trained for {frames:,.0f} environment steps at most."
        if HELD_OUT_MARK in task:
            trained = "Policies of another task."
        for delay in comparison.delays(task) or [NOT_LATE]:
            lines = table[(table["task"] == task) & table["delay"].isin([NOT_LATE, delay])]
            parts += [f"## {task}, delay {delay}", trained, _table(lines, comparison.measured)]
            if delay != NOT_LATE:
                parts += _steps(comparison, task, delay)
    return "\n\n".join(parts) + "\n"


def _table(lines: pd.DataFrame, measures: Sequence[str]) -> str:
    rows = []
    for line in lines.to_dict("records"):
        undelayed = (
            " (undelayed)" if line["delay"] == NOT_LATE and line["method"] in SCRIPTED else ""
        )
        labels = (line["method"] + undelayed, line["regime"], line["policy"], line["seeds"])
        measured, compared = (
            [shown(line, name) for name in names] for names in (measures, COMPARED)
        )
        rows.append([*labels, *measured, line["compared_seeds"] or "-", *compared])
    measured = [name.replace("_", " ") for name in measures]
    head = ["method", "regime", "policy", "n", *measured, "n compared", *COMPARED[:-1], "P > naive"]
    return markdown_table(head, rows, left=3)


def _steps(comparison: Comparison, task: str, delay: str) -> list[str]:
    """Table of the steps in which methods reach the final training return of the best naive one."""
    found = {}
    for method, of_method in comparison.methods.items():
        runs = comparison.curves.get((task, delay if of_method.delayed else NOT_LATE, method))
        if runs is not None:
            steps, values = curve(runs, "hindsight_return")
            tenth = len(steps) // 10
            found[method] = steps[tenth - 1 :], sliding_window_view(values, tenth, axis=0).mean(-1)
    ends = {
        method: found[method][1][-1].mean() for method in found if comparison.methods[method].naive
    }
    if not ends:
        return []
    best, level = max(ends.items(), key=lambda end: end[1])
    rows = []
    for method, (steps, values) in found.items():
        reached = [min(steps[run >= level], default=np.inf) for run in (values.mean(-1), *values.T)]
        numbers = (f"{each:,.0f}" for each in (reached[0], min(reached[1:]), max(reached[1:])))
        rows.append((method, *(number.replace("inf", "never") for number in numbers)))
    title = (
        f"Steps to the final training return (in hindsight, mean over a tenth) of *{best}*, "
        f"{level:.1f}:"
    )
    return [
        title,
        markdown_table(("method", "mean over seeds", "fastest seed", "slowest seed"), rows),
    ]
