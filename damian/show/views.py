"""A map and the space above it, into which films and figures draw the frames of an episode."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import LinearSegmentedColormap, LogNorm, to_rgba
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
from damian.show.frame import INK, OTHER, Frame, Uav, limits

TURN = 0.7
"""Angle by which the space turns in each step [deg]."""
HEAT = LinearSegmentedColormap.from_list("belief", [(0.45, 0.2, 0.6, 0.0), (0.45, 0.2, 0.6, 0.75)])
"""Colours of the belief about the sources."""
_NORM = LogNorm(LIKELY, 1.0)
_BLOWS = Path([[0.0, 1.0], [0.0, -1.0], [-0.4, -0.4], [0.0, -1.0], [0.4, -0.4]], [1, 2, 2, 1, 2])
"""Arrow of a wind from the north."""
DART = Path([[0.0, 1.0], [0.62, -0.8], [0.0, -0.42], [-0.62, -0.8], [0.0, 1.0]])
"""Outline of a UAV that flies to the north."""
_BOLT = Path([[0.2, 1.0], [-0.6, -0.15], [-0.05, -0.15], [-0.2, -1.0], [0.6, 0.15], [0.05, 0.15], [0.2, 1.0]])
_CHARGES: dict[str, Any] = {"marker": _BOLT, "color": "#b8860b", "markersize": 9, "zorder": 1.2}
"""Mark of a place where UAVs charge."""
_LAND, _EDGE, _POINT = "#f5f2ea", "#8a8474", "#cfc8b8"
_ZONE = {"facecolor": "white", "edgecolor": _EDGE, "linewidth": 0.6, "hatch": "////"}
_CORNERS = 48
"""Corners of a footprint in space."""
_SMALL, _HIGHEST = 8.0, 0.35
"""Size of the mark of one of many [points], and share of the region's size to which heights are enlarged."""
_HALO = [withStroke(linewidth=1.8, foreground="white")]
_NAME = {"fontsize": 7.5, "zorder": 8, "textcoords": "offset points", "path_effects": _HALO}
_AROUND = np.array([(1, 0.5), (1, -0.5), (-1, 0.5), (-1, -0.5), (0, 1), (0, -1), (1, 1), (-1, -1)])
"""Where a name may stand beside its mark."""


class MapView:
    """The region from above."""

    def __init__(self, axis: Axes, episode: Episode) -> None:
        self.axis, self.radius = axis, episode.radius
        style = {"facecolor": _LAND, "edgecolor": _EDGE, "linewidth": 1.2, "zorder": 0}
        axis.add_patch(PathPatch(_outline(episode.region), **style))
        for zone in _zones(episode):
            axis.add_patch(PathPatch(zone, zorder=0.1, **_ZONE))
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
        if frame.cells:
            areas = [PathPatch(_outline(area), fc=HEAT(_NORM(p)), ec="none") for area, p in frame.cells]
            heat = PatchCollection(areas, match_original=True, zorder=0.5)
            drawn.append(self.axis.add_collection(heat))
        drawn += _draw_source(self.axis, frame, (), {"markersize": 13, "zorder": 6})
        drawn += self._others([uav for uav in frame.uavs if not uav.chosen])
        drawn += [artist for uav in frame.uavs if uav.chosen for artist in self._uav(uav)]
        return drawn + _draw_names(self.axis, frame, lambda at: at)

    def _others(self, uavs: list[Uav]) -> list[Any]:
        """Draw the UAVs that are not told apart: small, and the denser their footprints, the darker."""
        if not uavs:
            return []
        places = [uav.path[-1, :2] for uav in uavs]
        prints = [Circle(tuple(place), self.radius) for place in places]
        density = PatchCollection(prints, facecolor=_shades(uavs), linewidth=0, zorder=1.5)
        marks = self.axis.scatter(*np.transpose(places), s=_SMALL**2, color=OTHER, zorder=3.5)
        marks.set_paths([DART.transformed(Affine2D().rotate(-uav.heading).scale(0.5)) for uav in uavs])
        return [self.axis.add_collection(density), marks]

    def _uav(self, uav: Uav) -> list[Any]:
        """Draw a UAV with its path and footprint, and where the server believes it to be."""
        colour, axis, true = uav.colour, self.axis, uav.path[-1, :2]
        strength, edge = (0.26, 1.6) if uav.spots else (0.07, 0.5)
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
    """The region and the space above it, which turns slowly; ``room`` is what it may fill [px], [2]."""

    def __init__(self, axis: Any, episode: Episode, room: Floats) -> None:
        self.axis, self.radius = axis, episode.radius
        self.dt = float(episode.time[1] - episode.time[0]) if episode.n_steps else 1.0
        self._turn = lambda steps: axis.view_init(elev=34, azim=-65 + TURN * steps)
        axis.computed_zorder = False  # the middle of the large ground says nothing about what it hides
        for part in shapely.get_parts(episode.region):
            shell, *holes = [shapely.get_coordinates(ring) for ring in shapely.get_rings(part)]
            land = {"facecolor": _LAND, "edgecolor": _EDGE, "linewidth": 1.0}
            for ring, style in [(shell, land), *((hole, _ZONE) for hole in holes)]:
                axis.add_collection3d(Poly3DCollection([_on_ground(ring)], zorder=0, **style))
        axis.plot(*episode.landing_points.T, 0, ".", color=_POINT, markersize=1.5, zorder=1)
        axis.plot(*_chargers(episode), 0, linestyle="", **_CHARGES)
        (west, south), (east, north) = limits(episode)
        size, highest = np.array([east - west, north - south]), float(episode.position[..., 2].max())
        height = 1.1 * max(highest, 0.001 * size.max())
        times = max(1, round(float(f"{_HIGHEST * size.max() / height:.1g}"))) if highest else 1
        axis.set(xlim=(west, east), ylim=(south, north), zlim=(0, height), proj_type="ortho")
        axis.set_axis_off()
        ground = shapely.get_coordinates(episode.region.buffer(self.radius)).T
        corners = np.hstack([[*ground, np.full(ground.shape[1], up)] for up in (0, height)])
        self._fit(corners, np.array([*size, times * height]) / size.max(), room)
        heights = f", heights {f'{times} times as large' if times > 1 else 'to scale'}" if highest else ""
        self.scale = f"{size[0]:.0f} m x {size[1]:.0f} m{heights}"

    def draw(self, frame: Frame) -> list[Any]:
        """Draw a frame; returns the artists that were drawn."""
        self._turn(frame.time / self.dt)
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
        drawn += self._others([uav for uav in frame.uavs if not uav.chosen])
        drawn += [artist for uav in frame.uavs if uav.chosen for artist in self._uav(uav)]
        seen = self.axis.get_proj()
        return drawn + _draw_names(
            self.axis, frame, lambda at: proj_transform(at[0], at[1], at[2:].sum(), seen)
        )

    def _fit(self, corners: Floats, shape: Floats, room: Floats) -> None:
        """Draw a box of this shape so large that these corners in it, [3, C], are always in the room."""
        axis, far = self.axis, []
        axis.set_box_aspect(shape)
        axis.apply_aspect()
        for angle in range(0, 360, 4):
            self._turn(angle / TURN)
            seen = np.transpose(proj_transform(corners[0], corners[1], corners[2], axis.get_proj())[:2])
            far.append(np.abs(axis.transData.transform(seen) - np.mean(axis.bbox, 0)).max(0))
        axis.set_box_aspect(shape, zoom=float((room / 2 / np.max(far, 0)).min()))

    def _others(self, uavs: list[Uav]) -> list[Any]:
        """Draw the UAVs that are not told apart: small, and the denser their footprints, the darker."""
        if not uavs:
            return []
        prints = [_on_ground(self._print(uav)) for uav in uavs]
        density = Poly3DCollection(prints, facecolor=_shades(uavs), linewidth=0, zorder=1.5)
        places = np.transpose([uav.path[-1] for uav in uavs])
        style = {"color": OTHER, "markersize": 0.5 * _SMALL, "zorder": 3.5}
        return [self.axis.add_collection3d(density), *self.axis.plot(*places, "o", **style)]

    def _print(self, uav: Uav) -> Floats:
        """Corners of a footprint, [C, 2]."""
        turns = np.linspace(0, 2 * np.pi, _CORNERS, endpoint=False)
        return uav.path[-1, :2] + self.radius * np.stack([np.cos(turns), np.sin(turns)], -1)

    def _uav(self, uav: Uav) -> list[Any]:
        """Draw a UAV with its path, what it stands above, and where the server believes it to be."""
        colour, axis, (x, y, z) = uav.colour, self.axis, uav.path[-1]
        ground = [_on_ground(self._print(uav))]
        footprint = Poly3DCollection(ground, facecolor=colour, alpha=0.35 if uav.spots else 0.12, zorder=2)
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


def draw_messages(axis: Axes, episode: Episode, colours: Mapping[int, str]) -> None:
    """Draw a row for each of these UAVs, in its colour, with its messages over the time of sending."""
    dt = float(episode.time[1] - episode.time[0]) if episode.n_steps else 1.0
    for row, (uav, colour) in enumerate(colours.items()):
        sent = np.flatnonzero(episode.sent[:, uav])
        begin, delay = episode.time[sent], episode.delay[sent, uav]
        late, lost = delay > 0, delay < 0
        at_once = begin[~lost & ~late]
        ends = np.stack([begin, begin + np.maximum(delay, 0) * dt], -1)[late]
        lines = [[(a, row), (b, row)] for a, b in ends]
        axis.add_collection(LineCollection(lines, colors=colour, linewidths=2.2, alpha=0.55))
        axis.plot(at_once, np.full(len(at_once), row), ".", color=colour, markersize=3, clip_on=False)
        axis.plot(ends[:, 1], np.full(len(ends), row), ">", color=colour, markersize=3.5)
        axis.plot(begin[lost], np.full(lost.sum(), row), "x", color=INK, markersize=4.5, clip_on=False)
    size = min(8.0, 50 * height_of_rows(len(colours)) / len(colours))
    axis.set_yticks(range(len(colours)), [_short(episode.names[uav]) for uav in colours], fontsize=size)
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
        _mark("UAV, as the server\nbelieves, with age", marker="o", markerfacecolor="none", markersize=9),
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
        marks += [Patch(label=f"source, chance {p:g}", fc=HEAT(_NORM(p)), ec=_EDGE) for p in (0.1, 0.001)]
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
    uavs = [uav for uav in frame.uavs if uav.chosen]
    rings = [(uav, uav.believed, f"{_short(uav.id)}, {uav.age:g} s") for uav in uavs if uav.age > 0]
    named = [*((uav, uav.path[-1], _short(uav.id)) for uav in uavs), *rings]
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


def _shades(uavs: list[Uav]) -> list[Any]:
    """Colours of the footprints of UAVs that are not told apart."""
    return [to_rgba(OTHER, 0.3 if uav.spots else 0.09) for uav in uavs]


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


def _chargers(episode: Episode) -> Floats:
    """Places where UAVs charge, if they do not charge everywhere: east, north [m], [2, P]."""
    return np.reshape(episode.about.get("charging_points", []), (-1, 2)).T


def _short(name: str) -> str:
    """A name that fits beside its row."""
    return name if len(name) <= 8 else f"{name[:7]}\N{HORIZONTAL ELLIPSIS}"


def _mark(label: str, color: str = "0.3", **style: Any) -> Line2D:
    """An entry of a legend."""
    return Line2D([], [], label=label, color=color, linestyle="", **style)
