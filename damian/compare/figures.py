"""Figures of a comparison: learning curves, J_norm of each arm, and the matrix of held-out tasks."""

import math
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
from damian.compare.comparison import ENDS, HELD_OUT_MARK, NOT_LATE, Arm, Comparison
from damian.compare.statistics import Floats, bootstrap
from damian.runs.run_folder import RANDOM, SCRIPT

Panel = TypeVar("Panel")

LABELS = {
    "hindsight_return": "return in hindsight",
    "perceived_success_rate": "success rate, perceived",
    "perceived_steps": "steps per episode, perceived",
}
"""Axis labels of the measures in training: in hindsight, from late data, or as the server perceived them."""
ARM_COLOURS = (*COLOURS, "#332288", "#882255", "#117733", "#999933", "#44AA99", "#AA4499")
"""Colours of arms: after the usual ones, six of Paul Tol's muted ones."""
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
    """Draw learning curves over environment steps, in panels for each task and delay.

    There is one of the return and, where a task can succeed, of success rate and steps. A curve is the mean
    over seeds, with its 95 % band. Dashed lines: the random policy; dash-dotted: the undelayed script;
    dotted: arms that train nothing.
    """
    succeeds = comparison.points["perceived_success_rate"].notna().any()
    panels = [
        (task, delay, measure)
        for task in comparison.tasks()
        if HELD_OUT_MARK not in task
        for delay in comparison.delays(task) or [NOT_LATE]
        for measure in (LABELS if succeeds else ["hindsight_return"])  # else episodes end at their limit
    ]
    _save(path, panels, partial(_curve_panel, comparison), (3.2, 2.6), width=3)


def plot_norms(comparison: Comparison, path: Path) -> None:
    """Draw J_norm of each arm under each delay, with 95 % intervals, in a panel for each task with any."""
    known = comparison.table.dropna(subset="J_norm")
    arms = [name for name, arm in comparison.arms.items() if arm.delayed]

    def panel(axis: Axes, task: str) -> None:
        delays = comparison.delays(task)
        for arm, lines in known[known["task"] == task].groupby("arm", sort=False):
            shift = 0.7 * ((arms.index(str(arm)) + 0.5) / len(arms) - 0.5)
            places = [delays.index(delay) + shift for delay in lines["delay"]]
            style = look(comparison.arms, str(arm)) | {"label": arm, "linestyle": ""}
            _error_bars(axis, places, lines, "J_norm", **style)
        axis.set_xticks(range(len(delays)), delays)
        title = task.replace(HELD_OUT_MARK, ", held-out ")
        axis.set(title=title, xlabel="delay", ylabel="J_norm (dashed: undelayed 1, random 0)")
        axis.set_xlim(-0.5, max(len(delays), 1) - 0.5)
        for level in (0, 1):
            axis.axhline(level, **_LEVEL)

    _save(path, [*known["task"].unique()], panel, (3.0, 3.0), width=4, sharey=True)


def plot_matrix(comparison: Comparison, path: Path) -> None:
    """Draw the scores of policies over the held-out delays under which they flew, a line for each training.

    Held-out tasks of delays have names that begin with ``delay_``; a policy must have flown under four.
    Dashed, an arm that was trained at several constant delays: at each one, the policies trained there.
    """
    drawn = {task: found for task in comparison.tasks() if (found := _matrix(comparison, task))}

    def panel(axis: Axes, task: str) -> None:
        names = sorted({name for lines in drawn[task].values() for name in lines.index}, key=_delay_order)
        for number, (label, lines) in enumerate(drawn[task].items()):
            line = "--" if label.endswith(_SPECIALISTS) else "-"
            in_order = lines.loc[[name for name in names if name in lines.index]]
            places = [names.index(name) for name in in_order.index]
            _error_bars(
                axis, places, in_order, comparison.score, label=label, linestyle=line, **_style(number)
            )
        axis.set_xticks(range(len(names)), names, rotation=90)
        axis.set(title=task, xlabel="delay of the flight [steps], or its law", ylabel=comparison.score)

    _save(path, [*drawn], panel, (6.4, 3.6))


def _matrix(comparison: Comparison, task: str) -> dict[str, pd.DataFrame]:
    """Lines of the figure of a task by their labels: lines of the table, by the delay of the flight."""
    table = comparison.table[comparison.table["policy"] == comparison.policy]
    held_out = f"{task}{HELD_OUT_MARK}{_DELAY}"
    away = table[table["task"].str.startswith(held_out)]
    away = away.set_index(away["task"].str.removeprefix(held_out))
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
        for place, (policy, lines) in enumerate(table.groupby("policy", sort=False)):
            shift = 0.5 * ((place + 0.5) / len(policies) - 0.5)
            rows = [groups.index(group) + shift for group in lines["group"]]
            value, low, high = (lines[name + end].to_numpy() for end in ENDS)
            ends = np.nan_to_num([value - low, high - value])
            axis.errorbar(value, rows, xerr=ends, fmt="o", color=ARM_COLOURS[place], label=policy)
        axis.set_yticks(range(len(groups)), groups)
        axis.invert_yaxis()
        axis.set_xlabel(name)

    _save(path, [None], panel, (5.2, 0.4 * len(groups) + 1.4))


def look(arms: Mapping[str, Arm], arm: str) -> dict[str, Any]:
    """Style of an arm by its place among all; dotted lines are of arms that train nothing."""
    style, again = _style([*arms].index(arm)), [*arms].index(arm) // len(ARM_COLOURS)
    trains = arms[arm].policy_of is None and not arms[arm].untrained
    lines = _LINES if trains else _DOTTED
    return style | {"linestyle": lines[again % len(lines)]}


def _style(number: int) -> dict[str, str]:
    """Colour, and a marker, which tells from others of this colour."""
    again, colour = divmod(number, len(ARM_COLOURS))
    return {"color": ARM_COLOURS[colour], "marker": _MARKERS[again % len(_MARKERS)]}


def _save(
    path: Path,
    panels: Sequence[Panel],
    draw: Callable[[Axes, Panel], None],
    size: tuple[float, float],
    width: int = 1,
    sharey: bool = False,
) -> None:
    """Draw panels of this size [inches] in rows of ``width``, with one legend to the right of them."""
    if not panels:
        path.unlink(missing_ok=True)  # an older one would show other runs
        return
    width = min(width, len(panels))
    height = math.ceil(len(panels) / width)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(size[0] * width + 1.2, size[1] * height), layout="constrained")
        axes = figure.subplots(height, width, squeeze=False, sharey=sharey).flat
        drawn: dict[str, Any] = {}
        for axis, panel in zip(axes, panels, strict=False):
            draw(axis, panel)
            drawn |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
        for axis in axes[len(panels) :]:
            axis.set_axis_off()
        figure.legend([*drawn.values()], [*drawn], loc="outside right upper", frameon=False)
        figure.savefig(path, dpi=150)


def _curve_panel(comparison: Comparison, axis: Axes, content: tuple[str, str, str]) -> None:
    """Draw a measure of all arms in a task under a delay."""
    task, delay, measure = content
    flown = "return" if measure == "hindsight_return" else measure  # of an evaluation, which knows the truth
    axis.set(xlabel="environment steps", ylabel=LABELS[measure], title=f"{task}, delay {delay}")
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    table = comparison.table.set_index(["task", "delay", "arm", "policy"])[flown]
    for name, arm in comparison.arms.items():
        run = (task, delay if arm.delayed else NOT_LATE, name)
        style: dict[str, Any] = look(comparison.arms, name) | {"marker": "", "label": name}
        if run in comparison.curves:
            place, values = curve(comparison.curves[run], measure)
            mean, low, high = bootstrap(lambda v: v.mean(-1)[..., 0, :], values[None], draws=500)
            axis.plot(place, mean, linewidth=1.2, **style)
            axis.fill_between(place, low, high, color=style["color"], alpha=0.2, linewidth=0)
        elif (level := table.get((*run, comparison.policy_of(name)))) is not None:
            axis.axhline(level, **style)
    for policy, label, line in ((RANDOM, RANDOM, "--"), (SCRIPT, f"{SCRIPT}, undelayed", "-.")):
        if (level := table.get((task, NOT_LATE, policy, policy))) is not None:
            style = _LEVEL | {"label": label, "linestyle": line}
            axis.axhline(level, **style)


def curve(runs: Sequence[pd.DataFrame], name: str) -> tuple[Floats, Floats]:
    """Environment steps that all seeds reached, [points]; a measure there, [points, seeds]."""
    points = [run[["frames", name]].dropna(subset=name).to_numpy() for run in runs]
    points = [run for run in points if len(run)]
    first = max((run[0, 0] for run in points), default=np.inf)
    last = min((run[-1, 0] for run in points), default=-np.inf)
    if first > last:
        return np.full(_POINTS, np.nan), np.full((_POINTS, 1), np.nan)
    place = np.linspace(first, last, _POINTS)
    return place, np.stack([np.interp(place, run[:, 0], run[:, 1]) for run in points], -1)


def _error_bars(axis: Axes, places: Sequence[float], lines: pd.DataFrame, name: str, **style: Any) -> None:
    """Draw a column of a comparison's table at these places; an infinite interval has no bar."""
    value, low, high = (lines[name + end].to_numpy() for end in ENDS)
    axis.errorbar(places, value, yerr=[value - low, high - value], markersize=4, **style)
