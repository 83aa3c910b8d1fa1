"""A comparison as a person reads it: a Markdown table, learning curves, bars of J_norm."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from damian.common.markdown import markdown_table
from damian.evaluation.belief_figure import COLOURS
from damian.evaluation.comparison import NOT_LATE, RANDOM, SCRIPTED, SEEN, TRUE, Comparison, Line
from damian.evaluation.statistics import Floats, bootstrap

Curves = Mapping[tuple[str, str, str], Sequence[Sequence[Mapping[str, float]]]]
"""By task, delay and arm: for each seed the rows of its ``metrics.csv``."""

LABELS = {"episode_return": "return", "success_rate": "success rate", "steps": "steps per episode"}
"""Of measures while training, all as the server perceived them."""
COLUMNS = (*TRUE, *SEEN, "age", "late", "lost")
HEADS = ("return", "success", "steps", "seen return", "seen success", "seen steps", "age", "late", "lost")
_STYLE: dict[Any, Any] = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}
_POINTS = 200
"""Of a learning curve."""


def markdown(comparison: Comparison, notes: Sequence[str], tasks: Mapping[str, str], never: set[str]) -> str:
    """The whole comparison.

    Args:
        comparison: what is told.
        notes: lines for the top.
        tasks: how each was trained, for below its heading.
        never: tasks in which there is no success.
    """
    every, parts = comparison.lines, ["\n".join(f"- {note}" for note in notes)]
    for task in comparison.tasks():
        for delay in comparison.delays(task) or [NOT_LATE]:
            told = [line for line in every if line.task == task and line.delay in (NOT_LATE, delay)]
            parts += [f"## {task}, delay {delay}", tasks[task], _table(told, task in never)]
    overall = comparison.overall()
    if overall:
        table = markdown_table(("arm", "interquartile mean of J_norm"), overall.items())
        parts += ["## All tasks and delays", table]
    return "\n\n".join(parts) + "\n"


def _table(told: Sequence[Line], never: bool) -> str:
    left, right = ("arm", "regime", "policy"), (*HEADS, "J_norm", "recovery")
    rows = []
    for line in told:
        name = f"{line.arm} (undelayed)" if line.delay == NOT_LATE and line.arm in SCRIPTED else line.arm
        numbers = ["-" if never and "success" in key else str(line.measures[key]) for key in COLUMNS]
        rows.append([name, line.regime, line.policy, *numbers, str(line.j_norm), str(line.recovery)])
    return markdown_table([*left, *right], rows, left=len(left))


def plot_curves(
    comparison: Comparison, curves: Curves, best: Mapping[str, float], never: set[str], path: Path
) -> None:
    """Learning curves over episodes, a row of panels for each delay (the paper's Figures 5 and 6).

    Mean over seeds of what the runs have smoothed, with its 95 % band; dashed: the random policy and,
    where known (``best``, by measure), the best possible; dotted: an arm that trains nothing.
    """
    task = comparison.tasks()[0]
    delays = comparison.delays(task) or [NOT_LATE]
    shown = [name for name in LABELS if not (name == "success_rate" and task in never)]
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(3.2 * len(shown) + 1.2, 2.6 * len(delays)), layout="constrained")
        axes = figure.subplots(len(delays), len(shown), squeeze=False)
        for row, delay in zip(axes, delays, strict=True):
            for axis, name in zip(row, shown, strict=True):
                _panel(axis, comparison, curves, (task, delay, name))
                if name in best:
                    axis.axhline(
                        best[name], color="0.2", linestyle="--", linewidth=0.8, label="best possible"
                    )
                axis.set(
                    xlabel="episodes", ylabel=f"{LABELS[name]}, perceived", title=f"{task}, delay {delay}"
                )
            row[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        figure.savefig(path, dpi=150)


def _panel(axis: Axes, comparison: Comparison, curves: Curves, place: tuple[str, str, str]) -> None:
    """All arms of a task and delay, by one measure."""
    task, delay, name = place
    for colour, (arm, how) in zip(_colours(comparison), comparison.arms.items(), strict=True):
        where = (task, delay if how.delayed else NOT_LATE, arm)
        if where in curves:
            episodes, mean, low, high = _band(curves[where], name)
            axis.plot(episodes, mean, color=colour, linewidth=1.2, label=arm)
            axis.fill_between(episodes, low, high, color=colour, alpha=0.2, linewidth=0)
        elif runs := comparison.values(*where, comparison.policy, name):
            axis.axhline(fmean(runs.values()), color=colour, linestyle=":", label=arm)
    random = comparison.values(task, NOT_LATE, comparison.undelayed, RANDOM, name)
    if random:
        axis.axhline(fmean(random.values()), color="0.5", linestyle="--", linewidth=0.8, label=RANDOM)


def _band(runs: Sequence[Sequence[Mapping[str, float]]], name: str) -> tuple[Floats, Floats, Floats, Floats]:
    """Episodes that all seeds have reached; mean over seeds, with its 95 % interval, each [_POINTS]."""
    known = [np.array([(r["episodes"], r[name]) for r in run if not np.isnan(r[name])]) for run in runs]
    known = [run for run in known if len(run)]
    if not known:
        nothing = np.full(_POINTS, np.nan)
        return nothing, nothing, nothing, nothing
    episodes = np.linspace(max(run[0, 0] for run in known), min(run[-1, 0] for run in known), _POINTS)
    values = np.stack([np.interp(episodes, *run.T) for run in known], -1)
    low, high = bootstrap(lambda scores: scores.mean(-1), values[None], draws=500)
    return episodes, values.mean(-1), low[0], high[0]


def plot_norms(comparison: Comparison, path: Path) -> None:
    """J_norm of each arm under each delay, with its 95 % interval; a panel for each task."""
    tasks = comparison.tasks()
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(3.0 * len(tasks) + 1.2, 3.0), layout="constrained")
        axes = figure.subplots(1, len(tasks), squeeze=False, sharey=True)[0]
        for axis, task in zip(axes, tasks, strict=True):
            _norm_panel(axis, comparison, task)
        axes[0].set_ylabel("J_norm (dashed: undelayed 1, random 0)")
        axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        figure.savefig(path, dpi=150)


def _norm_panel(axis: Axes, comparison: Comparison, task: str) -> None:
    delays, arms = comparison.delays(task), [name for name, arm in comparison.arms.items() if arm.delayed]
    compared = [comparison.compared(task, delay) for delay in delays]
    colours = dict(zip(comparison.arms, _colours(comparison), strict=True))
    for number, arm in enumerate(arms):
        there = [(x, told[arm][0]) for x, told in enumerate(compared) if arm in told]
        place = [x + 0.7 * ((number + 0.5) / len(arms) - 0.5) for x, _ in there]
        ends = [(x.value - x.low, x.high - x.value) for _, x in there]
        values = [x.value for _, x in there]
        bars = np.array(ends).T if ends else None
        axis.errorbar(place, values, yerr=bars, fmt="o", color=colours[arm], markersize=4, label=arm)
    for level in (0, 1):
        axis.axhline(level, color="0.5", linestyle="--", linewidth=0.8)
    axis.set_xticks(range(len(delays)), delays)
    axis.set(title=task, xlabel="delay", xlim=(-0.5, max(len(delays), 1) - 0.5))


def _colours(comparison: Comparison) -> list[str]:
    """One for each arm."""
    return [COLOURS[place % len(COLOURS)] for place in range(len(comparison.arms))]
