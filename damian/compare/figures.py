"""Figures of trainings and comparisons: learning curves, and scores with intervals."""

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

from damian.common.plotting import STYLE, save_figure
from damian.compare.comparison import ENDS, HELD_OUT_MARK, NOT_LATE, Comparison, Method, sign_of
from damian.compare.statistics import Floats, bootstrap
from damian.runs.metrics import Evaluation
from damian.runs.run_folder import RANDOM, SCRIPT, TRAINED, UNTRAINED

Panel = TypeVar("Panel")
Style = dict[str, Any]
"""Arguments of Matplotlib."""

LABELS = {
    "hindsight_return": "return in hindsight",
    "perceived_success_rate": "success rate, perceived",
    "perceived_steps": "steps per episode, perceived",
}
"""Axis labels of the measures in training: in hindsight, from late data, or as the server perceived
them."""
METHOD_COLOURS = (
    "#0F3C2D",
    "#E15A00",
    "#4B96FF",
    "#A5000F",
    "#5A9696",
    "#FFA500",
    "#873C96",
    "#1E2DFF",
    "#FF87FF",
    "#0000A5",
)
"""Colours of methods: each pair is far apart in OKLab, for readers without green receptors too."""
_POINTS = 200
"""Number of points of a learning curve."""
_LINE = ["task", "delay", "method", "policy"]
"""Columns that name a line of the table of a comparison."""
_LEVEL: Style = {"color": "0.5", "linestyle": "--", "linewidth": 0.8}
"""Style of lines at a reference."""


def plot_training(
    rows: Sequence[Mapping[str, float]],
    evaluations: Mapping[str, Evaluation],
    path: Path,
    title: str,
) -> None:
    """Draw return and success rate of a training, from the untrained policy on."""
    table = pd.DataFrame(rows).set_index("frames")

    def panel(axis: Axes, measure: str) -> None:
        flown = _flown(measure)
        levels = {policy: row[flown] for policy, row in evaluations.items()}
        untrained = pd.Series({0: levels[UNTRAINED]})
        points = pd.concat([untrained, table[measure].dropna()])
        axis.plot(points, color=METHOD_COLOURS[2], marker="o", markevery=[0], label="training")
        _over_steps(axis, measure, levels, SCRIPT)
        axis.set(title=title)

    # In hindsight, which is close to what truly happened; what is perceived may rank policies
    # wrongly.
    succeeds = (table["perceived_success_rate"] > 0).any()
    measures = [*LABELS][: 1 + succeeds]
    save(path, measures, panel, (4.4, 3.2), width=2)


def plot_curves(comparison: Comparison, path: Path) -> None:
    """Draw learning curves over environment steps, in panels for each task and delay.

    There is one of the return and, where a task can succeed, of success rate and steps. A curve is
    the mean over seeds, with its 95 % band. Dashed lines: the random policy; dash-dotted: the
    undelayed script;
    dotted: methods without a curve, such as those that train nothing.
    """
    succeeds = comparison.points["perceived_success_rate"].notna().any()
    # Without success, episodes end at their limit.
    measures = LABELS if succeeds else ["hindsight_return"]
    trained = {run[:2] for run in comparison.curves}
    panels = [
        (*place, measure)
        for place in _places(comparison, [NOT_LATE])
        if trained & {place, (place[0], NOT_LATE)}
        for measure in measures
    ]
    save(path, panels, partial(_curve_panel, comparison), (3.2, 2.6), width=3)


def plot_scores(comparison: Comparison, path: Path) -> None:
    """Draw the score of each method with its 95 % interval, in a panel for each task and delay.

    Dashed: the undelayed method; dotted: random actions; shaded: what the delay costs the strongest
    naive method. Held-out tasks are in the table only.
    """
    score = comparison.score
    columns = [score + end for end in ENDS]
    scores = comparison.table.set_index(_LINE)[columns].astype(float)
    estimates = dict(zip(scores.index, scores.to_numpy(), strict=True))
    methods = comparison.methods
    undelayed = comparison.undelayed
    policies = {name: comparison.policy_of(name) for name in methods} | {SCRIPT: SCRIPT}

    def panel(axis: Axes, place: tuple[str, str]) -> None:
        task, delay = place
        lines = {name: (task, delay, name, policy) for name, policy in policies.items()}
        shown = [name for name, line in lines.items() if line in estimates]
        naive = []
        for row, name in enumerate(shown):
            value, low, high = estimates[lines[name]]
            error = np.nan_to_num([[value - low], [high - value]], posinf=0.0)
            style: Style = {"color": "0.5", "marker": "o"}
            if name != SCRIPT:
                style |= look(methods, name)
                naive += [value] if methods[name].naive else []
            axis.errorbar([value], [row], xerr=error, markersize=4, **style)
        for name, policy, dashes in ((undelayed, TRAINED, "--"), (RANDOM, RANDOM, ":")):
            line = (task, NOT_LATE, name, policy)
            if line not in estimates:
                continue
            level = estimates[line][0]
            style = _LEVEL | {"linestyle": dashes}
            axis.axvline(level, **style)
            if name == undelayed and naive:
                best = min(naive) if sign_of(score) < 0 else max(naive)
                axis.axvspan(best, level, color="0.92", zorder=0)
        axis.set_yticks(range(len(shown)), shown)
        axis.invert_yaxis()
        axis.set(title=f"{task}, delay {delay}", xlabel=score)

    save(path, _places(comparison), panel, (3.4, 2.8), width=3)


def look(methods: Mapping[str, Method], method: str) -> Style:
    """Style of a method by its place among all; dotted lines are of methods that train nothing."""
    again, colour = divmod([*methods].index(method), len(METHOD_COLOURS))
    trains = methods[method].policy_of is None and not methods[method].flies
    return {
        "color": METHOD_COLOURS[colour],
        "marker": "os^D"[again % 4],
        "linewidth": (1.2, 2.0, 0.6)[again % 3],
        "linestyle": "-" if trains else ":",
    }


def save(
    path: Path,
    panels: Sequence[Panel],
    draw: Callable[[Axes, Panel], None],
    size: tuple[float, float],
    width: int,
) -> None:
    """Draw panels of this size [inches] in rows of ``width``, with one legend to the right of
    them."""
    if not panels:
        path.unlink(missing_ok=True)  # an older one would show other runs
        return
    width = min(width, len(panels))
    height = math.ceil(len(panels) / width)
    with matplotlib.rc_context(STYLE):
        whole = (size[0] * width + 1.2, size[1] * height)
        figure = Figure(figsize=whole, layout="constrained")
        axes = figure.subplots(height, width, squeeze=False).flat
        drawn: Style = {}
        for axis, panel in zip(axes, panels, strict=False):
            draw(axis, panel)
            handles, labels = axis.get_legend_handles_labels()
            drawn |= zip(labels, handles, strict=True)
        for axis in axes[len(panels) :]:
            axis.set_axis_off()
        if drawn:
            figure.legend([*drawn.values()], [*drawn], loc="outside right upper", frameon=False)
        save_figure(figure, path, dpi=150)


def _curve_panel(comparison: Comparison, axis: Axes, content: tuple[str, str, str]) -> None:
    """Draw a measure of all methods in a task under a delay."""
    task, delay, measure = content
    table = comparison.table.set_index(_LINE)[_flown(measure)]
    best = _best(comparison)
    for name, method in comparison.methods.items():
        run = (task, delay if method.delayed else NOT_LATE, name)
        style: Style = look(comparison.methods, name) | {"marker": "", "label": name}
        if name not in best:
            style["color"] = "0.75"
        if run in comparison.curves:
            place, values = curve(comparison.curves[run], measure)
            mean, low, high = bootstrap(lambda drawn: drawn.mean(-1), values, draws=500)
            axis.plot(place, mean, **style)
            axis.fill_between(place, low, high, color=style["color"], alpha=0.2, linewidth=0)
        elif (level := table.get((*run, comparison.policy_of(name)))) is not None:
            style |= {"linestyle": ":"}
            axis.axhline(level, **style)
    levels = {policy: table.get((task, NOT_LATE, policy, policy)) for policy in (RANDOM, SCRIPT)}
    _over_steps(axis, measure, levels, f"{SCRIPT}, undelayed")
    axis.set(title=f"{task}, delay {delay}")


def _places(comparison: Comparison, undelayed: Sequence[str] = ()) -> list[tuple[str, str]]:
    """Tasks but held-out ones, with each of their delays; ``undelayed`` where a task has none."""
    tasks = [task for task in comparison.tasks() if HELD_OUT_MARK not in task]
    return [(task, delay) for task in tasks for delay in comparison.delays(task) or undelayed]


def _best(comparison: Comparison) -> set[str]:
    """The six methods of the best mean score, whose learning curves are coloured."""
    lines = comparison.table.set_index(["method", "policy"])[comparison.score]
    own = lines[lines.index.isin([(n, comparison.policy_of(n)) for n in comparison.methods])]
    means = own.groupby("method").mean() * sign_of(comparison.score)
    return {*means.nlargest(6).index}


def _flown(measure: str) -> str:
    """The measure of an evaluation, which knows the truth, that a measure in training comes close
    to."""
    return "return" if measure == "hindsight_return" else measure


def _over_steps(axis: Axes, measure: str, levels: Mapping[str, float | None], script: str) -> None:
    """Name the axes of learning curves, and draw the levels of the policies that learn nothing."""
    axis.set(xlabel="environment steps", ylabel=LABELS[measure])
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    for policy, label, line in ((RANDOM, RANDOM, "--"), (SCRIPT, script, "-.")):
        if (level := levels.get(policy)) is not None:  # a region may be too large for the script
            style: Style = _LEVEL | {"label": label, "linestyle": line}
            axis.axhline(level, **style)


def curve(runs: Sequence[pd.DataFrame], name: str) -> tuple[Floats, Floats]:
    """Environment steps that all seeds reached, [points]; a measure there, [points, seeds]."""
    tables = [run[["frames", name]].dropna(subset=name) for run in runs]
    points = [table.to_numpy().T for table in tables if len(table)]
    first = max((frames[0] for frames, _ in points), default=np.inf)
    last = min((frames[-1] for frames, _ in points), default=-np.inf)
    if first > last:
        return np.full(_POINTS, np.nan), np.full((_POINTS, 1), np.nan)
    place = np.linspace(first, last, _POINTS)
    values = [np.interp(place, frames, value) for frames, value in points]
    return place, np.stack(values, -1)
