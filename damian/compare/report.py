"""Report of a comparison as Markdown: the tables of all arms, and the time that the runs took."""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from damian.common.tables import markdown_table
from damian.compare.comparison import (
    COMPARED,
    HELD_OUT_MARK,
    MEASURED,
    NOT_LATE,
    SCRIPTED,
    Comparison,
    Line,
)
from damian.compare.figures import Curves, curve


def markdown(comparison: Comparison, curves: Curves, notes: Sequence[str]) -> str:
    """Return the whole comparison as Markdown, with ``notes`` as lines at the top."""
    all_lines, parts = comparison.lines, ["\n".join(f"- {note}" for note in notes)]
    for task in comparison.tasks():
        for delay in comparison.delays(task) or [NOT_LATE]:
            lines = [line for line in all_lines if line.task == task and line.delay in (NOT_LATE, delay)]
            parts += [f"## {task}, delay {delay}", _length(comparison, task), _table(lines)]
            if delay != NOT_LATE:
                parts += _steps(comparison, curves, task, delay)
    overall = [(arm, seeds, str(norm)) for arm, (seeds, norm) in comparison.overall().items()]
    if overall:
        table = markdown_table(("method", "n", "interquartile mean of J_norm"), overall)
        parts += ["## All tasks and delays", table]
    return "\n\n".join([*parts, "## Compute", _compute(comparison)]) + "\n"


def _length(comparison: Comparison, task: str) -> str:
    """How long the policies of a task were trained."""
    if HELD_OUT_MARK in task:
        return "Policies of another task."
    trained = sorted(
        {int(run["frames"]) for run in comparison.runs() if run["task"] == task and run["frames"]}
    )
    least_to_most = " to ".join(f"{frames:,}" for frames in dict.fromkeys([*trained[:1], *trained[-1:]]))
    return f"Trained for {least_to_most or 'no'} environment steps."


def _table(lines: Sequence[Line]) -> str:
    rows = []
    for line in lines:
        name = f"{line.arm} (undelayed)" if line.delay == NOT_LATE and line.arm in SCRIPTED else line.arm
        measured = [str(line.measures[column.name]) for column in MEASURED]
        compared = [str(line.compared[column.name]) for column in COMPARED]
        n_compared = str(len(line.compared.seeds) or "-")
        rows.append([name, line.regime, line.policy, str(len(line.seeds)), *measured, n_compared, *compared])
    heads = [*(column.head for column in MEASURED), "n compared", *(column.head for column in COMPARED)]
    return markdown_table(["method", "regime", "policy", "n", *heads], rows, left=3)


def _steps(comparison: Comparison, curves: Curves, task: str, delay: str) -> list[str]:
    """Table of the environment steps in which arms reach the final training return of the best naive arm."""
    found = {}
    for arm, of_arm in comparison.arms.items():
        run = (task, delay if of_arm.delayed else NOT_LATE, arm)
        if run in curves:
            steps, values = curve(curves[run], "hindsight_return")
            tenth = len(steps) // 10
            found[arm] = steps[tenth - 1 :], sliding_window_view(values, tenth, axis=0).mean(-1)
    ends = {arm: found[arm][1][-1].mean() for arm in found if comparison.arms[arm].naive}
    if not ends:
        return []
    best, level = max(ends.items(), key=lambda end: end[1])
    rows = []
    for arm, (steps, values) in found.items():
        reached = [min(steps[run >= level], default=np.inf) for run in (values.mean(-1), *values.T)]
        numbers = (f"{each:,.0f}" for each in (reached[0], min(reached[1:]), max(reached[1:])))
        rows.append((arm, *(number.replace("inf", "never") for number in numbers)))
    title = f"Steps to the final training return (in hindsight, mean over a tenth) of *{best}*, {level:.1f}:"
    return [title, markdown_table(("method", "mean over seeds", "fastest seed", "slowest seed"), rows)]


def _compute(comparison: Comparison) -> str:
    """Number and time of the runs of each arm."""
    runs = comparison.runs()
    by_arm = {arm: [run["seconds"] for run in runs if run["arm"] == arm] for arm in comparison.arms}
    rows = [
        (arm, len(times), f"{sum(times) / len(times):.0f}", f"{sum(times) / 3600:.2f}")
        for arm, times in (by_arm | {"all": [run["seconds"] for run in runs]}).items()
        if times
    ]
    return markdown_table(("method", "runs", "seconds a run", "hours of all runs"), rows)
