"""What the server believed of the UAVs during a flight, drawn beside what was true."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

matplotlib.use("Agg")

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Told apart by the colour-blind too (Okabe and Ito, 2008)."""
DASHES = ("-", "--", ":", "-.")
MOST_PANELS = 6
"""UAVs with a panel of their own; of a larger fleet the others are on the map only."""

Floats = NDArray[np.floating]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Beliefs:
    """One flight of N UAVs over T steps, and T + 1 instants."""

    time: Floats
    """[s], [T + 1]."""
    true: Floats
    """East, north [m], [T + 1, N, 2]."""
    believed: Floats
    """East, north [m], [T + 1, N, 2]."""
    age: Floats
    """Of what is believed [s], [T + 1, N]."""
    arrived: Flags
    """Did a message arrive just now, [T + 1, N]."""
    lost: Flags
    """Was a message sent just now that will never arrive, [T + 1, N]."""
    source: Floats
    """East, north [m], [T + 1, 2]."""
    region: shapely.Polygon | shapely.MultiPolygon
    """Where the UAVs fly."""
    radius: float
    """Within which a UAV hears the source [m]."""
    jumps: bool
    """Is a UAV at its target as soon as a step ends."""


def plot_beliefs(flight: Beliefs, path: Path) -> None:
    """Draw a map, the east coordinate of each UAV, and the ages."""
    from matplotlib import pyplot as plt  # noqa: PLC0415 (slow to import, needed once)

    n_panels = min(flight.true.shape[1], MOST_PANELS)
    heights = [3.4, *[0.95] * n_panels, 1.0]
    worst = int(flight.age.sum(-1).argmax())
    with plt.rc_context({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}):
        figure = plt.figure(figsize=(7.0, 0.6 + sum(heights)), layout="constrained")
        rows = figure.add_gridspec(len(heights), 1, height_ratios=heights)
        _map(figure.add_subplot(rows[0]), flight, worst)
        below = [figure.add_subplot(rows[1])]
        below += [figure.add_subplot(row, sharex=below[0]) for row in list(rows)[2:]]
        for uav, axis in enumerate(below[:-1]):
            _panel(axis, flight, uav)
        _ages(below[-1], flight)
        _share_time(figure, below, flight, worst)
        figure.savefig(path, dpi=200)
        plt.close(figure)


def _map(axis: Axes, flight: Beliefs, worst: int) -> None:
    """True paths; at the instant of the worst belief, where the UAVs are and where they are believed."""
    for ring in shapely.get_rings(shapely.get_parts(flight.region)):
        axis.plot(*shapely.get_coordinates(ring).T, color="0.6", linewidth=0.8, scalex=False, scaley=False)
    for uav, colour in enumerate(_colours(flight)):
        true, believed = flight.true[worst, uav], flight.believed[worst, uav]
        axis.plot(*flight.true[:, uav].T, color=colour, linewidth=0.8, alpha=0.5)
        axis.add_patch(Circle(tuple(true), flight.radius, color=colour, alpha=0.12, linewidth=0))
        axis.plot(*np.stack([true, believed]).T, color="0.2", linewidth=0.8, zorder=3)
        axis.plot(*true, "o", color=colour, markersize=6, zorder=4)
        axis.plot(*believed, "o", color=colour, markerfacecolor="white", markersize=6, zorder=4)
    axis.plot(*flight.source.T, color="black", linewidth=0.8, linestyle=":")
    axis.plot(*flight.source[worst], "*", color="black", markersize=10, zorder=5)
    axis.set_aspect("equal", adjustable="datalim")
    axis.margins(0.1)
    axis.set(xlabel="east [m]", ylabel="north [m]")
    axis.set_title(f"at {flight.time[worst]:g} s, when the beliefs are oldest", fontsize="medium")
    _legend_of_map(axis, flight)


def _legend_of_map(axis: Axes, flight: Beliefs) -> None:
    """UAVs by colour, and what the marks mean."""
    uavs = [
        Line2D([], [], color=colour, label=f"UAV {uav}")
        for uav, colour in enumerate(_colours(flight)[:MOST_PANELS])
    ]
    marks = [
        Line2D([], [], color="0.3", marker="o", linestyle="", label="true"),
        Line2D([], [], color="0.3", marker="o", linestyle="", markerfacecolor="white", label="believed"),
        Line2D([], [], color="black", marker="*", linestyle="", markersize=8, label="source"),
        Patch(color="0.3", alpha=0.15, linewidth=0, label=f"footprint ({flight.radius:.0f} m)"),
        Line2D([], [], color="0.6", linewidth=0.8, label="border"),
    ]
    axis.legend(handles=uavs + marks, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _panel(axis: Axes, flight: Beliefs, uav: int) -> None:
    """East coordinate of a UAV, true and believed, and what became of its messages."""
    time, colour = flight.time, _colours(flight)[uav]
    old = flight.age[:, uav] > 0
    strip = axis.get_xaxis_transform()
    axis.fill_between(time, 0, 1, where=old, step="post", transform=strip, color="0.9", linewidth=0)
    style = "steps-post" if flight.jumps else "default"
    axis.plot(time, flight.believed[:, uav, 0], color=colour, linewidth=2.2, drawstyle="steps-post")
    axis.plot(time, flight.true[:, uav, 0], color="black", linewidth=0.8, drawstyle=style)
    for flags, mark, tint in ((flight.arrived, ".", colour), (flight.lost, "x", "black")):
        times = time[flags[:, uav]]
        axis.plot(
            times,
            np.full(len(times), -0.08),
            mark,
            color=tint,
            markersize=3.5,
            transform=strip,
            clip_on=False,
        )
    axis.set_ylabel(f"UAV {uav}\neast [m]")
    axis.yaxis.set_major_locator(MaxNLocator(3))


def _ages(axis: Axes, flight: Beliefs) -> None:
    """Age of information of the UAVs with a panel."""
    for uav, colour in enumerate(_colours(flight)[:MOST_PANELS]):
        dashes = DASHES[uav % len(DASHES)]
        axis.step(
            flight.time, flight.age[:, uav], where="post", color=colour, linestyle=dashes, linewidth=1.2
        )
    axis.set_ylabel("age of\nbelief [s]")
    axis.set_ylim(bottom=0)
    axis.yaxis.set_major_locator(MaxNLocator(3, integer=True))
    axis.set_title(f"mean age {flight.age.mean():.2f} s", fontsize="medium")


def _share_time(figure: Figure, below: Sequence[Axes], flight: Beliefs, worst: int) -> None:
    """One time axis for everything under the map, with the instant that the map shows."""
    for axis in below:
        axis.axvline(float(flight.time[worst]), color="0.2", linewidth=0.8, linestyle=":")
        axis.tick_params(labelbottom=axis is below[-1])
        axis.margins(x=0.01)
    below[-1].set_xlabel("time [s]")
    figure.align_ylabels(list(below))


def _colours(flight: Beliefs) -> list[str]:
    return [COLOURS[uav % len(COLOURS)] for uav in range(flight.true.shape[1])]
