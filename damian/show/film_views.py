"""The two views of a film: a map, and the space above it. Each draws the instants of an episode into axes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Circle, PathPatch, Rectangle
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Affine2D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from damian.show.episode import Episode, Floats

TRAIL = 8
"""Number of steps whose path is drawn behind a UAV."""
TURN = 0.7
"""Angle by which the space turns in each step [deg]."""
INK = "#222222"
HEAT = LinearSegmentedColormap.from_list("belief", [(0.45, 0.2, 0.6, 0.0), (0.45, 0.2, 0.6, 0.75)])
"""Colours of the belief about the source."""
DART = Path([[0.0, 1.0], [0.62, -0.8], [0.0, -0.42], [-0.62, -0.8], [0.0, 1.0]])
"""Outline of a UAV that flies to the north."""
_LAND, _EDGE, _POINT = "#f5f2ea", "#8a8474", "#cfc8b8"
_CORNERS = 48
"""Corners of a footprint in space."""


class MapView:
    """The region from above.

    Args:
        axis: where to draw.
        episode: what to draw.
        colours: of the UAVs.
    """

    def __init__(self, axis: Axes, episode: Episode, colours: Sequence[str]) -> None:
        self.axis, self.episode, self.colours = axis, episode, colours
        self.edge = 0.0 if episode.cells is None else episode.cell_edge
        style = {"facecolor": _LAND, "edgecolor": _EDGE, "linewidth": 1.2, "zorder": 0}
        self.land = PathPatch(_outline(episode.region), **style)
        axis.add_patch(self.land)
        axis.plot(*episode.landing_points.T, ".", color=_POINT, markersize=2, zorder=1)
        (west, south), (east, north) = limits(episode)
        axis.set(xlim=(west, east), ylim=(south, north), aspect="equal", anchor="W")
        axis.set(xlabel="east [m]", ylabel="north [m]")
        axis.xaxis.set_major_locator(MaxNLocator(6))
        axis.yaxis.set_major_locator(MaxNLocator(6))

    def draw(self, step: int) -> list[Any]:
        """Draw the instant after so many steps; returns the artists that were drawn."""
        uavs = [artist for uav in range(self.episode.n_agents) for artist in self._uav(step, uav)]
        return [*self._belief(step), *self._source(step), *uavs]

    def _belief(self, step: int) -> list[Any]:
        likely, edge = self.episode.likely_cells(step), self.edge
        if not len(likely):
            return []
        corners = np.asarray(self.episode.cells)[likely] - edge / 2
        squares = [Rectangle((x, y), edge, edge) for x, y in corners]
        heat = PatchCollection(squares, facecolor=shades(self.episode, step), edgecolor="none", zorder=0.5)
        self.axis.add_collection(heat)
        heat.set_clip_path(self.land)
        return [heat]

    def _source(self, step: int) -> list[Any]:
        return _draw_source(self.axis, self.episode, step, (), {"markersize": 13, "zorder": 6})

    def _uav(self, step: int, uav: int) -> list[Any]:
        """Draw a UAV with its path and footprint, and where the server believes it to be."""
        episode, colour, axis = self.episode, self.colours[uav], self.axis
        true, held = episode.true[step, uav], episode.believed[step, uav]
        strength, edge = (0.26, 1.6) if episode.spotted[step, uav] else (0.07, 0.5)
        inside = Circle(tuple(true), episode.radius, facecolor=colour, alpha=strength, linewidth=0, zorder=2)
        ring = Circle(tuple(true), episode.radius, fill=False, edgecolor=colour, linewidth=edge, zorder=2.1)
        parts, fading = _trail(episode.true[:, uav], step)
        trail = LineCollection(parts, colors=colour, alpha=fading, linewidths=1.6, zorder=3)
        drawn: list[Any] = [axis.add_collection(trail), axis.add_patch(inside), axis.add_patch(ring)]
        dart = DART.transformed(Affine2D().rotate(-float(episode.track[step, uav])))
        style = {"markersize": 13, "markeredgecolor": "white", "markeredgewidth": 0.6, "zorder": 5}
        drawn += axis.plot(*true, marker=dart, color=colour, **style)
        if episode.age[step, uav] > 0:
            drawn += axis.plot(*np.stack([true, held]).T, ":", color=colour, linewidth=1.1, zorder=3)
            hollow = {"markerfacecolor": "none", "markersize": 12, "markeredgewidth": 1.5, "zorder": 4}
            drawn += axis.plot(*held, "o", color=colour, **hollow)
            label, style = _age(episode, step, uav), {"fontsize": 7.5, "color": colour, "zorder": 7}
            drawn.append(axis.annotate(label, tuple(held), (8, 7), textcoords="offset points", **style))
        return drawn


class SpaceView:
    """The region and the space above it, which turns slowly.

    Args:
        axis: where to draw, with projection ``3d``.
        episode: what to draw.
        colours: of the UAVs.
    """

    def __init__(self, axis: Any, episode: Episode, colours: Sequence[str]) -> None:
        self.axis, self.episode, self.colours = axis, episode, colours
        axis.computed_zorder = False  # the middle of the large ground says nothing about what it hides
        for part in shapely.get_parts(episode.region):
            shell, *holes = [shapely.get_coordinates(ring) for ring in shapely.get_rings(part)]
            for ring, fill in [(shell, _LAND), *((hole, "white") for hole in holes)]:
                style = {"facecolor": fill, "edgecolor": _EDGE, "linewidth": 1.0, "zorder": 0}
                axis.add_collection3d(Poly3DCollection([_on_ground(ring)], **style))
        axis.plot(*episode.landing_points.T, 0, ".", color=_POINT, markersize=1.5, zorder=1)
        self.squares = _squares(episode)
        (west, south), (east, north) = limits(episode)
        height = 1.1 * max(float(episode.position[..., 2].max()), 1.0)
        axis.set(xlim=(west, east), ylim=(south, north), zlim=(0, height))
        size, share = np.array([east - west, north - south]), 0.35
        axis.set_box_aspect((*size / size.max(), share), zoom=1.3)
        axis.set_position((-0.04, 0.2, 0.80, 0.74))
        axis.set_axis_off()
        scale = f"{size[0]:.0f} m x {size[1]:.0f} m, heights {share * size.max() / height:.0f} times as large"
        axis.text2D(0.08, 0.02, scale, transform=axis.transAxes, fontsize=7.5, color="0.4")

    def draw(self, step: int) -> list[Any]:
        """Draw the instant after so many steps; returns the artists that were drawn."""
        self.axis.view_init(elev=34, azim=-65 + TURN * step)
        uavs = [artist for uav in range(self.episode.n_agents) for artist in self._uav(step, uav)]
        source = _draw_source(self.axis, self.episode, step, (0,), {"markersize": 12, "zorder": 5})
        return [*self._belief(step), *source, *uavs]

    def _belief(self, step: int) -> list[Any]:
        likely = zip(self.episode.likely_cells(step), shades(self.episode, step), strict=True)
        pieces = [(square, colour) for cell, colour in likely for square in self.squares[cell]]
        if not pieces:
            return []
        squares, colours = [square for square, _ in pieces], [colour for _, colour in pieces]
        return [self.axis.add_collection3d(Poly3DCollection(squares, facecolor=colours, zorder=0.5))]

    def _uav(self, step: int, uav: int) -> list[Any]:
        """Draw a UAV with its path, what it stands above, and where the server believes it to be."""
        episode, colour, axis = self.episode, self.colours[uav], self.axis
        (x, y, z), held = episode.position[step, uav], episode.believed[step, uav]
        turns = np.linspace(0, 2 * np.pi, _CORNERS, endpoint=False)
        circle = episode.true[step, uav] + episode.radius * np.stack([np.cos(turns), np.sin(turns)], -1)
        strength = 0.35 if episode.spotted[step, uav] else 0.12
        footprint = Poly3DCollection([_on_ground(circle)], facecolor=colour, alpha=strength, zorder=2)
        parts, fading = _trail(episode.position[:, uav], step)
        drawn = [
            axis.add_collection3d(footprint),
            *axis.plot([x, x], [y, y], [0, z], color=colour, lw=0.8, zorder=6),
        ]
        if parts:
            trail = Line3DCollection(parts, colors=colour, alpha=fading, linewidths=1.6, zorder=6)
            drawn.append(axis.add_collection3d(trail))
        style = {"markersize": 8, "markeredgecolor": "white", "markeredgewidth": 0.6, "zorder": 7}
        drawn += axis.plot(x, y, z, "o", color=colour, **style)
        if episode.age[step, uav] > 0:
            hollow = {"markerfacecolor": "none", "markersize": 11, "markeredgewidth": 1.5, "zorder": 4}
            drawn += axis.plot(*held, 0, "o", color=colour, **hollow)
            label, style = f"   {_age(episode, step, uav)}", {"fontsize": 7.5, "color": colour, "zorder": 8}
            drawn.append(axis.text(*held, 0, label, **style))
        return drawn


def _draw_source(
    axis: Any, episode: Episode, step: int, height: tuple[float, ...], style: dict[str, Any]
) -> list[Any]:
    """Draw the source, filled while it emits, if anybody knows it."""
    if episode.source is None or episode.emits is None:
        return []
    fill = INK if episode.emits[step] else "white"
    return axis.plot(*episode.source[step], *height, "*", color=INK, markerfacecolor=fill, **style)


def limits(episode: Episode) -> tuple[Floats, Floats]:
    """Lower left and upper right corner of what a view shows, east and north [m]."""
    west, south, east, north = episode.region.bounds
    margin = max(0.06 * max(east - west, north - south), 0.5 * episode.radius)
    return np.array([west, south]) - margin, np.array([east, north]) + margin


def shades(episode: Episode, step: int) -> Floats:
    """Colours of the likely cells, [C, 4]."""
    if episode.belief is None:
        return np.zeros((0, 4))
    share = episode.belief[step] / max(float(episode.belief[step].max()), 1e-9)
    return np.asarray(HEAT(share[episode.likely_cells(step)] ** 0.7))


def _squares(episode: Episode) -> list[list[Floats]]:
    """What of each of the K cells lies in the region, as polygons on the ground."""
    if episode.cells is None:
        return []
    half = episode.cell_edge / 2
    boxes = shapely.box(*(episode.cells - half).T, *(episode.cells + half).T)
    parts = [shapely.get_parts(part) for part in shapely.intersection(boxes, episode.region)]
    return [
        [_on_ground(shapely.get_coordinates(p)) for p in cell if p.geom_type == "Polygon"] for cell in parts
    ]


def _trail(path: Floats, step: int) -> tuple[list[Floats], Floats | None]:
    """The latest parts of a path [T + 1, D], [2, D] each, and how strong each is drawn."""
    latest = path[max(step - TRAIL, 0) : step + 1]
    parts = list(np.stack([latest[:-1], latest[1:]], 1))
    return parts, np.linspace(0.1, 0.7, len(parts)) if parts else None


def _age(episode: Episode, step: int, uav: int) -> str:
    return f"{episode.age[step, uav]:g} s"


def _on_ground(corners: Floats) -> Floats:
    """Places [C, 2] as points on the ground, [C, 3]."""
    return np.column_stack([corners, np.zeros(len(corners))])


def _outline(region: shapely.Polygon | shapely.MultiPolygon) -> Path:
    """A region with its holes as a path."""
    rings = shapely.get_rings(shapely.get_parts(shapely.orient_polygons(region)))
    return Path.make_compound_path(*[Path(shapely.get_coordinates(ring), closed=True) for ring in rings])
