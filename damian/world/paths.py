"""Flights around what is in the way: shortest paths between landing points that do not leave the
region.

Zones where nobody flies are holes of the region. Where the straight way between two landing points
leaves the region or enters a hole, a UAV flies the shortest path around, which bends at corners
only (de Berg et al., "Computational Geometry", 2008, section 15.1). All such paths are computed
once.
"""

from typing import NamedTuple

import numpy as np
import shapely
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree
from shapely.geometry import MultiPolygon, Polygon
from torch import Tensor

from damian.common.tensors import gather_rows
from damian.world.regions.geodesy import Floats

_CONVEX = 1e-9
"""Share of the area of its hull that a polygon without dents may lack."""


class Detours(NamedTuple):
    """The ways between landing points that are not straight, P of them, with at most C corners
    each."""

    pair: Tensor
    """Which landing points each connects, ``origin * M + goal`` of M flat ids, ascending, [P]."""
    corners: Tensor
    """Where each bends, in order, [P + 1, C, 2] metres; NaN after the last; last a row of none."""
    reached: Tensor
    """Whether the way leads to the goal at all, [P + 1]."""
    n_points: int
    """Number of landing points of all regions, M."""
    longest: float
    """Pairs farther apart than this were not looked at [m]."""

    def row(self, origin: Tensor, goal: Tensor) -> Tensor:
        """The detour from each landing point to another, flat ids [*], or P for a straight way,
        [*]."""
        wanted = origin * self.n_points + goal
        found = torch.searchsorted(self.pair, wanted).clamp(max=len(self.pair) - 1)
        return torch.where(self.pair.take(found) == wanted, found, len(self.pair))

    def way(self, origin: Tensor, goal: Tensor, points: Tensor) -> Tensor:
        """Places on the ways between landing points, from one to the other, [*, C + 2, 2]
        metres."""
        return self._along(self.row(origin, goal), origin, goal, points)

    def _along(self, row: Tensor, origin: Tensor, goal: Tensor, points: Tensor) -> Tensor:
        first = gather_rows(points, origin).unsqueeze(-2)
        last = gather_rows(points, goal).unsqueeze(-2)
        corners = gather_rows(self.corners, row)
        return torch.cat([first, torch.where(corners.isnan(), last, corners), last], -2)

    def length(self, origin: Tensor, goal: Tensor, points: Tensor) -> Tensor:
        """Lengths of the ways between landing points [m], [*]; infinite where none leads to the
        goal."""
        row = self.row(origin, goal)
        way = self._along(row, origin, goal, points)
        straight = torch.linalg.vector_norm(way[..., -1, :] - way[..., 0, :], dim=-1)
        leads = gather_rows(self.reached, row) & (straight <= self.longest)
        return torch.linalg.vector_norm(way.diff(dim=-2), dim=-1).sum(-1).where(leads, torch.inf)


def detours(
    polygons: list[Polygon | MultiPolygon], points: list[Floats], longest: float
) -> Detours | None:
    """The detours between landing points [L_r, 2] m of each region; None if all ways are straight.

    Only pairs are looked at that are at most ``longest`` [m] apart.
    """
    most = max(map(len, points))
    found = []
    for region, (polygon, places) in enumerate(zip(polygons, points, strict=True)):
        if shapely.convex_hull(polygon).area - polygon.area <= _CONVEX * polygon.area:
            continue
        near = KDTree(places).query_pairs(longest, output_type="ndarray")
        shapely.prepare(polygon)
        near = near[~_visible(polygon, places[near[:, 0]], places[near[:, 1]])]
        if len(near):
            blocked = np.concatenate([near, near[:, ::-1]])
            blocked = blocked[np.lexsort(blocked.T[::-1])]
            found.append((blocked + region * most, *_shortest(polygon, places, blocked)))
    if not found:
        return None
    widest = max(corners.shape[1] for _, corners, _ in found)
    n_points = most * len(points)
    padded = [
        np.pad(each, ((0, 0), (0, widest - each.shape[1]), (0, 0)), constant_values=np.nan)
        for _, each, _ in found
    ]
    pairs, reached = (np.concatenate([each[i] for each in found]) for i in (0, 2))
    return Detours(
        torch.as_tensor(pairs[:, 0] * n_points + pairs[:, 1]),
        torch.as_tensor(
            np.concatenate([*padded, np.full((1, widest, 2), np.nan)]), dtype=torch.float32
        ),
        torch.as_tensor(np.append(reached, True)),
        n_points,
        longest,
    )


def _shortest(
    polygon: shapely.Geometry, points: Floats, pairs: NDArray[np.int64]
) -> tuple[Floats, NDArray]:
    """Corners [P, C, 2] of the shortest paths between pairs [P, 2], NaN after the last; which
    exist."""
    corners = _dents(polygon)
    ends, index = np.unique(pairs, return_inverse=True)
    origin, goal = index.reshape(pairs.shape).T + len(corners)
    places = np.concatenate([corners, points[ends]])
    # Straight ways from each corner to each place; others than corners are never passed.
    straight = np.full((len(corners), len(places)), np.inf)
    one, other = np.divmod(np.arange(straight.size), len(places))
    seen = (one != other) & _visible(polygon, places[one], places[other])
    one, other = (
        each[seen].astype(np.int32) for each in (one, other)
    )  # scipy 1.14 takes no others
    straight[one, other] = np.linalg.norm(places[one] - places[other], axis=1)
    graph = csr_array((straight[one, other], (one, other)), shape=(len(places),) * 2)
    along, before = dijkstra(graph, indices=np.arange(len(corners)), return_predecessors=True)
    first = np.zeros(len(pairs), int)
    length = np.full(len(pairs), np.inf)
    for corner in range(len(corners)):
        by = straight[corner, origin] + along[corner, goal]
        first = np.where(by < length, corner, first)
        length = np.minimum(by, length)
    # Each path is followed from its goal back to its first corner.
    path = []
    here = np.where(np.isfinite(length), goal, first)
    while ((here := np.where(here == first, first, before[first, here])) != first).any():
        path.append(np.where(here == first, -1, here))
    passed = np.stack([np.where(np.isfinite(length), first, -1), *path[::-1]], 1)
    passed = np.take_along_axis(passed, np.argsort(passed < 0, axis=1, kind="stable"), 1)
    return np.where(passed[..., None] < 0, np.nan, places[passed]), np.isfinite(length)


def _visible(polygon: shapely.Geometry, origin: Floats, goal: Floats) -> NDArray[np.bool_]:
    """Whether the straight ways between places [Q, 2] m stay in the polygon, [Q]."""
    return np.asarray(shapely.covers(polygon, shapely.linestrings(np.stack([origin, goal], 1))))


def _dents(polygon: shapely.Geometry) -> Floats:
    """The corners about which a shortest path may bend, those that point into the polygon, [V, 2]
    metres."""
    found = []
    for ring in shapely.get_rings(
        shapely.get_parts(shapely.orient_polygons(polygon))
    ):  # inside on the left
        corner = shapely.get_coordinates(ring)[:-1]
        (x, y), (u, v) = (corner - np.roll(corner, 1, 0)).T, (np.roll(corner, -1, 0) - corner).T
        found.append(corner[x * v - y * u < 0])
    return np.concatenate(found)
