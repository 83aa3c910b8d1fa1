"""A map, into which films and figures draw the frames of an episode."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, LogNorm, to_rgba
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Patch
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Affine2D

from damian.show.episode import LIKELY, Episode, Floats
from damian.show.frame import INK, OTHER, Frame, Uav, limits

HEAT = LinearSegmentedColormap.from_list("belief", [(0.45, 0.2, 0.6, 0.0), (0.45, 0.2, 0.6, 0.75)])
"""Colours of the belief about the sources."""
_NORM = LogNorm(LIKELY, 1.0)
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
_CORNERS = 48
"""Corners of a footprint."""
_SMALL = 8.0
"""Size of the mark of one of many [points]."""
_HALO = [withStroke(linewidth=1.8, foreground="white")]
_NAME: dict[str, Any] = {"fontsize": 7.5, "zorder": 8, "textcoords": "offset points"}
_NAME |= {"path_effects": _HALO, "ha": "center", "va": "center"}


class MapView:
    """The region from above, into which the frames of an episode are drawn, one after the other."""

    def __init__(self, axis: Any, episode: Episode) -> None:
        self.axis = axis
        self.radius = episode.radius
        turns = np.linspace(0, 2 * np.pi, _CORNERS, endpoint=False)
        self._circle = self.radius * np.stack([np.cos(turns), np.sin(turns)], -1)
        lands = [shapely.get_coordinates(part.exterior) for part in _polygons(episode.region)]
        self._areas(lands, facecolor=_LAND, edgecolor=_EDGE, linewidth=1.2, zorder=0)
        self._areas(_zones(episode), zorder=0.6, **_ZONE)
        axis.plot(*episode.landing_points.T, ".", color=_POINT, markersize=2, zorder=1)
        axis.plot(*_chargers(episode), linestyle="", **_CHARGES)
        (west, south), (east, north) = limits(episode)
        axis.set(xlim=(west, east), ylim=(south, north), aspect="equal", anchor="NW")
        axis.set(xlabel="east [m]", ylabel="north [m]")
        axis.xaxis.set_major_locator(MaxNLocator(6))
        axis.yaxis.set_major_locator(MaxNLocator(6))

    def draw(self, frame: Frame) -> list[Any]:
        """Draw a frame; returns the artists that were drawn."""
        drawn: list[Any] = []
        heat = [(part, p) for area, p in frame.cells for part in _polygons(area)]
        if heat:
            corners = [shapely.get_coordinates(part.exterior) for part, _ in heat]
            colours = [HEAT(_NORM(probability)) for _, probability in heat]
            drawn.append(self._areas(corners, facecolor=colours, edgecolor="none", zorder=0.5))
        for place in frame.requests:
            drawn += self._plot(place, "s", "none", INK, markersize=7)
        for place, emits in frame.sources:
            drawn += self._plot(place, "*", INK if emits else "white", INK, markersize=13)
        others = [uav for uav in frame.uavs if not uav.chosen]
        if others:  # small, and the denser their footprints, the darker
            shades = [to_rgba(OTHER, 0.3 if uav.spots else 0.09) for uav in others]
            drawn.append(
                self._areas(list(map(self._print, others)), facecolor=shades, lw=0, zorder=1.5)
            )
            places = np.transpose([uav.path[-1, :2] for uav in others])
            marks = self.axis.scatter(*places, s=_SMALL**2, color=OTHER, zorder=3.5)
            turned = [Affine2D().rotate(-uav.heading).scale(0.5) for uav in others]
            marks.set_paths([DART.transformed(each) for each in turned])
            drawn.append(marks)
        for uav in frame.uavs:
            drawn += self._uav(uav) if uav.chosen else []
        return drawn + self._names(frame)

    def _plot(self, place: Floats, marker: str, fill: str, color: str, **style: Any) -> list[Any]:
        """Mark a place on the ground, [2]."""
        style = {"zorder": 6, **style}
        return self.axis.plot(*place, marker, color=color, markerfacecolor=fill, **style)

    def _print(self, uav: Uav) -> Floats:
        """Corners of a footprint, [C, 2]."""
        return uav.path[-1, :2] + self._circle

    def _uav(self, uav: Uav) -> list[Any]:
        """Draw a UAV with its path and footprint, as a dart that points where it flies, and a line
        to where the server believes it to be."""
        inside = to_rgba(uav.colour, 0.26 if uav.spots else 0.07)
        edge = {"edgecolor": uav.colour, "linewidth": 1.6 if uav.spots else 0.5}
        drawn = [self._areas([self._print(uav)], facecolor=inside, zorder=2, **edge)]
        parts = list(np.stack([uav.path[:-1, :2], uav.path[1:, :2]], 1))
        if parts:
            fading = np.linspace(0.1, 0.7, len(parts))
            trail = {"colors": uav.colour, "alpha": fading, "linewidths": 1.6, "zorder": 3}
            drawn.append(self.axis.add_collection(LineCollection(parts, **trail)))
        true = uav.path[-1, :2]
        dart = DART.transformed(Affine2D().rotate(-uav.heading))
        style = {"markersize": 13, "markeredgecolor": uav.edge, "markeredgewidth": 0.6, "zorder": 5}
        drawn += self.axis.plot(*true, marker=dart, color=uav.colour, **style)
        if uav.age > 0:
            line = {"color": uav.colour, "linewidth": 1.1, "zorder": 3}
            drawn += self.axis.plot(*np.stack([true, uav.believed]).T, ":", **line)
            ring = {"markersize": 12, "markeredgewidth": 1.5, "zorder": 4}
            drawn += self._plot(uav.believed, "o", "none", uav.colour, **ring)
        return drawn

    def _names(self, frame: Frame) -> list[Any]:
        """Name UAVs and rings, each in a direction of its own: names at one place lie apart."""
        uavs = [uav for uav in frame.uavs if uav.chosen]
        drawn: list[Any] = []
        for number, uav in enumerate(uavs):
            name = _short(uav.id)
            ring = [(uav.believed, f"{name}, {uav.age:g} s")] if uav.age > 0 else []
            for half, (place, text) in enumerate([(uav.path[-1, :2], name), *ring]):
                turn = np.pi * (2 * (number + 0.2) / len(uavs) + half)
                away = ((10 + 2.4 * len(text)) * np.cos(turn), 13 * np.sin(turn))
                drawn.append(self.axis.annotate(text, place, away, color=uav.ink, **_NAME))
        return drawn

    def _areas(self, corners: Sequence[Floats], **style: Any) -> Any:
        return self.axis.add_collection(PolyCollection(corners, **style))


def draw_messages(axis: Axes, episode: Episode, colours: Mapping[int, str]) -> None:
    """Draw a row for each of these UAVs, in its colour, with its messages over the time of
    sending."""
    dt = _step_of(episode)
    for row, (uav, colour) in enumerate(colours.items()):
        sent = np.flatnonzero(episode.sent[:, uav])
        begin = episode.time[sent]
        delay = episode.delay[sent, uav]
        late = delay > 0
        lost = delay < 0
        at_once = begin[~lost & ~late]
        ends = np.stack([begin, begin + np.maximum(delay, 0) * dt], -1)[late]
        lines = [[(a, row), (b, row)] for a, b in ends]
        axis.add_collection(LineCollection(lines, colors=colour, linewidths=2.2, alpha=0.55))
        axis.plot(
            at_once, np.full(len(at_once), row), ".", color=colour, markersize=3, clip_on=False
        )
        axis.plot(ends[:, 1], np.full(len(ends), row), ">", color=colour, markersize=3.5)
        axis.plot(
            begin[lost], np.full(lost.sum(), row), "x", color=INK, markersize=4.5, clip_on=False
        )
    size = min(8.0, 50 * height_of_rows(len(colours)) / len(colours))
    axis.set_yticks(
        range(len(colours)), [_short(episode.names[uav]) for uav in colours], fontsize=size
    )
    axis.spines["left"].set_visible(False)
    axis.tick_params(left=False)
    axis.set(ylim=(len(colours) - 0.4, -0.6), xlim=(0, max(float(episode.time[-1]), dt)))
    for label, uav in zip(axis.get_yticklabels(), colours, strict=True):
        label.set_color(colours[uav])
    axis.set_xlabel("messages over time [s]: dots arrive at once, bars are late, crosses are lost")


def height_of_rows(n_rows: int) -> float:
    """Height of so many rows of messages [inches]."""
    return 0.2 + 0.22 * min(n_rows, 8) + 0.14 * min(max(n_rows - 8, 0), 60)


def legend_marks(episode: Episode, n_chosen: int | None = None) -> list[Any]:
    """Entries of a legend that explains what a view draws, with so many UAVs told apart, or all."""
    others = episode.n_agents - (n_chosen or episode.n_agents)
    marks: list[Any] = [
        _mark("UAV, true", marker=DART, markersize=9),
        _mark(
            "UAV, as the server\nbelieves, with age",
            marker="o",
            markerfacecolor="none",
            markersize=9,
        ),
    ]
    if others:
        marks.insert(1, _mark(f"{others} other UAVs", color=OTHER, marker=DART, markersize=_SMALL))
    if episode.source is not None and episode.has_source:
        for does, style in (("emits", {}), ("silent", {"markerfacecolor": "white"})):
            marks.append(_mark(f"source, {does}", marker="*", color=INK, markersize=11, **style))
    if _zones(episode):
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
            Patch(label=f"source, chance {p:g}", fc=HEAT(_NORM(p)), ec=_EDGE) for p in (0.1, 0.001)
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


def _zones(episode: Episode) -> list[Floats]:
    """Corners of the holes of the region, which are its no-fly zones, [C, 2] each."""
    holes = [hole for part in _polygons(episode.region) for hole in part.interiors]
    return [shapely.get_coordinates(hole) for hole in holes]


def _step_of(episode: Episode) -> float:
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
