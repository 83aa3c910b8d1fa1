"""Figures of a comparison: learning curves, J_norm of each arm, and the matrix of held-out tasks."""

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from damian.common.plotting import COLOURS, STYLE
from damian.compare.comparison import (
    BOUNDS,
    HELD_OUT_MARK,
    NOT_LATE,
    Comparison,
    Estimate,
    mean_over_seeds,
)
from damian.compare.statistics import Floats, bootstrap
from damian.runs.run_folder import RANDOM, SCRIPT, TRAINED

Panel = TypeVar("Panel")
Curves = Mapping[tuple[str, str, str], Sequence[Sequence[Mapping[str, float]]]]
"""Rows of ``metrics.csv`` of each seed, by task, delay and arm."""

LABELS = {
    "hindsight_return": "return in hindsight",
    "perceived_success_rate": "success rate, perceived",
    "perceived_steps": "steps per episode, perceived",
}
"""Axis labels of the measures in training: in hindsight, from late data, or as the server perceived them."""
PROGRESS = {"frames": "environment steps", "episodes": "episodes"}
"""Axis labels of how far a training has come."""
ARM_COLOURS = (*COLOURS, "#332288", "#882255", "#117733", "#999933", "#44AA99", "#AA4499")
"""Colours of arms: after the usual ones, six of Paul Tol's muted ones."""
_METHODS = (
    f"undelayed {TRAINED},deployed backupdate+rewards {SCRIPT},naive naive+tuned finetuned {RANDOM},"
    "naive+history naive+history+tuned imitation,naive+late_own naive+timeline,"
    "naive+gru naive+gru+tuned naive+gru+hold,"
    "predictive backupdate+critic backupdate+ages backupdate+late_own,backupdate backupdate+tuned,"
    "backupdate+history both backupdate+gru+hold,deployed+late_own backupdate+gru,"
    "belief timeline+gru qmix,untrained privileged timeline"
).split(",")
"""The arms of our experiments, and the policies of a run, that have each of these colours."""
_LINES, _DOTTED, _MARKERS = ("-", "-.", "--"), (":", (0, (1, 4))), "os^D"
"""Of arms that train, of those that train nothing, and of points; later ones where two have one colour."""
_POINTS = 200
"""Number of points of a learning curve."""
_DELAY, _FLOWN = "delay_", 4
"""Begin of the name of a held-out delay; least number of them under which a policy flew, to be drawn."""
_LEVEL: dict[str, Any] = {"color": "0.5", "linestyle": "--", "linewidth": 0.8}
"""Style of lines at a reference."""


def plot_curves(comparison: Comparison, curves: Curves, path: Path) -> None:
    """Draw learning curves over environment steps; over episodes if the runs made different numbers of steps.

    One task has a row of panels for each delay, with return and, where it can succeed, success rate and
    steps; of several tasks, each has a row with its returns under each delay, or, under one delay, a panel.
    A curve is the mean over seeds, with its 95 % band. Dashed lines: the random policy; dash-dotted: the
    undelayed script; dotted: arms that train nothing.
    """
    grid = [row for row in _panels(comparison, curves) if row]
    if all(len(row) == 1 for row in grid):
        grid = _rows([panel for (panel,) in grid], 2)
    ends = [run[-1]["frames"] for runs in curves.values() for run in runs] or [0]
    progress = "frames" if min(ends) > 0.95 * max(ends) else "episodes"  # batches end a little later
    _save(path, grid, partial(_curve_panel, comparison, curves, progress), (3.2, 2.6))


def plot_norms(comparison: Comparison, path: Path) -> None:
    """Draw J_norm of each arm under each delay, with 95 % intervals, in a panel for each task with any."""
    norms = {task: found for task in comparison.tasks() if (found := _known_norms(comparison, task))}
    grid = _rows([*norms], 4)
    arms = [name for name, arm in comparison.arms.items() if arm.delayed]

    def panel(axis: Axes, task: str) -> None:
        for arm in [arm for arm in arms if arm in norms[task]]:
            place = 0.7 * ((arms.index(arm) + 0.5) / len(arms) - 0.5)
            known = [(x + place, norm) for x, norm in norms[task][arm].items()]
            _error_bars(axis, known, label=arm, **look(comparison, arm) | {"linestyle": ""})
        delays = comparison.delays(task)
        axis.set_xticks(range(len(delays)), delays)
        title = task.replace(HELD_OUT_MARK, ", held-out ")
        axis.set(title=title, xlabel="delay", xlim=(-0.5, max(len(delays), 1) - 0.5))
        for level in (0, 1):
            axis.axhline(level, **_LEVEL)
        if task in [row[0] for row in grid]:
            axis.set_ylabel("J_norm (dashed: undelayed 1, random 0)")

    _save(path, grid, panel, (3.0, 3.0), sharey=True)


def plot_matrix(comparison: Comparison, path: Path) -> None:
    """Draw the scores of policies over the held-out delays under which they flew, a line for each training.

    Held-out tasks of delays have names that begin with ``delay_``; a policy must have flown under four.
    """
    flown: dict[str, list[str]] = {}
    for task in comparison.tasks():
        trained_in, _, change = task.partition(HELD_OUT_MARK)
        flown.setdefault(trained_in, []).extend([task] * change.startswith(_DELAY))
    flown = {task: sorted(tasks, key=lambda name: (len(name), name)) for task, tasks in flown.items()}

    def lines(task: str) -> Iterator[tuple[str, str, dict[int, Estimate]]]:
        trained = {(row["delay"], row["arm"]): None for row in comparison.rows if row["task"] in flown[task]}
        for delay, arm in trained:
            runs = (
                comparison.values(each, delay, arm, comparison.policy, comparison.score)
                for each in flown[task]
            )
            known = {x: mean_over_seeds([*of.values()], comparison.score) for x, of in enumerate(runs) if of}
            if len(known) >= _FLOWN:
                yield delay, arm, known

    def panel(axis: Axes, task: str) -> None:
        names = [each.partition(HELD_OUT_MARK)[2].removeprefix(_DELAY) for each in flown[task]]
        for number, (delay, arm, known) in enumerate(lines(task)):
            style = {
                "color": ARM_COLOURS[number % len(ARM_COLOURS)],
                "marker": _MARKERS[number % len(_MARKERS)],
            }
            _error_bars(axis, [*known.items()], label=f"{arm}, trained at {delay}", linewidth=1.2, **style)
        axis.set_xticks(range(len(names)), names, rotation=90)
        axis.set(title=task, xlabel="delay of the flight [steps], or its law", ylabel=comparison.score)

    _save(path, [[task] for task in flown if [*lines(task)]], panel, (6.4, 3.6))


def plot_means(means: Mapping[str, Mapping[str, Estimate]], label: str, path: Path) -> None:
    """Draw means with 95 % intervals in a row for each group of runs, and a colour for each policy."""
    groups = list(dict.fromkeys(name for found in means.values() for name in found))

    def panel(axis: Axes, _: None) -> None:
        for place, (policy, found) in enumerate(means.items()):
            shift = 0.5 * ((place + 0.5) / len(means) - 0.5)
            rows = [groups.index(name) + shift for name in found]
            value, low, high = np.array([*found.values()], dtype=float).reshape(-1, 3).T
            ends = np.nan_to_num([value - low, high - value])
            axis.errorbar(value, rows, xerr=ends, fmt="o", color=colour_of(policy), label=policy)
        axis.set_yticks(range(len(groups)), groups)
        axis.invert_yaxis()
        axis.set_xlabel(label)

    _save(path, [[None]], panel, (5.2, 0.4 * len(groups) + 1.4))


def look(comparison: Comparison, arm: str) -> dict[str, Any]:
    """Colour of an arm; line and marker, which tell it from those before it that have the same colour."""
    before = list(comparison.arms)[: list(comparison.arms).index(arm)]
    again, of_arm = sum(colour_of(other) == colour_of(arm) for other in before), comparison.arms[arm]
    trains = of_arm.policy_of is None and not of_arm.untrained
    lines = _LINES if trains else _DOTTED
    return {
        "color": colour_of(arm),
        "linestyle": lines[again % len(lines)],
        "marker": _MARKERS[again % len(_MARKERS)],
    }


def colour_of(method: str) -> str:
    """Colour of an arm or a policy, whichever others are drawn; your own has one that its name decides."""
    known = [index for index, names in enumerate(_METHODS) if method in names.split()]
    return ARM_COLOURS[known[0] if known else zlib.crc32(method.encode()) % len(ARM_COLOURS)]


def _rows(panels: list[Panel], width: int) -> list[list[Panel]]:
    """Panels in rows of at most ``width``."""
    return [panels[i : i + width] for i in range(0, len(panels), width)]


def _save(
    path: Path,
    grid: Sequence[Sequence[Panel]],
    draw: Callable[[Axes, Panel], None],
    size: tuple[float, float],
    sharey: bool = False,
) -> None:
    """Draw rows of panels of this size [inches], with one legend to the right of them."""
    if not grid:
        path.unlink(missing_ok=True)  # an older one would show other runs
        return
    width = max(map(len, grid))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(size[0] * width + 1.2, size[1] * len(grid)), layout="constrained")
        axes = figure.subplots(len(grid), width, squeeze=False, sharey=sharey)
        drawn: dict[str, Any] = {}
        for row, panels in zip(axes, grid, strict=True):
            for axis, panel in zip(row, panels, strict=False):
                draw(axis, panel)
                drawn |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
            for axis in row[len(panels) :]:
                axis.set_axis_off()
        figure.legend([*drawn.values()], [*drawn], loc="outside right upper", frameon=False)
        figure.savefig(path, dpi=150)


def _panels(comparison: Comparison, curves: Curves) -> list[list[tuple[str, str, str]]]:
    """Task, delay and measure of each panel, by rows."""
    tasks = [task for task in comparison.tasks() if HELD_OUT_MARK not in task]
    delays = {task: comparison.delays(task) or [NOT_LATE] for task in tasks}
    if len(tasks) > 1:
        return [[(task, delay, "hindsight_return") for delay in delays[task]] for task in tasks]
    rows = [row for runs in curves.values() for run in runs for row in run]
    succeeds = any(not np.isnan(row["perceived_success_rate"]) for row in rows)
    measures = [*LABELS] if succeeds else ["hindsight_return"]  # else episodes end at their limit
    return [[(task, delay, name) for name in measures] for task in tasks for delay in delays[task]]


def _curve_panel(
    comparison: Comparison, curves: Curves, progress: str, axis: Axes, content: tuple[str, str, str]
) -> None:
    """Draw all arms in a panel of ``_panels``."""
    task, delay, measure = content
    flown = "return" if measure == "hindsight_return" else measure  # of an evaluation, which knows the truth
    axis.set(xlabel=PROGRESS[progress], ylabel=LABELS[measure], title=f"{task}, delay {delay}")
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    for name, arm in comparison.arms.items():
        run = (task, delay if arm.delayed else NOT_LATE, name)
        style: dict[str, Any] = look(comparison, name) | {"marker": "", "label": name}
        if run in curves:
            place, values = curve(curves[run], measure, progress)
            low, high = bootstrap(lambda v: v.mean(-1), values[None], draws=500, bounds=BOUNDS[flown])
            axis.plot(place, values.mean(-1), linewidth=1.2, **style)
            axis.fill_between(place, low[0], high[0], color=style["color"], alpha=0.2, linewidth=0)
        elif values := comparison.values(*run, comparison.policy, flown):
            axis.axhline(fmean(values.values()), **style)
    for policy, label, line in ((RANDOM, RANDOM, "--"), (SCRIPT, f"{SCRIPT}, undelayed", "-.")):
        if values := comparison.values(task, NOT_LATE, comparison.undelayed, policy, flown):
            level: dict[str, Any] = _LEVEL | {"linestyle": line}
            axis.axhline(fmean(values.values()), label=label, **level)


def curve(
    runs: Sequence[Sequence[Mapping[str, float]]], name: str, progress: str = "frames"
) -> tuple[Floats, Floats]:
    """Steps or episodes (``progress``) that all seeds reached, [points]; a measure there, [points, seeds]."""
    points = [np.array([(r[progress], r[name]) for r in run if not np.isnan(r[name])]) for run in runs]
    points = [run for run in points if len(run)]
    first = max((run[0, 0] for run in points), default=np.inf)
    last = min((run[-1, 0] for run in points), default=-np.inf)
    if first > last:
        return np.full(_POINTS, np.nan), np.full((_POINTS, 1), np.nan)
    place = np.linspace(first, last, _POINTS)
    return place, np.stack([np.interp(place, *run.T) for run in points], -1)


def _known_norms(comparison: Comparison, task: str) -> dict[str, dict[int, Estimate]]:
    """J_norm by arm and number of the delay, where it is known."""
    found: dict[str, dict[int, Estimate]] = {}
    for x, delay in enumerate(comparison.delays(task)):
        for arm, compared in comparison.compared(task, delay).items():
            if not np.isnan(compared["J_norm"].value):
                found.setdefault(arm, {})[x] = compared["J_norm"]
    return found


def _error_bars(axis: Axes, known: Sequence[tuple[float, Estimate]], **style: Any) -> None:
    """Draw known estimates at their places; an infinite interval has no bar."""
    bars = np.array([(each.value - each.low, each.high - each.value) for _, each in known]).T
    places, values = zip(*((x, each.value) for x, each in known), strict=True)
    axis.errorbar(places, values, yerr=bars, markersize=4, **style)
