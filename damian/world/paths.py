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
from torch import Tensor

from damian.common.tensors import gather_rows
from damian.world.regions.geodesy import Floats
from damian.world.regions.polygon import Area

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
        n_pairs = len(self.pair)
        found = torch.searchsorted(self.pair, wanted).clamp(max=n_pairs - 1)
        return torch.where(self.pair.take(found) == wanted, found, n_pairs)

    def way(self, origin: Tensor, goal: Tensor, points: Tensor) -> Tensor:
        """Places on the ways between landing points, from one to the other, [*, C + 2, 2]
        metres."""
        return self._along(self.row(origin, goal), origin, goal, points)

    def _along(self, row: Tensor, origin: Tensor, goal: Tensor, points: Tensor) -> Tensor:
        first = gather_rows(points, origin).unsqueeze(-2)
        last = gather_rows(points, goal).unsqueeze(-2)
        corners = gather_rows(self.corners, row)
        between = torch.where(corners.isnan(), last, corners)
        return torch.cat([first, between, last], -2)

    def length(self, origin: Tensor, goal: Tensor, points: Tensor) -> Tensor:
        """Lengths of the ways between landing points [m], [*]; infinite where none leads to the
        goal."""
        row = self.row(origin, goal)
        way = self._along(row, origin, goal, points)
        legs = torch.linalg.vector_norm(way.diff(dim=-2), dim=-1)
        between = way[..., -1, :] - way[..., 0, :]
        near = torch.linalg.vector_norm(between, dim=-1) <= self.longest
        leads = near & gather_rows(self.reached, row)
        return legs.sum(-1).where(leads, torch.inf)


def detours(polygons: list[Area], points: list[Floats], longest: float) -> Detours | None:
    """The detours between landing points [L_r, 2] m of each region; None if all ways are straight.

    Only pairs are looked at that are at most ``longest`` [m] apart.
    """
    most = max(map(len, points))
    n_points = most * len(points)
    pairs = []
    corners = []
    reached = []
    for region, (polygon, places) in enumerate(zip(polygons, points, strict=True)):
        lacking = shapely.convex_hull(polygon).area - polygon.area
        if lacking <= _CONVEX * polygon.area:
            continue
        near = KDTree(places).query_pairs(longest, output_type="ndarray")
        shapely.prepare(polygon)
        one, other = near.T
        near = near[~_visible(polygon, places[one], places[other])]
        if len(near):
            blocked = np.concatenate([near, near[:, ::-1]])
            one, other = blocked.T
            blocked = blocked[np.lexsort((other, one))]
            bends, leads = _shortest(polygon, places, blocked)
            origin, goal = (blocked + region * most).T
            pairs.append(origin * n_points + goal)
            corners.append(bends)
            reached.append(leads)
    if not pairs:
        return None
    widest = max(each.shape[1] for each in corners)
    # The last row is that of a straight way.
    rows = sum(map(len, corners)) + 1
    padded = np.full((rows, widest, 2), np.nan)
    start = 0
    for each in corners:
        end = start + len(each)
        padded[start:end, : each.shape[1]] = each
        start = end
    return Detours(
        pair=torch.as_tensor(np.concatenate(pairs)),
        corners=torch.as_tensor(padded, dtype=torch.float32),
        reached=torch.as_tensor(np.concatenate([*reached, [True]])),
        n_points=n_points,
        longest=longest,
    )


def _shortest(
    polygon: shapely.Geometry, points: Floats, pairs: NDArray[np.int64]
) -> tuple[Floats, NDArray]:
    """Corners [P, C, 2] of the shortest paths between pairs [P, 2], NaN after the last; which
    exist."""
    corners = _dents(polygon)
    n_corners = len(corners)
    ends, index = np.unique(pairs, return_inverse=True)
    origin, goal = index.reshape(pairs.shape).T + n_corners
    places = np.concatenate([corners, points[ends]])
    n_places = len(places)
    # Straight ways from each corner to each place; others than corners are never passed.
    straight = np.full((n_corners, n_places), np.inf)
    one, other = np.divmod(np.arange(straight.size), n_places)
    seen = (one != other) & _visible(polygon, places[one], places[other])
    one = one[seen].astype(np.int32)  # scipy 1.14 takes no others
    other = other[seen].astype(np.int32)
    ways = np.linalg.norm(places[one] - places[other], axis=1)
    straight[one, other] = ways
    graph = csr_array((ways, (one, other)), shape=(n_places, n_places))
    along, before = dijkstra(graph, indices=np.arange(n_corners), return_predecessors=True)
    first = np.zeros(len(pairs), int)
    length = np.full(len(pairs), np.inf)
    for corner in range(n_corners):
        by = straight[corner, origin] + along[corner, goal]
        first = np.where(by < length, corner, first)
        length = np.minimum(by, length)
    reached = np.isfinite(length)
    # Each path is followed from its goal back to its first corner.
    path = []
    here = np.where(reached, goal, first)
    while True:
        here = np.where(here == first, first, before[first, here])
        arrived = here == first
        if arrived.all():
            break
        path.append(np.where(arrived, -1, here))
    path.append(np.where(reached, first, -1))
    passed = np.stack(path[::-1], 1)
    order = np.argsort(passed < 0, axis=1, kind="stable")
    passed = np.take_along_axis(passed, order, 1)
    none = passed[..., None] < 0
    return np.where(none, np.nan, places[passed]), reached


def _visible(polygon: shapely.Geometry, origin: Floats, goal: Floats) -> NDArray[np.bool_]:
    """Whether the straight ways between places [Q, 2] m stay in the polygon, [Q]."""
    ways = shapely.linestrings(np.stack([origin, goal], 1))
    return np.asarray(shapely.covers(polygon, ways))


def _dents(polygon: shapely.Geometry) -> Floats:
    """The corners about which a shortest path may bend, those that point into the polygon, [V, 2]
    metres."""
    found = []
    oriented = shapely.orient_polygons(polygon)  # inside on the left
    parts = shapely.get_parts(oriented)
    for ring in shapely.get_rings(parts):
        corner = shapely.get_coordinates(ring)[:-1]
        before = np.roll(corner, 1, 0)
        after = np.roll(corner, -1, 0)
        x, y = (corner - before).T
        u, v = (after - corner).T
        turn = x * v - y * u
        found.append(corner[turn < 0])
    return np.concatenate(found)
