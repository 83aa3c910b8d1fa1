"""Report of a comparison: a Markdown table, learning curves, and J_norm of each arm."""

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
from damian.evaluation.comparison import MEASURES, NOT_LATE, RANDOM, SCRIPTED, Comparison, Line
from damian.evaluation.statistics import Floats, bootstrap

Curves = Mapping[tuple[str, str, str], Sequence[Sequence[Mapping[str, float]]]]
"""Rows of ``metrics.csv`` of each seed, by task, delay and arm."""

LABELS = {"episode_return": "return", "success_rate": "success rate", "steps": "steps per episode"}
"""Axis labels of the measures in training, all as the server perceived them."""
HEADS = (
    "return",
    "success",
    "steps",
    "seen return",
    "seen success",
    "seen steps",
    "age",
    "late",
    "lost",
    "back-updated",
)
"""Headings of ``MEASURES`` in the Markdown table."""
_STYLE: dict[Any, Any] = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}
_POINTS = 200
"""Number of points of a learning curve."""


def markdown(comparison: Comparison, notes: Sequence[str], tasks: Mapping[str, str], never: set[str]) -> str:
    """Return the whole comparison as Markdown.

    Args:
        comparison: comparison to report.
        notes: lines at the top.
        tasks: by task, a line below its heading that says how long it was trained.
        never: tasks that have no success to report.
    """
    all_lines, parts = comparison.lines, ["\n".join(f"- {note}" for note in notes)]
    for task in comparison.tasks():
        for delay in comparison.delays(task) or [NOT_LATE]:
            lines = [line for line in all_lines if line.task == task and line.delay in (NOT_LATE, delay)]
            parts += [f"## {task}, delay {delay}", tasks[task], _table(lines, task in never)]
    overall = [(arm, seeds, str(norm)) for arm, (seeds, norm) in comparison.overall().items()]
    if overall:
        table = markdown_table(("arm", "n", "interquartile mean of J_norm"), overall)
        parts += ["## All tasks and delays", table]
    return "\n\n".join(parts) + "\n"


def _table(lines: Sequence[Line], never: bool) -> str:
    left, right = (
        ("arm", "regime", "policy"),
        ("n", *HEADS, "n compared", "J_norm", "recovery", "P > naive", "of ceiling"),
    )
    rows = []
    for line in lines:
        name = f"{line.arm} (undelayed)" if line.delay == NOT_LATE and line.arm in SCRIPTED else line.arm
        numbers = ["-" if never and "success" in key else str(line.measures[key]) for key in MEASURES]
        seeds, *compared = line.compared
        numbers = [str(len(line.seeds)), *numbers, str(len(seeds) or "-"), *map(str, compared)]
        rows.append([name, line.regime, line.policy, *numbers])
    return markdown_table([*left, *right], rows, left=len(left))


def plot_curves(
    comparison: Comparison, curves: Curves, best: Mapping[str, float], never: set[str], path: Path
) -> None:
    """Draw learning curves over episodes, a row of panels for each delay (the paper's Figures 5 and 6).

    A curve is the mean over seeds of the smoothed measures of the runs, with its 95 % band. Dashed lines: the
    random policy and, where known, the best possible value; dotted lines: arms that train nothing.

    Args:
        comparison: comparison to draw; its first task is drawn.
        curves: measures of the runs in training.
        best: best possible values, by measure.
        never: tasks that have no success to draw.
        path: image file.
    """
    task = comparison.tasks()[0]
    delays = comparison.delays(task) or [NOT_LATE]
    measures = [name for name in LABELS if not (name == "success_rate" and task in never)]
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(3.2 * len(measures) + 1.2, 2.6 * len(delays)), layout="constrained")
        axes = figure.subplots(len(delays), len(measures), squeeze=False)
        for row, delay in zip(axes, delays, strict=True):
            for axis, name in zip(row, measures, strict=True):
                _curve_panel(axis, comparison, curves, (task, delay, name))
                if name in best:
                    axis.axhline(
                        best[name], color="0.2", linestyle="--", linewidth=0.8, label="best possible"
                    )
                axis.set(
                    xlabel="episodes", ylabel=f"{LABELS[name]}, perceived", title=f"{task}, delay {delay}"
                )
            row[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        figure.savefig(path, dpi=150)


def _curve_panel(axis: Axes, comparison: Comparison, curves: Curves, content: tuple[str, str, str]) -> None:
    """Draw all arms of a task under a delay, by one measure; ``content`` names these three."""
    task, delay, measure = content
    for colour, (name, arm) in zip(_colours(comparison), comparison.arms.items(), strict=True):
        run = (task, delay if arm.delayed else NOT_LATE, name)
        if run in curves:
            episodes, mean, low, high = _band(curves[run], measure)
            axis.plot(episodes, mean, color=colour, linewidth=1.2, label=name)
            axis.fill_between(episodes, low, high, color=colour, alpha=0.2, linewidth=0)
        elif values := comparison.values(*run, comparison.policy, measure):
            axis.axhline(fmean(values.values()), color=colour, linestyle=":", label=name)
    random = comparison.values(task, NOT_LATE, comparison.undelayed, RANDOM, measure)
    if random:
        axis.axhline(fmean(random.values()), color="0.5", linestyle="--", linewidth=0.8, label=RANDOM)


def _band(runs: Sequence[Sequence[Mapping[str, float]]], name: str) -> tuple[Floats, Floats, Floats, Floats]:
    """Numbers of episodes that all seeds reached, mean over seeds, and the ends of its 95 % interval.

    Each is [_POINTS]; ``name`` is the measure.
    """
    points = [np.array([(r["episodes"], r[name]) for r in run if not np.isnan(r[name])]) for run in runs]
    points = [run for run in points if len(run)]
    if not points:
        unknown = np.full(_POINTS, np.nan)
        return unknown, unknown, unknown, unknown
    episodes = np.linspace(max(run[0, 0] for run in points), min(run[-1, 0] for run in points), _POINTS)
    values = np.stack([np.interp(episodes, *run.T) for run in points], -1)
    low, high = bootstrap(lambda scores: scores.mean(-1), values[None], draws=500)
    return episodes, values.mean(-1), low[0], high[0]


def plot_norms(comparison: Comparison, path: Path) -> None:
    """Draw J_norm of each arm under each delay, with its 95 % interval; a panel for each task."""
    tasks = comparison.tasks()
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(3.0 * len(tasks) + 1.2, 3.0), layout="constrained")
        axes = figure.subplots(1, len(tasks), squeeze=False, sharey=True)[0]
        for axis, task in zip(axes, tasks, strict=True):
            _norm_panel(axis, comparison, task)
        axes[0].set_ylabel("J_norm (dashed: undelayed 1, random 0)")
        if axes[-1].get_legend_handles_labels()[0]:
            axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        figure.savefig(path, dpi=150)


def _norm_panel(axis: Axes, comparison: Comparison, task: str) -> None:
    delays = comparison.delays(task)
    arms = [name for name, arm in comparison.arms.items() if arm.delayed and not arm.ceiling]
    compared = [comparison.compared(task, delay) for delay in delays]
    colours = dict(zip(comparison.arms, _colours(comparison), strict=True))
    for index, arm in enumerate(arms):
        norms = [(x, estimates[arm].j_norm) for x, estimates in enumerate(compared) if arm in estimates]
        positions = [x + 0.7 * ((index + 0.5) / len(arms) - 0.5) for x, _ in norms]
        errors = [(norm.value - norm.low, norm.high - norm.value) for _, norm in norms]
        values = [norm.value for _, norm in norms]
        bars = np.array(errors).T if errors else None
        axis.errorbar(positions, values, yerr=bars, fmt="o", color=colours[arm], markersize=4, label=arm)
    for level in (0, 1):
        axis.axhline(level, color="0.5", linestyle="--", linewidth=0.8)
    axis.set_xticks(range(len(delays)), delays)
    axis.set(title=task, xlabel="delay", xlim=(-0.5, max(len(delays), 1) - 0.5))


def _colours(comparison: Comparison) -> list[str]:
    """Colour of each arm."""
    return [COLOURS[index % len(COLOURS)] for index in range(len(comparison.arms))]
