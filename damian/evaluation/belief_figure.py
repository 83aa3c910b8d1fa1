"""What the server believed of the UAVs during a flight, drawn beside what was true."""

from collections.abc import Sequence
from dataclasses import dataclass
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
from numpy.typing import NDArray

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Told apart by the colour-blind too (Okabe and Ito, 2008)."""
DASHES = ("-", "--", ":", "-.")
MOST_PANELS = len(COLOURS)
"""UAVs with a panel of their own; of a larger fleet the others are on the map only."""
_OTHERS = "0.6"

_WIDTH = 7.0
"""Of the figure [inches]: that of a page's text."""
_WIDE = 1.5
"""Width of the map over its height."""
_OLD = "0.9"
"""Grey behind a belief that is older than the step."""
_BESIDE: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "frameon": False}
"""Where a legend stands."""

Floats = NDArray[np.floating]
Flags = NDArray[np.bool_]
Integers = NDArray[np.integer]


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
    sent: Flags
    """Was a message given to the channel just now, [T + 1, N]; the first of all needs none."""
    delay: Integers
    """Of that message [steps], [T + 1, N]; negative if it never arrives."""
    source: Floats
    """East, north [m], [T + 1, 2]."""
    region: shapely.Polygon | shapely.MultiPolygon
    """Where the UAVs fly."""
    radius: float
    """Within which a UAV hears the source [m]."""
    instant: bool
    """Is a UAV at its target as soon as a step ends."""

    @property
    def lost(self) -> Flags:
        """Was a message sent just now that never arrives, [T + 1, N]."""
        return self.sent & (self.delay < 0)

    @property
    def late(self) -> Flags:
        """Was a message sent just now that arrives at a later step, [T + 1, N]."""
        return self.sent & (self.delay > 0)

    @property
    def arrived(self) -> Flags:
        """Did a message arrive just now, newer than what is believed or not, [T + 1, N]."""
        step, uav = np.nonzero(self.sent & (self.delay >= 0))
        at = step + self.delay[step, uav]
        arrived = np.zeros_like(self.sent)
        arrived[at[at < len(arrived)], uav[at < len(arrived)]] = True
        arrived[0] = True
        return arrived


def plot_beliefs(flight: Beliefs, path: Path) -> None:
    """Draw a map, the east coordinate of each UAV, and the ages."""
    instant = _most_mistaken(flight)
    with matplotlib.rc_context({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}):
        figure, (chart, *below) = _layout(min(flight.true.shape[1], MOST_PANELS))
        _map(chart, flight, instant)
        for uav, axis in enumerate(below[:-1]):
            _panel(axis, flight, uav)
        _legend_of_panels(below[0])
        _ages(below[-1], flight)
        _share_time(figure, below, float(flight.time[instant]))
        figure.savefig(path, dpi=200)


def _layout(n_panels: int) -> tuple[Figure, list[Axes]]:
    """A map, panels and ages below each other, with room for legends at their right."""
    heights = [
        3.2,
        0.55,
        *[0.8, 0.3] * (n_panels - 1),
        0.8,
        0.45,
        0.8,
    ]  # of each and of the gap below it [inches]
    above, under = 0.3, 0.45
    height = above + sum(heights) + under
    figure = Figure(figsize=(_WIDTH, height))
    grid = figure.add_gridspec(
        len(heights),
        height_ratios=heights,
        hspace=0,
        left=0.12,
        right=0.79,
        top=1 - above / height,
        bottom=under / height,
    )
    return figure, [figure.add_subplot(grid[row]) for row in range(0, len(heights), 2)]


def _most_mistaken(flight: Beliefs) -> int:
    """The latest instant at which true and believed positions are furthest apart."""
    error = np.linalg.norm(flight.true - flight.believed, axis=-1).sum(-1)
    return int(np.flatnonzero(error == error.max())[-1])


def _map(axis: Axes, flight: Beliefs, instant: int) -> None:
    """True paths; at one instant, where the UAVs are and where they are believed."""
    for ring in shapely.get_rings(shapely.get_parts(flight.region)):
        axis.plot(*shapely.get_coordinates(ring).T, "--", color="0.4", linewidth=0.8)
    for uav, colour in enumerate(_colours(flight)):
        true, believed = flight.true[instant, uav], flight.believed[instant, uav]
        axis.plot(*flight.true[:, uav].T, color=colour, linewidth=0.8, alpha=0.5)
        axis.add_patch(Circle(tuple(true), flight.radius, color=colour, alpha=0.12, linewidth=0))
        axis.plot(*np.stack([true, believed]).T, color="0.2", linewidth=0.8, zorder=3)
        axis.plot(*true, "o", color=colour, markersize=4.5, zorder=4)
        axis.plot(*believed, "o", color=colour, markerfacecolor="none", markersize=9, zorder=4)
    axis.plot(*flight.source.T, color="black", linewidth=0.8, linestyle=":")
    axis.plot(*flight.source[instant], "*", color="black", markersize=10, zorder=5)
    _zoom(axis, np.concatenate([flight.true.reshape(-1, 2), flight.source]), flight.radius)
    wrong = not np.array_equal(flight.true[instant], flight.believed[instant])
    when = ", when the server is most mistaken" if wrong else ""
    axis.set_title(f"paths, and the UAVs at {flight.time[instant]:g} s{when}", fontsize="medium")
    _legend_of_map(axis, flight)


def _zoom(axis: Axes, places: Floats, margin: float) -> None:
    """Show these places [P, 2] and a margin [m], with a metre as long either way."""
    low, high = places.min(0) - margin, places.max(0) + margin
    middle, size = (low + high) / 2, high - low
    half = np.array([_WIDE, 1.0]) * max(size[0] / _WIDE, size[1]) / 2
    (west, south), (east, north) = middle - half, middle + half
    axis.set(xlim=(west, east), ylim=(south, north), xlabel="east [m]", ylabel="north [m]")
    axis.set_aspect("equal")


def _legend_of_map(axis: Axes, flight: Beliefs) -> None:
    """UAVs by colour, and what the marks mean."""
    colours = _colours(flight)
    uavs = [_key(f"UAV {uav}", color=colour) for uav, colour in enumerate(colours[:MOST_PANELS])]
    uavs += [_key("other UAVs", color=_OTHERS)] if len(colours) > MOST_PANELS else []
    marks = [
        _key("true", marker="o", linestyle="", markersize=4.5),
        _key("believed", marker="o", linestyle="", markersize=9, markerfacecolor="none"),
        _key("source", marker="*", linestyle="", color="black", markersize=8),
        Patch(color="0.3", alpha=0.15, linewidth=0, label=f"footprint ({flight.radius:.0f} m)"),
        _key("border", color="0.4", linewidth=0.8, linestyle="--"),
    ]
    axis.legend(handles=uavs + marks, **_BESIDE)


def _key(label: str, color: str = "0.3", **look: Any) -> Line2D:
    """An entry of a legend."""
    return Line2D([], [], label=label, color=color, **look)


def _panel(axis: Axes, flight: Beliefs, uav: int) -> None:
    """East coordinate of a UAV, true and believed, and what became of its messages."""
    time, colour = flight.time, _colours(flight)[uav]
    old, strip = flight.age[:-1, uav] > 0, axis.get_xaxis_transform()
    axis.stairs(old, time, fill=True, transform=strip, color=_OLD)
    axis.step(time, flight.believed[:, uav, 0], where="post", color=colour, linewidth=2.2)
    style = "steps-post" if flight.instant else "default"
    axis.plot(time, flight.true[:, uav, 0], color="black", linewidth=0.8, drawstyle=style)
    for flags, mark, tint in ((flight.arrived, ".", colour), (flight.lost, "x", "black")):
        times = time[flags[:, uav]]
        height = np.full_like(times, -0.08)
        axis.plot(times, height, mark, color=tint, markersize=3.5, transform=strip, clip_on=False)
    axis.set_ylabel(f"UAV {uav}\neast [m]")
    axis.yaxis.set_major_locator(MaxNLocator(3))


def _legend_of_panels(axis: Axes) -> None:
    """What the lines and marks over time mean."""
    handles = [
        _key("true", color="black", linewidth=0.8),
        _key("believed", linewidth=2.2),
        Patch(color=_OLD, linewidth=0, label="belief is old"),
        _key("message arrives", marker=".", linestyle=""),
        _key("message is lost", marker="x", linestyle="", color="black", markersize=3.5),
    ]
    axis.legend(handles=handles, **_BESIDE)


def _ages(axis: Axes, flight: Beliefs) -> None:
    """Age of information of the UAVs with a panel."""
    for uav, colour in enumerate(_colours(flight)[:MOST_PANELS]):
        dashes = DASHES[uav % len(DASHES)]
        axis.step(flight.time, flight.age[:, uav], dashes, where="post", color=colour, linewidth=1.2)
    axis.set_ylabel("age of\nbelief [s]")
    axis.set_ylim(0, 1.1 * float(flight.age.max()) or 1.0)
    axis.yaxis.set_major_locator(MaxNLocator(3))
    axis.set_title(f"mean age {flight.age.mean():.2f} s", fontsize="medium")


def _share_time(figure: Figure, below: Sequence[Axes], instant: float) -> None:
    """One time axis for everything under the map, with the instant [s] that the map shows."""
    for axis in below:
        axis.axvline(instant, color="0.2", linewidth=0.8, linestyle=":")
        axis.tick_params(labelbottom=axis is below[-1])
        axis.margins(x=0.01)
    below[-1].set_xlabel("time [s]")
    figure.align_ylabels(below)


def _colours(flight: Beliefs) -> list[str]:
    """One for each UAV; those without a panel are grey."""
    return [*COLOURS, *[_OTHERS] * flight.true.shape[1]][: flight.true.shape[1]]
