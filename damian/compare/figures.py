"""Figures of a comparison: learning curves, and J_norm of each method."""

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
from damian.compare.comparison import ENDS, HELD_OUT_MARK, NOT_LATE, Comparison, Method
from damian.compare.statistics import Floats, bootstrap
from damian.runs.run_folder import RANDOM, SCRIPT

Panel = TypeVar("Panel")

LABELS = {
    "hindsight_return": "return in hindsight",
    "perceived_success_rate": "success rate, perceived",
    "perceived_steps": "steps per episode, perceived",
}
"""Axis labels of the measures in training: in hindsight, from late data, or as the server perceived them."""
METHOD_COLOURS = (*COLOURS, "#332288", "#882255", "#117733", "#999933", "#44AA99", "#AA4499")
"""Colours of methods: after the usual ones, six of Paul Tol's muted ones."""
_POINTS = 200
"""Number of points of a learning curve."""
_LEVEL: dict[str, Any] = {"color": "0.5", "linestyle": "--", "linewidth": 0.8}
"""Style of lines at a reference."""


def plot_curves(comparison: Comparison, path: Path) -> None:
    """Draw learning curves over environment steps, in panels for each task and delay.

    There is one of the return and, where a task can succeed, of success rate and steps. A curve is the mean
    over seeds, with its 95 % band. Dashed lines: the random policy; dash-dotted: the undelayed script;
    dotted: methods that train nothing.
    """
    succeeds = comparison.points["perceived_success_rate"].notna().any()
    panels = [
        (task, delay, measure)
        for task in comparison.tasks()
        if HELD_OUT_MARK not in task
        for delay in comparison.delays(task) or [NOT_LATE]
        for measure in (LABELS if succeeds else ["hindsight_return"])  # else episodes end at their limit
    ]
    save(path, panels, partial(_curve_panel, comparison), (3.2, 2.6), width=3)


def plot_norms(comparison: Comparison, path: Path) -> None:
    """Draw J_norm of each method under each delay, with 95 % intervals, in a panel for each task with any."""
    known = comparison.table.dropna(subset="J_norm")
    methods = [name for name, method in comparison.methods.items() if method.delayed]
    styles = {name: look(comparison.methods, name) | {"linestyle": ""} for name in methods}

    def panel(axis: Axes, task: str) -> None:
        lines = known[known["task"] == task]
        draw_groups(axis, lines, ("delay", "method", "J_norm"), comparison.delays(task), styles, spread=0.7)
        title = task.replace(HELD_OUT_MARK, ", held-out ")
        axis.set(title=title, xlabel="delay", ylabel="J_norm (dashed: undelayed 1, random 0)")
        for level in (0, 1):
            axis.axhline(level, **_LEVEL)

    save(path, [*known["task"].unique()], panel, (3.0, 3.0), width=4, sharey=True)


def draw_groups(
    axis: Axes,
    lines: pd.DataFrame,
    columns: tuple[str, str, str],
    order: Sequence[str],
    styles: Mapping[str, dict[str, Any]],
    spread: float = 0.0,
) -> None:
    """Draw values with their intervals over places in order, for each group beside the others.

    ``columns`` of the lines have the place, the group and the value; an infinite interval has no bar.
    """
    place, group, name = columns
    for number, (label, style) in enumerate(styles.items()):
        own = lines[lines[group] == label].set_index(place)
        own = own.loc[[each for each in order if each in own.index]]
        shift = spread * ((number + 0.5) / len(styles) - 0.5)
        value, low, high = (own[name + end].to_numpy() for end in ENDS)
        places = [order.index(each) + shift for each in own.index]
        axis.errorbar(places, value, yerr=[value - low, high - value], markersize=4, label=label, **style)
    axis.set_xticks(range(len(order)), order)
    axis.set_xlim(-0.5, max(len(order), 1) - 0.5)


def look(methods: Mapping[str, Method], method: str) -> dict[str, Any]:
    """Style of a method by its place among all; dotted lines are of methods that train nothing."""
    trains = methods[method].policy_of is None and not methods[method].untrained
    return style_of([*methods].index(method)) | {"linestyle": "-" if trains else ":"}


def style_of(number: int) -> dict[str, Any]:
    """Colour, and a marker and a width, which tell from others of this colour."""
    again, colour = divmod(number, len(METHOD_COLOURS))
    return {
        "color": METHOD_COLOURS[colour],
        "marker": "os^D"[again % 4],
        "linewidth": (1.2, 2.0, 0.6)[again % 3],
    }


def save(
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
    """Draw a measure of all methods in a task under a delay."""
    task, delay, measure = content
    flown = "return" if measure == "hindsight_return" else measure  # of an evaluation, which knows the truth
    axis.set(xlabel="environment steps", ylabel=LABELS[measure], title=f"{task}, delay {delay}")
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    table = comparison.table.set_index(["task", "delay", "method", "policy"])[flown]
    for name, method in comparison.methods.items():
        run = (task, delay if method.delayed else NOT_LATE, name)
        style: dict[str, Any] = look(comparison.methods, name) | {"marker": "", "label": name}
        if run in comparison.curves:
            place, values = curve(comparison.curves[run], measure)
            mean, low, high = bootstrap(lambda drawn: drawn.mean(-1), values, draws=500)
            axis.plot(place, mean, **style)
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
