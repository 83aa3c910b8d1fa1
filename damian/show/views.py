"""A map and the space above it, into which films and figures draw the frames of an episode."""

from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Circle, Patch, PathPatch
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Affine2D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform

from damian.show.episode import LIKELY, Episode, Floats
from damian.show.frame import INK, Frame, Uav, limits

TURN = 0.7
"""Angle by which the space turns in each step [deg]."""
HEAT = LinearSegmentedColormap.from_list("belief", [(0.45, 0.2, 0.6, 0.0), (0.45, 0.2, 0.6, 0.75)])
"""Colours of the belief about the sources."""
_NORM = LogNorm(LIKELY, 1.0)
_BLOWS = Path([[0.0, 1.0], [0.0, -1.0], [-0.4, -0.4], [0.0, -1.0], [0.4, -0.4]], [1, 2, 2, 1, 2])
"""Arrow of a wind from the north."""
DART = Path([[0.0, 1.0], [0.62, -0.8], [0.0, -0.42], [-0.62, -0.8], [0.0, 1.0]])
"""Outline of a UAV that flies to the north."""
_LAND, _EDGE, _POINT = "#f5f2ea", "#8a8474", "#cfc8b8"
_ZONE = {"facecolor": "white", "edgecolor": _EDGE, "linewidth": 0.6, "hatch": "////"}
_CORNERS = 48
"""Corners of a footprint in space."""
_HALO = [withStroke(linewidth=1.8, foreground="white")]
_NAME = {"fontsize": 7.5, "zorder": 8, "textcoords": "offset points", "path_effects": _HALO}
_AROUND = np.array([(1, 0.5), (1, -0.5), (-1, 0.5), (-1, -0.5), (0, 1), (0, -1), (1, 1), (-1, -1)])
"""Where a name may stand beside its mark."""


class MapView:
    """The region from above."""

    def __init__(self, axis: Axes, episode: Episode) -> None:
        self.axis, self.radius, self.crowded = axis, episode.radius, episode.is_crowded
        style = {"facecolor": _LAND, "edgecolor": _EDGE, "linewidth": 1.2, "zorder": 0}
        axis.add_patch(PathPatch(_outline(episode.region), **style))
        for zone in _zones(episode):
            axis.add_patch(PathPatch(zone, zorder=0.1, **_ZONE))
        axis.plot(*episode.landing_points.T, ".", color=_POINT, markersize=2, zorder=1)
        (west, south), (east, north) = limits(episode)
        axis.set(xlim=(west, east), ylim=(south, north), aspect="equal", anchor="NW")
        axis.set(xlabel="east [m]", ylabel="north [m]")
        axis.xaxis.set_major_locator(MaxNLocator(6))
        axis.yaxis.set_major_locator(MaxNLocator(6))

    def draw(self, frame: Frame) -> list[Any]:
        """Draw a frame; returns the artists that were drawn."""
        drawn: list[Any] = []
        if frame.cells:
            areas = [PathPatch(_outline(area), fc=HEAT(_NORM(p)), ec="none") for area, p in frame.cells]
            heat = PatchCollection(areas, match_original=True, zorder=0.5)
            drawn.append(self.axis.add_collection(heat))
        drawn += _draw_source(self.axis, frame, (), {"markersize": 13, "zorder": 6})
        drawn += [artist for uav in frame.uavs for artist in self._uav(uav)]
        return drawn + _draw_names(self.axis, frame, lambda at: at)

    def _uav(self, uav: Uav) -> list[Any]:
        """Draw a UAV with its path and footprint, and where the server believes it to be."""
        colour, axis, true = uav.colour, self.axis, uav.path[-1, :2]
        strength, edge = (0.26, 1.6) if uav.spots else (0.0 if self.crowded else 0.07, 0.5)
        inside = Circle(tuple(true), self.radius, facecolor=colour, alpha=strength, linewidth=0, zorder=2)
        ring = Circle(tuple(true), self.radius, fill=False, edgecolor=colour, linewidth=edge, zorder=2.1)
        parts, fading = _trail(uav.path[:, :2])
        trail = LineCollection(parts, colors=colour, alpha=fading, linewidths=1.6, zorder=3)
        drawn: list[Any] = [axis.add_collection(trail), axis.add_patch(inside), axis.add_patch(ring)]
        dart = DART.transformed(Affine2D().rotate(-uav.heading))
        style = {"markersize": 13, "markeredgecolor": uav.edge, "markeredgewidth": 0.6, "zorder": 5}
        drawn += axis.plot(*true, marker=dart, color=colour, **style)
        if uav.age > 0:
            drawn += axis.plot(*np.stack([true, uav.believed]).T, ":", color=colour, linewidth=1.1, zorder=3)
            hollow = {"markerfacecolor": "none", "markersize": 12, "markeredgewidth": 1.5, "zorder": 4}
            drawn += axis.plot(*uav.believed, "o", color=colour, **hollow)
        return drawn


class SpaceView:
    """The region and the space above it, which turns slowly."""

    def __init__(self, axis: Any, episode: Episode) -> None:
        self.axis, self.radius, self.crowded = axis, episode.radius, episode.is_crowded
        self.dt = float(episode.time[1] - episode.time[0]) if episode.n_steps else 1.0
        axis.computed_zorder = False  # the middle of the large ground says nothing about what it hides
        for part in shapely.get_parts(episode.region):
            shell, *holes = [shapely.get_coordinates(ring) for ring in shapely.get_rings(part)]
            for ring, fill in [(shell, _LAND), *((hole, "white") for hole in holes)]:
                style = {"facecolor": fill, "edgecolor": _EDGE, "linewidth": 1.0, "zorder": 0}
                axis.add_collection3d(Poly3DCollection([_on_ground(ring)], **style))
        axis.plot(*episode.landing_points.T, 0, ".", color=_POINT, markersize=1.5, zorder=1)
        (west, south), (east, north) = limits(episode)
        height = 1.1 * max(float(episode.position[..., 2].max()), 1.0)
        axis.set(xlim=(west, east), ylim=(south, north), zlim=(0, height))
        size, share = np.array([east - west, north - south]), 0.35 if episode.position[..., 2].any() else 0.01
        axis.set_box_aspect((*size / size.max(), share), zoom=1.3)
        axis.set_axis_off()
        scale = f"{size[0]:.0f} m x {size[1]:.0f} m, heights {share * size.max() / height:.0f} times as large"
        axis.text2D(0.08, 0.2, scale, transform=axis.transAxes, fontsize=7.5, color="0.4")

    def draw(self, frame: Frame) -> list[Any]:
        """Draw a frame; returns the artists that were drawn."""
        self.axis.view_init(elev=34, azim=-65 + TURN * frame.time / self.dt)
        pieces = [
            (_on_ground(shapely.get_coordinates(part.exterior)), HEAT(_NORM(probability)))
            for area, probability in frame.cells
            for part in _polygons(area)
        ]
        drawn: list[Any] = []
        if pieces:
            corners, colours = zip(*pieces, strict=True)
            heat = Poly3DCollection(corners, facecolor=colours, zorder=0.5)
            drawn.append(self.axis.add_collection3d(heat))
        drawn += _draw_source(self.axis, frame, (0,), {"markersize": 12, "zorder": 5})
        drawn += [artist for uav in frame.uavs for artist in self._uav(uav)]
        seen = self.axis.get_proj()
        return drawn + _draw_names(
            self.axis, frame, lambda at: proj_transform(at[0], at[1], at[2:].sum(), seen)
        )

    def _uav(self, uav: Uav) -> list[Any]:
        """Draw a UAV with its path, what it stands above, and where the server believes it to be."""
        colour, axis, (x, y, z) = uav.colour, self.axis, uav.path[-1]
        turns = np.linspace(0, 2 * np.pi, _CORNERS, endpoint=False)
        circle = uav.path[-1, :2] + self.radius * np.stack([np.cos(turns), np.sin(turns)], -1)
        strength = 0.35 if uav.spots else 0.05 if self.crowded else 0.12
        footprint = Poly3DCollection([_on_ground(circle)], facecolor=colour, alpha=strength, zorder=2)
        drawn: list[Any] = [axis.add_collection3d(footprint)]
        drawn += axis.plot([x, x], [y, y], [0, z], color=colour, lw=0.8, zorder=6)
        parts, fading = _trail(uav.path)
        if parts:
            trail = Line3DCollection(parts, colors=colour, alpha=fading, linewidths=1.6, zorder=6)
            drawn.append(axis.add_collection3d(trail))
        style = {"markersize": 8, "markeredgecolor": uav.edge, "markeredgewidth": 0.8, "zorder": 7}
        drawn += axis.plot(x, y, z, "o", color=colour, **style)
        if uav.age > 0:
            hollow = {"markerfacecolor": "none", "markersize": 11, "markeredgewidth": 1.5, "zorder": 4}
            drawn += axis.plot(*uav.believed, 0, "o", color=colour, **hollow)
        return drawn


def draw_messages(axis: Axes, episode: Episode, colours: list[str]) -> None:
    """Draw a row for each UAV with its messages over the time of sending."""
    dt = float(episode.time[1] - episode.time[0]) if episode.n_steps else 1.0
    for uav, colour in enumerate(colours):
        sent = np.flatnonzero(episode.sent[:, uav])
        begin, delay = episode.time[sent], episode.delay[sent, uav]
        late, lost = delay > 0, delay < 0
        at_once = begin[~lost & ~late]
        ends = np.stack([begin, begin + np.maximum(delay, 0) * dt], -1)[late]
        lines = [[(a, uav), (b, uav)] for a, b in ends]
        axis.add_collection(LineCollection(lines, colors=colour, linewidths=2.2, alpha=0.55))
        axis.plot(at_once, np.full(len(at_once), uav), ".", color=colour, markersize=3)
        axis.plot(ends[:, 1], np.full(len(ends), uav), ">", color=colour, markersize=3.5)
        axis.plot(begin[lost], np.full(lost.sum(), uav), "x", color=INK, markersize=4.5)
    size = min(8.0, 50 * height_of_rows(episode.n_agents) / episode.n_agents)
    axis.set_yticks(range(episode.n_agents), [_short(name) for name in episode.names], fontsize=size)
    axis.spines["left"].set_visible(False)
    axis.tick_params(left=False)
    axis.set(ylim=(episode.n_agents - 0.4, -0.6), xlim=(0, max(float(episode.time[-1]), dt)))
    axis.set_xlabel("messages over time [s]: dots arrive at once, bars are late, crosses are lost")


def height_of_rows(n_agents: int) -> float:
    """Height of a row for each UAV [inches]."""
    return 0.2 + 0.22 * min(n_agents, 8) + 0.14 * min(max(n_agents - 8, 0), 60)


def draw_scale(axis: Axes) -> None:
    """Draw the scale of the belief into an axis of its own."""
    axis.figure.colorbar(ScalarMappable(_NORM, HEAT), cax=axis, orientation="horizontal")
    axis.set_title("belief: a source in a cell", loc="left", fontsize="medium")


def legend_marks(episode: Episode) -> list[Any]:
    """Entries of a legend that explains what a view draws."""
    marks: list[Any] = [
        _mark("UAV, true", marker=DART, markersize=9),
        _mark("UAV, as the server\nbelieves, with age", marker="o", markerfacecolor="none", markersize=9),
    ]
    if episode.source is not None:
        for does, style in (("emits", {}), ("silent", {"markerfacecolor": "white"})):
            marks.append(_mark(f"source, {does}", marker="*", color=INK, markersize=11, **style))
    if _zones(episode):
        marks.append(Patch(label="no-fly zone", **_ZONE))
    if episode.requests is not None:
        marks.append(_mark("open request", marker="s", color=INK, markerfacecolor="none"))
    if "wind" in episode.about:
        speed, direction = episode.about["wind"]
        blows = MarkerStyle(_BLOWS, transform=Affine2D().rotate_deg(-direction))
        marks.append(_mark(f"wind, {speed:.2g} m/s", marker=blows, color=INK, markersize=14))
    return marks


def _draw_source(axis: Any, frame: Frame, height: tuple[float, ...], style: dict[str, Any]) -> list[Any]:
    """Draw the sources, filled while they emit, if anybody knows them, and the open requests."""
    drawn = []
    for place in frame.requests:
        drawn += axis.plot(
            *place, *height, "s", color=INK, markerfacecolor="none", **style | {"markersize": 7}
        )
    for place, emits in frame.sources:
        fill = INK if emits else "white"
        drawn += axis.plot(*place, *height, "*", color=INK, markerfacecolor=fill, **style)
    return drawn


def _draw_names(axis: Axes, frame: Frame, flat: Any) -> list[Any]:
    """Name UAVs and rings where their names cover least; ``flat`` tells where the picture shows a place."""
    axis.apply_aspect()
    rings = [(uav, uav.believed, f"{_short(uav.id)}, {uav.age:g} s") for uav in frame.uavs if uav.age > 0]
    named = [*((uav, uav.path[-1], _short(uav.id)) for uav in frame.uavs), *rings]
    shown = np.array([flat(place)[:2] for _, place, _ in named])
    points = axis.transData.transform(shown) * 72 / axis.figure.dpi
    covered = [np.stack([points - 5, points + 5], 1)]
    drawn: list[Any] = []
    for (uav, _, text), anchor, place in zip(named, shown, points, strict=True):
        half = np.array([2.4 * len(text), 4.0])
        middles = place + np.concatenate([_AROUND * (half + near) for near in (5, 13, 24)])
        middles = middles.clip(half, np.multiply(axis.figure.bbox.size, 72 / axis.figure.dpi) - half)
        boxes = np.stack([middles - half, middles + half], 1)
        low, high = np.concatenate(covered).transpose(1, 0, 2)
        common = np.minimum(boxes[:, None, 1], high) - np.maximum(boxes[:, None, 0], low)
        best = int(common.clip(0).prod(-1).sum(-1).round().argmin())
        covered.append(boxes[best : best + 1])
        line = {"arrowstyle": "-", "color": uav.ink, "linewidth": 0.5, "shrinkA": 0, "shrinkB": 3}
        style: dict[str, Any] = {"color": uav.ink, "arrowprops": line, "ha": "center", "va": "center"}
        drawn.append(axis.annotate(text, tuple(anchor), tuple(middles[best] - place), **style, **_NAME))
    return drawn


def _trail(path: Floats) -> tuple[list[Floats], Floats | None]:
    """The parts of a path [P, D], [2, D] each, and how strong each is drawn."""
    parts = list(np.stack([path[:-1], path[1:]], 1))
    return parts, np.linspace(0.1, 0.7, len(parts)) if parts else None


def _on_ground(corners: Floats) -> Floats:
    """Places [C, 2] as points on the ground, [C, 3]."""
    return np.column_stack([corners, np.zeros(len(corners))])


def _polygons(area: Any) -> list[shapely.Polygon]:
    """The polygons of a geometry; where a cell touches a border, it may have lines or points too."""
    return [part for part in shapely.get_parts(area) if part.geom_type == "Polygon" and not part.is_empty]


def _outline(area: Any) -> Path:
    """A region, or a part of it, with its holes as a path."""
    rings = shapely.get_rings(shapely.orient_polygons(_polygons(area)))
    return Path.make_compound_path(*[Path(shapely.get_coordinates(ring), closed=True) for ring in rings])


def _zones(episode: Episode) -> list[Path]:
    """The holes of the region, which are its no-fly zones."""
    holes = [hole for part in _polygons(episode.region) for hole in part.interiors]
    return [Path(shapely.get_coordinates(hole), closed=True) for hole in holes]


def _short(name: str) -> str:
    """A name that fits beside its row."""
    return name if len(name) <= 8 else f"{name[:7]}\N{HORIZONTAL ELLIPSIS}"


def _mark(label: str, color: str = "0.3", **style: Any) -> Line2D:
    """An entry of a legend."""
    return Line2D([], [], label=label, color=color, linestyle="", **style)
