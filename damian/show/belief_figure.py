"""Figure of one flight: where the server believed the UAVs to be, beside where they truly were."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.ticker import MaxNLocator

from damian.show.episode import Episode, Floats

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours that colour-blind readers can also tell apart (Okabe and Ito, 2008)."""
STYLE: dict[Any, Any] = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}
"""Settings of Matplotlib for figures."""
DASHES = ("-", "--", ":", "-.")
MOST_PANELS = len(COLOURS)
"""Largest number of UAVs with a panel of their own; in a larger fleet the others are only on the map."""
_OTHERS = "0.6"
"""Grey of the UAVs without a panel."""

_WIDTH = 7.0
"""Width of the figure [inches], that of a page's text."""
_LARGE = 4
"""The map leaves out the border of a region that is more than this many times as large as the paths in it."""
_ASPECT = 1.5
"""Width of the map divided by its height."""
_OLD = "0.9"
"""Grey background of the steps at which the message that the server holds is old (age above 0)."""
_RIGHT_OF_AXES: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "frameon": False}
"""Placement of a legend."""


def plot_beliefs(flight: Episode, path: Path) -> None:
    """Draw a map, the east coordinate of each UAV and the ages of information, and save the figure."""
    instant = _instant_of_largest_error(flight)
    with matplotlib.rc_context(STYLE):
        figure, (map_axis, *time_axes) = _layout(min(flight.n_agents, MOST_PANELS))
        _draw_map(map_axis, flight, instant)
        for uav, axis in enumerate(time_axes[:-1]):
            _draw_panel(axis, flight, uav)
        _add_panel_legend(time_axes[0])
        _draw_ages(time_axes[-1], flight)
        _share_time_axis(figure, time_axes, float(flight.time[instant]))
        figure.savefig(path, dpi=200)


def _layout(n_panels: int) -> tuple[Figure, list[Axes]]:
    """Axes of map, panels and ages from top to bottom, with room for legends on the right."""
    # Height of each axes, and of the gap below it [inches].
    heights = [
        3.2,
        0.55,
        *[0.8, 0.3] * (n_panels - 1),
        0.8,
        0.45,
        0.8,
    ]
    margin_above, margin_below = 0.3, 0.45
    height = margin_above + sum(heights) + margin_below
    figure = Figure(figsize=(_WIDTH, height))
    grid = figure.add_gridspec(
        len(heights),
        height_ratios=heights,
        hspace=0,
        left=0.12,
        right=0.79,
        top=1 - margin_above / height,
        bottom=margin_below / height,
    )
    return figure, [figure.add_subplot(grid[row]) for row in range(0, len(heights), 2)]


def _instant_of_largest_error(flight: Episode) -> int:
    """Latest instant at which true and believed positions, summed over the UAVs, are furthest apart."""
    error = np.linalg.norm(flight.true - flight.believed, axis=-1).sum(-1)
    return int(np.flatnonzero(error == error.max())[-1])


def _draw_map(axis: Axes, flight: Episode, instant: int) -> None:
    """Draw the true paths and, at one instant, true and believed positions of the UAVs."""
    for ring in shapely.get_rings(shapely.get_parts(flight.region)):
        axis.plot(*shapely.get_coordinates(ring).T, "--", color="0.4", linewidth=0.8)
    for uav, colour in enumerate(_colours(flight)):
        true, believed = flight.true[instant, uav], flight.believed[instant, uav]
        axis.plot(*flight.true[:, uav].T, color=colour, linewidth=0.8, alpha=0.5)
        axis.add_patch(Circle(tuple(true), flight.radius, color=colour, alpha=0.12, linewidth=0))
        axis.plot(*np.stack([true, believed]).T, color="0.2", linewidth=0.8, zorder=3)
        axis.plot(*true, "o", color=colour, markersize=4.5, zorder=4)
        axis.plot(*believed, "o", color=colour, markerfacecolor="none", markersize=9, zorder=4)
    if flight.source is not None:
        axis.plot(*flight.source.T, color="black", linewidth=0.8, linestyle=":")
        axis.plot(*flight.source[instant], "*", color="black", markersize=10, zorder=5)
    _zoom(axis, _shown_positions(flight), flight.radius)
    has_error = not np.array_equal(flight.true[instant], flight.believed[instant])
    reason = ", when the server is most mistaken" if has_error else ""
    axis.set_title(f"paths, and the UAVs at {flight.time[instant]:g} s{reason}", fontsize="medium")
    _add_map_legend(axis, flight)


def _shown_positions(flight: Episode) -> Floats:
    """Positions that the map shows, [P, 2]: the paths, and the whole region unless they are small in it."""
    source = [] if flight.source is None else [flight.source]
    paths = np.concatenate([flight.true.reshape(-1, 2), *source])
    corners = np.reshape(shapely.bounds(flight.region), (2, 2))
    small = np.ptp(corners, axis=0).max() > _LARGE * (np.ptp(paths, axis=0).max() + 2 * flight.radius)
    return paths if small else np.concatenate([paths, corners])


def _zoom(axis: Axes, positions: Floats, margin: float) -> None:
    """Fit the axes around positions [P, 2] and a margin [m], with equal scales in both directions."""
    low, high = positions.min(0) - margin, positions.max(0) + margin
    middle, size = (low + high) / 2, high - low
    half = np.array([_ASPECT, 1.0]) * max(size[0] / _ASPECT, size[1]) / 2
    (west, south), (east, north) = middle - half, middle + half
    axis.set(xlim=(west, east), ylim=(south, north), xlabel="east [m]", ylabel="north [m]")
    axis.set_aspect("equal")


def _add_map_legend(axis: Axes, flight: Episode) -> None:
    """Explain the colours of the UAVs, and the marks."""
    colours = _colours(flight)
    named = zip(flight.names, colours[:MOST_PANELS], strict=False)
    uavs = [_legend_entry(name, color=colour) for name, colour in named]
    uavs += [_legend_entry("other UAVs", color=_OTHERS)] if len(colours) > MOST_PANELS else []
    source = _legend_entry("source", marker="*", linestyle="", color="black", markersize=8)
    marks = [
        _legend_entry("true", marker="o", linestyle="", markersize=4.5),
        _legend_entry("believed", marker="o", linestyle="", markersize=9, markerfacecolor="none"),
        *([] if flight.source is None else [source]),
        Patch(color="0.3", alpha=0.15, linewidth=0, label=f"footprint ({flight.radius:.0f} m)"),
        _legend_entry("border", color="0.4", linewidth=0.8, linestyle="--"),
    ]
    axis.legend(handles=uavs + marks, **_RIGHT_OF_AXES)


def _legend_entry(label: str, color: str = "0.3", **style: Any) -> Line2D:
    return Line2D([], [], label=label, color=color, **style)


def _draw_panel(axis: Axes, flight: Episode, uav: int) -> None:
    """Draw the true and believed east coordinates of a UAV, with its arrived and lost messages."""
    time, colour = flight.time, _colours(flight)[uav]
    is_old, time_by_height = flight.age[:-1, uav] > 0, axis.get_xaxis_transform()
    axis.stairs(is_old, time, fill=True, transform=time_by_height, color=_OLD)
    axis.step(time, flight.believed[:, uav, 0], where="post", color=colour, linewidth=2.2)
    style = "steps-post" if flight.instant else "default"
    axis.plot(time, flight.true[:, uav, 0], color="black", linewidth=0.8, drawstyle=style)
    for flags, mark, mark_colour in ((flight.arrived, ".", colour), (flight.lost, "x", "black")):
        times = time[flags[:, uav]]
        height = np.full_like(times, -0.08)
        axis.plot(
            times, height, mark, color=mark_colour, markersize=3.5, transform=time_by_height, clip_on=False
        )
    axis.set_ylabel(f"{flight.names[uav]}\neast [m]")
    axis.yaxis.set_major_locator(MaxNLocator(3))


def _add_panel_legend(axis: Axes) -> None:
    """Explain the lines and marks of the panels."""
    handles = [
        _legend_entry("true", color="black", linewidth=0.8),
        _legend_entry("believed", linewidth=2.2),
        Patch(color=_OLD, linewidth=0, label="message is old"),
        _legend_entry("message arrives", marker=".", linestyle=""),
        _legend_entry("message is lost", marker="x", linestyle="", color="black", markersize=3.5),
    ]
    axis.legend(handles=handles, **_RIGHT_OF_AXES)


def _draw_ages(axis: Axes, flight: Episode) -> None:
    """Draw the age of information of the UAVs with a panel."""
    for uav, colour in enumerate(_colours(flight)[:MOST_PANELS]):
        dashes = DASHES[uav % len(DASHES)]
        axis.step(flight.time, flight.age[:, uav], dashes, where="post", color=colour, linewidth=1.2)
    axis.set_ylabel("age of\nmessage [s]")
    axis.set_ylim(0, 1.1 * float(flight.age.max()) or 1.0)
    axis.yaxis.set_major_locator(MaxNLocator(3))
    axis.set_title(f"mean age {flight.age.mean():.2f} s", fontsize="medium")


def _share_time_axis(figure: Figure, time_axes: Sequence[Axes], instant: float) -> None:
    """Label the time axis of the lowest axes only, and mark the instant [s] that the map shows in all."""
    for axis in time_axes:
        axis.axvline(instant, color="0.2", linewidth=0.8, linestyle=":")
        axis.tick_params(labelbottom=axis is time_axes[-1])
        axis.margins(x=0.01)
    time_axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(time_axes)


def _colours(flight: Episode) -> list[str]:
    """Colour of each UAV; those without a panel are grey."""
    return [*COLOURS, *[_OTHERS] * flight.n_agents][: flight.n_agents]
