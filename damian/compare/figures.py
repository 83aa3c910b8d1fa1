"""Figures of a comparison: learning curves, J_norm of each arm, and the matrix of held-out tasks."""

import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from damian.common.plotting import COLOURS, STYLE
from damian.compare.comparison import (
    ENDS,
    HELD_OUT_MARK,
    MEASURED,
    NOT_LATE,
    Arm,
    Comparison,
)
from damian.compare.statistics import Floats, bootstrap
from damian.runs.run_folder import RANDOM, SCRIPT, TRAINED

Panel = TypeVar("Panel")

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
_SPECIALISTS = ", trained at each delay"
"""End of the label of a line of policies that fly under the delay at which they were trained."""
_LEVEL: dict[str, Any] = {"color": "0.5", "linestyle": "--", "linewidth": 0.8}
"""Style of lines at a reference."""


def plot_curves(comparison: Comparison, path: Path) -> None:
    """Draw learning curves over environment steps; over episodes if the runs made different numbers of steps.

    One task has a row of panels for each delay, with return and, where it can succeed, success rate and
    steps; of several tasks, each has a row with its returns under each delay, or, under one delay, a panel.
    A curve is the mean over seeds, with its 95 % band. Dashed lines: the random policy; dash-dotted: the
    undelayed script; dotted: arms that train nothing.
    """
    grid = [row for row in _panels(comparison) if row]
    if all(len(row) == 1 for row in grid):
        grid = _rows([panel for (panel,) in grid], 2)
    ends = [run["frames"].iloc[-1] for runs in comparison.curves.values() for run in runs] or [0]
    progress = "frames" if min(ends) > 0.95 * max(ends) else "episodes"  # batches end a little later
    _save(path, grid, partial(_curve_panel, comparison, progress), (3.2, 2.6))


def plot_norms(comparison: Comparison, path: Path) -> None:
    """Draw J_norm of each arm under each delay, with 95 % intervals, in a panel for each task with any."""
    known = comparison.table.dropna(subset="J_norm")
    grid = _rows([*known["task"].unique()], 4)
    arms = [name for name, arm in comparison.arms.items() if arm.delayed]

    def panel(axis: Axes, task: str) -> None:
        delays = comparison.delays(task)
        of_task = known[known["task"] == task]
        for arm in [arm for arm in arms if arm in {*of_task["arm"]}]:
            lines = of_task[of_task["arm"] == arm]
            shift = 0.7 * ((arms.index(arm) + 0.5) / len(arms) - 0.5)
            places = [delays.index(delay) + shift for delay in lines["delay"]]
            style = look(comparison.arms, arm) | {"label": arm, "linestyle": ""}
            _error_bars(axis, places, lines, "J_norm", **style)
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
    Dashed, an arm that was trained at several constant delays: at each one, the policies trained there.
    """
    drawn = {task: found for task in comparison.tasks() if (found := _matrix(comparison, task))}

    def panel(axis: Axes, task: str) -> None:
        names = sorted({name for lines in drawn[task].values() for name in lines.index}, key=_delay_order)
        for number, (label, lines) in enumerate(drawn[task].items()):
            style = {
                "color": ARM_COLOURS[number % len(ARM_COLOURS)],
                "marker": _MARKERS[number % len(_MARKERS)],
            }
            style["linestyle"] = "--" if label.endswith(_SPECIALISTS) else "-"
            in_order = lines.loc[[name for name in names if name in lines.index]]
            places = [names.index(name) for name in in_order.index]
            _error_bars(axis, places, in_order, comparison.score, label=label, linewidth=1.2, **style)
        axis.set_xticks(range(len(names)), names, rotation=90)
        axis.set(title=task, xlabel="delay of the flight [steps], or its law", ylabel=comparison.score)

    _save(path, [[task] for task in drawn], panel, (6.4, 3.6))


def _matrix(comparison: Comparison, task: str) -> dict[str, pd.DataFrame]:
    """Lines of the figure of a task by their labels: lines of the table, by the delay of the flight."""
    table = comparison.table[comparison.table["policy"] == comparison.policy]
    away = table[table["task"].str.startswith(f"{task}{HELD_OUT_MARK}{_DELAY}")]
    away = away.set_index(away["task"].str.removeprefix(f"{task}{HELD_OUT_MARK}{_DELAY}"))
    drawn = {
        f"{arm}, trained at {delay}": lines
        for (delay, arm), lines in away.groupby(["delay", "arm"], sort=False)
        if len(lines) >= _FLOWN
    }
    constant = [name for name in away.index.unique() if name.isdecimal()]
    trained = [name for name, arm in comparison.arms.items() if arm.policy_of is None]
    own = table[(table["task"] == task) & table["delay"].isin(constant) & table["arm"].isin(trained)]
    of_arms = own.set_index("delay", drop=False).groupby("arm", sort=False)
    special = {f"{arm}{_SPECIALISTS}": lines for arm, lines in of_arms if len(lines) > 1}
    return drawn | special if drawn else {}


def _delay_order(name: str) -> tuple[bool, int, str]:
    """Constant delays by their number of steps, then laws."""
    return (False, int(name), "") if name.isdecimal() else (True, 0, name)


def plot_means(table: pd.DataFrame, name: str, path: Path) -> None:
    """Draw a column of a table with a line for each group of runs and policy: a row for each group."""
    groups, policies = table["group"].unique().tolist(), table["policy"].unique().tolist()

    def panel(axis: Axes, _: None) -> None:
        for place, policy in enumerate(policies):
            lines = table[table["policy"] == policy]
            shift = 0.5 * ((place + 0.5) / len(policies) - 0.5)
            rows = [groups.index(group) + shift for group in lines["group"]]
            value, low, high = (lines[name + end].to_numpy() for end in ENDS)
            ends = np.nan_to_num([value - low, high - value])
            axis.errorbar(value, rows, xerr=ends, fmt="o", color=colour_of(policy), label=policy)
        axis.set_yticks(range(len(groups)), groups)
        axis.invert_yaxis()
        axis.set_xlabel(name)

    _save(path, [[None]], panel, (5.2, 0.4 * len(groups) + 1.4))


def look(arms: Mapping[str, Arm], arm: str) -> dict[str, Any]:
    """Colour of an arm; line and marker, which tell it from those before it that have the same colour."""
    before = [*arms][: [*arms].index(arm)]
    again, of_arm = sum(colour_of(other) == colour_of(arm) for other in before), arms[arm]
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


def _panels(comparison: Comparison) -> list[list[tuple[str, str, str]]]:
    """Task, delay and measure of each panel, by rows."""
    tasks = [task for task in comparison.tasks() if HELD_OUT_MARK not in task]
    delays = {task: comparison.delays(task) or [NOT_LATE] for task in tasks}
    if len(tasks) > 1:
        return [[(task, delay, "hindsight_return") for delay in delays[task]] for task in tasks]
    succeeds = comparison.points["perceived_success_rate"].notna().any()
    measures = [*LABELS] if succeeds else ["hindsight_return"]  # else episodes end at their limit
    return [[(task, delay, name) for name in measures] for task in tasks for delay in delays[task]]


def _curve_panel(comparison: Comparison, progress: str, axis: Axes, content: tuple[str, str, str]) -> None:
    """Draw all arms in a panel of ``_panels``."""
    task, delay, measure = content
    flown = "return" if measure == "hindsight_return" else measure  # of an evaluation, which knows the truth
    axis.set(xlabel=PROGRESS[progress], ylabel=LABELS[measure], title=f"{task}, delay {delay}")
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    table = comparison.table.set_index(["task", "delay", "arm", "policy"])[flown]
    for name, arm in comparison.arms.items():
        run = (task, delay if arm.delayed else NOT_LATE, name)
        style: dict[str, Any] = look(comparison.arms, name) | {"marker": "", "label": name}
        if run in comparison.curves:
            place, values = curve(comparison.curves[run], measure, progress)
            mean, low, high = bootstrap(
                lambda v: v.mean(-1)[..., 0, :], values[None], draws=500, bounds=MEASURED[flown][1:]
            )
            axis.plot(place, mean, linewidth=1.2, **style)
            axis.fill_between(place, low, high, color=style["color"], alpha=0.2, linewidth=0)
        elif (level := table.get((*run, comparison.policy_of(name)))) is not None:
            axis.axhline(level, **style)
    for policy, label, line in ((RANDOM, RANDOM, "--"), (SCRIPT, f"{SCRIPT}, undelayed", "-.")):
        if (level := table.get((task, NOT_LATE, policy, policy))) is not None:
            style = _LEVEL | {"label": label, "linestyle": line}
            axis.axhline(level, **style)


def curve(runs: Sequence[pd.DataFrame], name: str, progress: str = "frames") -> tuple[Floats, Floats]:
    """Steps or episodes (``progress``) that all seeds reached, [points]; a measure there, [points, seeds]."""
    points = [run[[progress, name]].dropna(subset=name).to_numpy() for run in runs]
    points = [run for run in points if len(run)]
    first = max((run[0, 0] for run in points), default=np.inf)
    last = min((run[-1, 0] for run in points), default=-np.inf)
    if first > last:
        return np.full(_POINTS, np.nan), np.full((_POINTS, 1), np.nan)
    place = np.linspace(first, last, _POINTS)
    return place, np.stack([np.interp(place, *run.T) for run in points], -1)


def _error_bars(axis: Axes, places: Sequence[float], lines: pd.DataFrame, name: str, **style: Any) -> None:
    """Draw a column of a comparison's table at these places; an infinite interval has no bar."""
    value, low, high = (lines[name + end].to_numpy() for end in ENDS)
    axis.errorbar(places, value, yerr=[value - low, high - value], markersize=4, **style)
