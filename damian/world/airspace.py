"""Operative regions as padded tensors, with a test for inside a polygon and a search for landing
points."""

import math
from typing import NamedTuple

import numpy as np
import shapely
import torch
from numpy.typing import NDArray
from torch import Tensor

from damian.common import checks
from damian.common.tensors import gather_rows
from damian.world.config import RegionConfig
from damian.world.paths import Detours, detours
from damian.world.regions.polygon import (
    RESOLUTION,
    Area,
    Floats,
    landing_lattice,
    largest_vertex_distance,
)
from damian.world.regions.region import Region

_ID_BITS = 24
"""Bits of a landing point's id below its distance; a message cannot number more points either."""
_NEVER = torch.iinfo(torch.int64).max
_MOST_CELLS = 2048
"""Most columns, and rows, of the cells of a region."""
_SLOTS = 2**18
"""Distances computed at once, which bounds the memory: a few arrays of 2 MB, to stay in a CPU's
cache."""


class Cells(NamedTuple):
    """The landing points that may be nearest to a place, by the cell in which it lies: C in all, U
    used."""

    point: Tensor
    """Ids of landing points within their region, W for each used cell, -1 after the last, [U, W]
    int32."""
    row: Tensor
    """Row of each cell among these, [C] int32; 0 for cells that are not used."""
    first: Tensor
    """Index of the first cell of each region, [R]."""
    shape: Tensor
    """Number of columns and rows of a region's cells, [R, 2]."""
    corner: Tensor
    """Lower left corner of each region's cells, [R, 2] metres, float64."""
    side: Tensor
    """Side of a region's cells, [R, 1] metres, float64."""


class Airspace(NamedTuple):
    """``R`` operative regions with at most ``L`` landing points and ``E`` polygon edges each.

    A landing point's *flat id* is ``region * L + point``; padded points lie infinitely far away.

    Attributes:
        points, exact_points: landing points, [R, L, 2] metres east and north of the local origin of
            their region, in single and in double precision; the nearest ones are found by the
            latter.
        cells: those that may be nearest to a place.
        n_points: number of real landing points, [R].
        edges: polygon edges ``x1, y1, x2, y2`` (holes included), [R, E, 4] metres, double
            precision.
        scale: largest distance between two vertices, [R] metres; features divide distances by it.
        offset: place of the local origin in the coordinates of the settings, [R, 2] metres.
        detours: ways between landing points that are not straight; None if all are.
    """

    points: Tensor
    exact_points: Tensor
    cells: Cells
    n_points: Tensor
    edges: Tensor
    scale: Tensor
    offset: Tensor
    regions: tuple[Region, ...]
    detours: Detours | None

    @property
    def max_points(self) -> int:
        """Largest number of landing points in a region (L)."""
        return self.points.shape[1]

    def way(self, origin: Tensor, goal: Tensor) -> Tensor:
        """Places on the ways between landing points, flat ids [*], from end to end, [*, W, 2]
        metres."""
        points = self.points.flatten(0, 1)
        if self.detours is not None:
            return self.detours.way(origin, goal, points)
        start = gather_rows(points, origin)
        end = gather_rows(points, goal)
        return torch.stack([start, end], -2)

    def length(self, origin: Tensor, goal: Tensor) -> Tensor:
        """Lengths of the ways between landing points, flat ids [*], in m [*]; infinite if there is
        none."""
        points = self.points.flatten(0, 1)
        if self.detours is not None:
            return self.detours.length(origin, goal, points)
        way = gather_rows(points, goal) - gather_rows(points, origin)
        return torch.linalg.vector_norm(way, dim=-1)

    def nearest(self, places: Floats, region: int) -> Tensor:
        """The landing points nearest to places [P, 2] m, as ids within their region, [P]."""
        regions = torch.full((len(places),), region)
        target = torch.as_tensor(places)
        nearest = nearest_points(self.cells, self.exact_points, regions, target, 1)
        return nearest.squeeze(-1)


def build_airspace(
    regions: list[Region], config: RegionConfig, n_agents: int, longest: float = math.inf
) -> Airspace:
    """Lay the lattice of landing points over each region, as the settings of regions say.

    ``longest`` is the longest action [m]; landing points more than twice as far apart are not
    connected in a region that is not convex.
    """
    step = config.lattice_step
    polygons = [region.polygon for region in regions]
    lattices = [
        landing_lattice(polygon, step, config.lattice_angle, config.n_landing_points)
        for polygon in polygons
    ]
    sizes = [len(lattice) for lattice in lattices]
    for region, size in zip(regions, sizes, strict=True):
        checks.require(
            size >= n_agents,
            "agents",
            n_agents,
            f"UAVs are more than the {size} landing points of {region.name}",
        )
    points = _padded(lattices, torch.inf)
    edges = [_edges(polygon) for polygon in polygons]
    scales = [largest_vertex_distance(polygon) for polygon in polygons]
    offsets = [region.offset for region in regions]
    return Airspace(
        points=points.float(),
        exact_points=points,
        cells=build_cells(lattices, polygons, 2 * n_agents - 1),
        n_points=torch.tensor(sizes),
        # A padded edge has zero length, so the inside test never counts it.
        edges=_padded(edges, 0.0),
        scale=torch.tensor(scales, dtype=torch.float32),
        offset=torch.tensor(offsets, dtype=torch.float32),
        regions=tuple(regions),
        detours=detours(polygons, lattices, 2 * longest + step),
    )


def inside(edges: Tensor, target: Tensor) -> Tensor:
    """Whether targets [*, 2] lie in polygons (even-odd rule) of edges [*, E, 4]; [*] bool."""
    x1, y1, x2, y2 = edges.unbind(-1)
    x = target[..., :1]
    y = target[..., 1:]
    straddles = (y1 > y) != (y2 > y)
    # A horizontal edge divides by zero here, but it never straddles, so the result is not used.
    crossing = x1 + (y - y1) * (x2 - x1) / (y2 - y1)
    crossed = straddles & (x < crossing)
    odd = crossed.sum(-1) % 2
    return odd.bool()


def nearest_points(cells: Cells, points: Tensor, region: Tensor, target: Tensor, n: int) -> Tensor:
    """The ``n`` landing points nearest to each target [M, 2] m in its region [M], nearest first,
    [M, n].

    The nearest one is that at the smallest distance in whole centimetres and, of several, the one
    with the lowest id, so that ties do not depend on rounding errors. Ids are within the region; -1
    if there are fewer than n.
    """
    at_once = max(_SLOTS // cells.point.shape[1], 1)
    parts = zip(region.split(at_once), target.split(at_once), strict=True)
    return torch.cat([_nearest(cells, points, r, t, n) for r, t in parts])


def _nearest(cells: Cells, points: Tensor, region: Tensor, target: Tensor, n: int) -> Tensor:
    """As ``nearest_points``, all targets at once."""
    corner = gather_rows(cells.corner, region)
    side = gather_rows(cells.side, region)
    shape = gather_rows(cells.shape, region)
    first = gather_rows(cells.first, region)
    place = ((target - corner) / side).long()
    column, row = place.clamp(min=0).minimum(shape - 1).unbind(-1)
    cell = first + row * shape[:, 0] + column
    point = gather_rows(cells.point, gather_rows(cells.row, cell)).long()
    base = region * points.shape[1]
    flat = point.clamp(min=0) + base.unsqueeze(-1)
    way = gather_rows(points.flatten(0, 1), flat) - target.unsqueeze(1)
    east, north = way.unbind(-1)
    distance = (east * east + north * north).sqrt()
    # Half a centimetre is rounded up: the small term is far above rounding errors.
    centimetres = (100 * distance + 0.500001).long()
    order = (centimetres << _ID_BITS) + point
    order = order.masked_fill_(point < 0, _NEVER)
    best = order.topk(n, largest=False).values
    ids = best & (1 << _ID_BITS) - 1
    return torch.where(best == _NEVER, -1, ids)


def build_cells(lattices: list[Floats], polygons: list[Area], n: int) -> Cells:
    """List the landing points that may be among the n nearest ones of any place in each cell.

    The n points nearest to a cell's centre are at most half a diagonal farther from any place in
    the cell, so the n nearest ones of that place are at most two halves farther from the centre
    than the n-th of these.
    """
    tables = []
    rows_of_cells = []
    shapes = []
    corners = []
    sides = []
    n_used = 0
    for lattice, polygon in zip(lattices, polygons, strict=True):
        west, south, east, north = polygon.bounds
        width = east - west
        height = north - south
        usual = math.sqrt(polygon.area / len(lattice))
        # Otherwise a long and narrow polygon would have too many cells.
        side = max(usual, max(width, height) / _MOST_CELLS)
        half = side * math.sqrt(0.5) + RESOLUTION
        columns = int(width / side) + 1
        rows = int(height / side) + 1
        row, column = np.divmod(np.arange(columns * rows), columns)
        x = west + (column + 0.5) * side
        y = south + (row + 0.5) * side
        centre = np.stack([x, y], -1)
        used = shapely.dwithin(polygon, shapely.points(centre), half)
        most = min(n, len(lattice))
        cell, point = _within_reach(lattice, centre[used], most, side, 2 * half)
        slot = np.arange(len(cell)) - np.searchsorted(cell, cell)
        table = np.full((used.sum(), slot.max() + 1), -1)
        table[cell, slot] = point
        tables.append(table)
        number = n_used + np.cumsum(used) - 1
        rows_of_cells.append(np.where(used, number, 0))
        n_used += len(table)
        shapes.append((columns, rows))
        corners.append((west, south))
        sides.append([side])
    widest = max(table.shape[1] for table in tables)
    padded = []
    for table in tables:
        missing = widest - table.shape[1]
        padded.append(np.pad(table, ((0, 0), (0, missing)), constant_values=-1))
    ids = np.concatenate(padded).astype(np.int32)
    row_of_cell = np.concatenate(rows_of_cells).astype(np.int32)
    n_cells = [len(rows) for rows in rows_of_cells]
    first = np.cumsum([0, *n_cells])[:-1]
    return Cells(
        point=torch.as_tensor(ids),
        row=torch.as_tensor(row_of_cell),
        first=torch.as_tensor(first),
        shape=torch.tensor(shapes),
        corner=torch.tensor(corners, dtype=torch.float64),
        side=torch.tensor(sides, dtype=torch.float64),
    )


def _within_reach(
    lattice: Floats, place: Floats, n: int, side: float, farther: float
) -> NDArray[np.int64]:
    """Pairs, [2, P]: for each place the n nearest points, and those farther by up to
    ``farther``."""
    tree = shapely.STRtree(np.asarray(shapely.points(lattice)))
    targets = shapely.points(place)
    reach = np.full(len(place), side * math.sqrt(n / math.pi))
    while True:
        found = tree.query(targets, predicate="dwithin", distance=reach)[0]
        few = np.bincount(found, minlength=len(place)) < n
        if not few.any():
            pairs = tree.query(targets, predicate="dwithin", distance=reach + farther)
            return pairs[:, np.argsort(pairs[0], kind="stable")]
        reach[few] *= 1.25


def _edges(polygon: shapely.Geometry) -> np.ndarray:
    """Every edge of every ring, [E, 4] metres."""
    rings = shapely.get_rings(shapely.get_parts(polygon))
    edges = []
    for ring in rings:
        corners = shapely.get_coordinates(ring)
        start = corners[:-1]
        end = corners[1:]
        edges.append(np.hstack([start, end]))
    return np.concatenate(edges)


def _padded(arrays: list[np.ndarray], value: float) -> Tensor:
    """Stack arrays of different lengths, [R, longest, ...]."""
    longest = max(map(len, arrays))
    stacked = np.full((len(arrays), longest, *arrays[0].shape[1:]), value)
    for row, array in zip(stacked, arrays, strict=True):
        row[: len(array)] = array
    return torch.as_tensor(stacked)
