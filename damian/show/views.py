"""A map, into which films and figures draw the frames of an episode."""

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize, to_rgba
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Circle, Patch, Polygon
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Affine2D

from damian.show.episode import LIKELY, Episode, Floats
from damian.show.frame import INK, LATENESS, Frame, Uav, limits

HEAT = LinearSegmentedColormap.from_list("belief", [(0.45, 0.2, 0.6, 0.0), (0.45, 0.2, 0.6, 0.75)])
"""Colours of the belief about the sources."""
_NORM = LogNorm(LIKELY, 1.0)
LATE = LinearSegmentedColormap.from_list("lateness", LATENESS)
"""Colours of messages by their delay, and of UAVs by the age of the newest message."""
COVERED = LinearSegmentedColormap.from_list("covered", [(0.3, 0.6, 0.5, 0.0), (0.3, 0.6, 0.5, 0.5)])
"""Colours of the ground that footprints have covered, which fade to ``_FADED`` in ``_FADE`` steps."""
_FADED, _FADE = 0.25, 4.0
_CELLS = 250
"""Cells of the covered ground along the longer side of a map."""
_BLOWS = Path([[0.0, 1.0], [0.0, -1.0], [-0.4, -0.4], [0.0, -1.0], [0.4, -0.4]], [1, 2, 2, 1, 2])
"""Arrow of a wind from the north."""
DART = Path([[0.0, 1.0], [0.62, -0.8], [0.0, -0.42], [-0.62, -0.8], [0.0, 1.0]])
"""Outline of a UAV that flies to the north."""
_BOLT = Path(
    [[0.2, 1.0], [-0.6, -0.15], [-0.05, -0.15], [-0.2, -1.0], [0.6, 0.15], [0.05, 0.15], [0.2, 1.0]]
)
_CHARGES: dict[str, Any] = {"marker": _BOLT, "color": "#b8860b", "markersize": 9, "zorder": 1.2}
"""Mark of a place where UAVs charge."""
_LAND, _EDGE, _POINT = "#f5f2ea", "#8a8474", "#cfc8b8"
_ZONE = {"facecolor": "white", "edgecolor": _EDGE, "linewidth": 0.6, "hatch": "////"}
ROWS = 20
"""Largest number of UAVs with a row of messages each."""
_HALO = [withStroke(linewidth=1.8, foreground="white")]
_NAME: dict[str, Any] = {"fontsize": 7.5, "zorder": 8, "textcoords": "offset points"}
_NAME |= {"path_effects": _HALO, "ha": "center", "va": "center"}


class MapView:
    """The region from above, into which the frames of an episode are drawn, one after the other."""

    def __init__(self, axis: Any, episode: Episode) -> None:
        self.axis = axis
        self.episode = episode
        self._late = lateness(episode)
        corner, end = limits(episode.region, episode.radius)
        size = max(end - corner) / _CELLS
        self._grid = [np.arange(*ends, size) for ends in zip(corner, end, strict=True)]
        self._inside = shapely.contains_xy(episode.region, *np.meshgrid(*self._grid))
        self._covered_at = np.zeros(self._inside.shape)
        self._step = episode.n_steps + 1  # of the ground that is drawn
        place = [end for row in self._grid for end in (row[0] - size / 2, row[-1] + size / 2)]
        self._image = axis.imshow(
            self._inside,
            COVERED,
            extent=place,
            origin="lower",
            interpolation="bilinear",
            zorder=0.4,
        )
        draw_region(axis, episode.region, episode.landing_points, episode.radius)
        axis.plot(*_chargers(episode), linestyle="", **_CHARGES)

    def _cover(self, step: int) -> None:
        """Draw the ground that has been covered up to a step, the latest strongest."""
        if step < self._step:
            self._covered_at[:] = -np.inf
            self._step = -1
        for instant in range(self._step + 1, step + 1):
            for place in self.episode.true[instant]:
                east, north = ((row - at) ** 2 for row, at in zip(self._grid, place, strict=True))
                near = np.add.outer(north, east) <= self.episode.radius**2
                self._covered_at[near & self._inside] = instant
        self._step = step
        fresh = np.exp((self._covered_at - step) / _FADE)
        self._image.set_data(np.where(self._covered_at < 0, 0, _FADED + (1 - _FADED) * fresh))

    def draw(self, frame: Frame) -> list:
        """Draw a frame; returns the artists that were drawn."""
        self._cover(frame.step)
        drawn = []
        heat = [(part, p) for area, p in frame.cells for part in _polygons(area)]
        if heat:
            corners = [shapely.get_coordinates(part.exterior) for part, _ in heat]
            colours = [HEAT(_NORM(probability)) for _, probability in heat]
            cells = PolyCollection(corners, facecolor=colours, edgecolor="none", zorder=0.5)
            drawn.append(self.axis.add_collection(cells))
        for place in frame.requests:
            drawn += self._plot(place, "s", "none", INK, markersize=7)
        for place, emits in frame.sources:
            drawn += self._plot(place, "*", INK if emits else "white", INK, markersize=13)
        for uav in frame.uavs:
            drawn += self._uav(uav)
        return drawn + self._names(frame)

    def _plot(self, place: Floats, marker: str, fill: str, color: Any, **style: Any) -> list:
        """Mark a place on the ground, [2]."""
        style = {"zorder": 6, **style}
        return self.axis.plot(*place, marker, color=color, markerfacecolor=fill, **style)

    def _uav(self, uav: Uav) -> list:
        """Draw a UAV with its footprint, as a dart that points where it flies, and a line to where
        the server believes it to be.

        One that is told apart has a colour and a path; others are small, and the darker, the older
        what the server knows of them is.
        """
        colour = uav.colour if uav.chosen else LATE(self._late(uav.age))
        size = 1.0 if uav.chosen else 0.5
        true = uav.path[-1, :2]
        footprint = Circle(
            (true[0], true[1]),
            self.episode.radius,
            facecolor=to_rgba(colour, 0.26 if uav.spots else 0.07),
            edgecolor=colour,
            linewidth=1.6 * uav.spots or 0.5 * uav.chosen,
            zorder=2,
        )
        drawn = [self.axis.add_patch(footprint)]
        if uav.chosen:
            drawn += self.axis.plot(*uav.path[:, :2].T, color=colour, alpha=0.45, lw=1.6, zorder=3)
        drawn += self.axis.plot(
            *true,
            marker=DART.transformed(Affine2D().rotate(-uav.heading)),
            color=colour,
            markersize=5 + 8 * size,
            markeredgecolor=uav.edge,
            markeredgewidth=0.6 * size,
            zorder=5,
        )
        if uav.age > 0:
            way = np.stack([true, uav.believed]).T
            drawn += self.axis.plot(
                *way, ":" if uav.chosen else "-", color=colour, lw=size, zorder=3
            )
            ring = {"markersize": 12 * size, "markeredgewidth": 1.5 * size, "zorder": 4}
            drawn += self._plot(uav.believed, "o", "none", colour, **ring)
        return drawn

    def _names(self, frame: Frame) -> list:
        """Name UAVs and rings on the sides away from the line between them; names at one place lie
        apart."""
        uavs = [uav for uav in frame.uavs if uav.chosen]
        drawn = []
        for number, uav in enumerate(uavs):
            true = uav.path[-1, :2]
            east, north = true - uav.believed
            apart = 2 * np.pi * (number + 0.2) / len(uavs)
            turn = np.arctan2(north, east) if east or north else apart
            name = _short(uav.id)
            ring = [(uav.believed, f"{name}, {uav.age:g} s", turn + np.pi)] if uav.age > 0 else []
            for place, text, to in [(true, name, turn), *ring]:
                away = ((10 + 2.4 * len(text)) * np.cos(to), 13 * np.sin(to))
                drawn.append(self.axis.annotate(text, place, away, color=uav.ink, **_NAME))
        return drawn


def draw_region(axis: Any, region: Any, points: Floats, radius: float) -> None:
    """Draw a region with its no-fly zones and landing points, and room for footprints."""
    for part in _polygons(region):
        axis.add_patch(Polygon(part.exterior.coords, fc=_LAND, ec=_EDGE, lw=1.2, zorder=0))
        for hole in part.interiors:
            axis.add_patch(Polygon(hole.coords, zorder=0.6, **_ZONE))
    size = np.clip(40 / np.sqrt(max(len(points), 1)), 0.7, 2)
    axis.plot(*points.T, ".", color=_POINT, markersize=size, zorder=1)
    (west, south), (east, north) = limits(region, radius)
    axis.set(xlim=(west, east), ylim=(south, north), aspect="equal", anchor="NW")
    axis.set(xlabel="east [m]", ylabel="north [m]")
    axis.locator_params(nbins=5)


def draw_messages(axis: Axes, episode: Episode, colours: Mapping[int, str]) -> None:
    """Draw how late the messages of each step are: a row for each UAV, whose name has its colour,
    or of many how many messages there are."""
    scale = lateness(episode)
    late = np.where(episode.lost, 2 * cast(float, scale.vmax), episode.delay * step_of(episode))
    shown = np.where(episode.sent, late, np.nan).T
    n_rows = episode.n_agents
    if n_rows > ROWS:
        shown = np.sort(shown, axis=0)  # a histogram of each step, in colours
        axis.set_ylabel("messages")
        axis.locator_params("y", nbins=3)
    else:
        axis.invert_yaxis()
        axis.hlines(np.arange(1, n_rows), 0, episode.time[-1], "white", linewidth=2)
        axis.set_yticks(np.arange(n_rows) + 0.5, [*map(_short, episode.names)])
        for uav, label in enumerate(axis.get_yticklabels()):
            label.set_color(colours.get(uav, INK))
    edges = np.append(-step_of(episode), episode.time)
    axis.pcolormesh(edges, range(n_rows + 1), shown, cmap=LATE.with_extremes(over=INK), norm=scale)
    axis.set(xlim=(0, max(episode.time[-1], step_of(episode))))
    axis.set_xlabel("messages over the time of sending [s]; black: lost")


def lateness(episode: Episode) -> Normalize:
    """The scale of the colours of what is late [s]: to the longest delay, else to the oldest."""
    longest = episode.delay.max(initial=0) * step_of(episode) or episode.age.max(initial=0)
    return Normalize(0, longest or 1.0)


def legend_marks(episode: Episode) -> list:
    """Entries of a legend that explains what a view draws."""
    marks: list = [
        _mark("UAV, true", marker=DART, markersize=9),
        _mark(
            "UAV, as the server\nbelieves, with age",
            marker="o",
            markerfacecolor="none",
            markersize=9,
        ),
    ]
    marks.append(Patch(label="covered, the latest\nstrongest", fc=COVERED(0.7)))
    if episode.source is not None and episode.has_source:
        for does, style in (("emits", {}), ("silent", {"markerfacecolor": "white"})):
            marks.append(_mark(f"source, {does}", marker="*", color=INK, markersize=11, **style))
    if any(part.interiors for part in _polygons(episode.region)):
        marks.append(Patch(label="no-fly zone", **_ZONE))
    if _chargers(episode).size:
        marks.append(_mark("charging place", **_CHARGES))
    if episode.requests is not None:
        marks.append(_mark("open request", marker="s", color=INK, markerfacecolor="none"))
    if "wind" in episode.about:
        speed, direction = episode.about["wind"]
        blows = MarkerStyle(_BLOWS, transform=Affine2D().rotate_deg(-direction))
        marks.append(_mark(f"wind, {speed:.2g} m/s", marker=blows, color=INK, markersize=14))
    if episode.belief is not None:
        marks += [
            Patch(label=f"source, p = {p:g}", fc=HEAT(_NORM(p)), ec=_EDGE) for p in (0.1, 0.001)
        ]
    return marks


def _polygons(area: Any) -> list[shapely.Polygon]:
    """The polygons of a geometry; where a cell touches a border, it may have lines or points
    too."""
    return [
        part
        for part in shapely.get_parts(area)
        if part.geom_type == "Polygon" and not part.is_empty
    ]


def step_of(episode: Episode) -> float:
    """Time between two instants [s]."""
    return float(episode.time[1] - episode.time[0]) if episode.n_steps else 1.0


def _chargers(episode: Episode) -> Floats:
    """Places where UAVs charge, if they do not charge everywhere: east, north [m], [2, P]."""
    return np.reshape(episode.about.get("charging_points", []), (-1, 2)).T


def _short(name: str) -> str:
    """A name that fits beside its row."""
    return name if len(name) <= 8 else f"{name[:7]}\N{HORIZONTAL ELLIPSIS}"


def _mark(label: str, color: str = "0.3", **style: Any) -> Line2D:
    """An entry of a legend."""
    return Line2D([], [], label=label, color=color, linestyle="", **style)
