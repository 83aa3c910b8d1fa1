"""Report of a comparison as Markdown: the tables of all arms, and the time that the runs took."""

from collections.abc import Sequence

import pandas as pd

from damian.common.tables import markdown_table
from damian.compare.comparison import (
    COMPARED,
    HELD_OUT_MARK,
    MEASURED,
    NOT_LATE,
    RUN,
    SCRIPTED,
    Comparison,
    shown,
)


def markdown(comparison: Comparison, notes: Sequence[str]) -> str:
    """Return the whole comparison as Markdown, with ``notes`` as lines at the top."""
    table, runs = comparison.table, comparison.rows.drop_duplicates(RUN)
    hours = f"{len(runs)} runs, which took {runs['seconds'].sum() / 3600:.2f} hours"
    parts = ["\n".join(f"- {note}" for note in (*notes, hours))]
    for task in comparison.tasks():
        frames = runs.loc[runs["task"] == task, "frames"].max()
        trained = f"Trained for {frames:,.0f} environment steps at most."
        if HELD_OUT_MARK in task:
            trained = "Policies of another task."
        for delay in comparison.delays(task) or [NOT_LATE]:
            lines = table[(table["task"] == task) & table["delay"].isin([NOT_LATE, delay])]
            parts += [f"## {task}, delay {delay}", trained, _table(lines)]
    return "\n\n".join(parts) + "\n"


def _table(lines: pd.DataFrame) -> str:
    rows = []
    for line in lines.to_dict("records"):
        undelayed = " (undelayed)" if line["delay"] == NOT_LATE and line["arm"] in SCRIPTED else ""
        labels = (line["arm"] + undelayed, line["regime"], line["policy"], line["seeds"])
        measured, compared = ([shown(line, name) for name in names] for names in (MEASURED, COMPARED))
        rows.append([*labels, *measured, line["compared_seeds"] or "-", *compared])
    measured = [name.replace("_", " ") for name in MEASURED]
    head = ["method", "regime", "policy", "n", *measured, "n compared", *COMPARED[:-1], "P > naive"]
    return markdown_table(head, rows, left=3)
