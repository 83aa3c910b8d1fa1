"""Polygons of operative regions and the landing points in them, in local metres
(paper, section 3.2).

Polygons may be concave, have holes or consist of several parts.
"""

import itertools
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import shapely
from numpy.random import Generator
from shapely.geometry import MultiPoint, MultiPolygon, Polygon

from damian.common import checks
from damian.common.errors import InputError
from damian.world.regions.geodesy import Floats

Area = Polygon | MultiPolygon
"""What a region covers, in one part or in several."""
RESOLUTION = 0.01
"""Distances of landing points that differ by less are not told apart [m]."""
MAX_CANDIDATES = 5_000_000
"""Largest number of lattice points in the bounding box of a polygon."""
_MAX_POINTS = 1000
"""Points drawn for a random polygon."""
_MAX_ROUNDS = 100
"""Attempts to draw points inside a polygon."""


def polygon_from_vertices(vertices: Sequence[Any], source: str) -> Polygon:
    """Build a polygon, convex or concave, from its corners in order around it, [V, 2] metres.

    The first may be repeated at the end. ``source`` begins error messages: a file, a line or a key.
    """
    for vertex in vertices:
        checks.place(source, vertex)
    return polygon_from_rings([np.array(vertices, dtype=np.float64)], source, "m")


def polygon_from_rings(rings: Sequence[Floats], source: str, unit: str) -> Polygon:
    """Build a polygon from its shell and holes, [V, 2] in ``unit`` each; refuse any that is not
    valid.

    ``source`` and ``unit`` are for error messages.
    """
    shell, *holes = [_require_area(ring, source) for ring in rings]
    polygon = Polygon(shell, holes)
    if not polygon.is_valid:
        reason, _, place = shapely.is_valid_reason(polygon).rstrip("]").partition("[")
        reason = "edges cross" if "self-intersection" in reason.lower() else reason.lower()
        remedy = "list the corners in order around the polygon, and holes inside its shell"
        raise InputError(f"{source}: {reason} at [{', '.join(place.split())}] {unit}; {remedy}")
    return polygon


def random_polygon(rng: Generator, min_area_m2: float, max_area_m2: float) -> Polygon:
    """Draw a random convex polygon: the hull of points uniform in the disc of area ``max_area_m2``.

    The hull grows by one point at a time until its area reaches ``min_area_m2``; if a thousand
    points do not suffice, it is scaled up to the mean of the two areas.
    """
    points = _disc(rng, max_area_m2, _MAX_POINTS)
    hull = _hull(points[:3])
    for point in points[3:]:
        if hull.area >= min_area_m2:
            return hull
        hull = _hull(np.vstack([shapely.get_coordinates(hull), point]))
    if hull.area >= min_area_m2:
        return hull
    scale = np.sqrt((min_area_m2 + max_area_m2) / 2 / hull.area)
    return _hull(scale * shapely.get_coordinates(hull))


def largest_vertex_distance(polygon: Area) -> float:
    """Largest distance between two vertices [m], by which features divide distances."""
    corners = shapely.get_coordinates(shapely.convex_hull(polygon))
    return max(float(np.hypot(*(corners - corner).T).max()) for corner in corners)


def landing_lattice(
    polygon: Area, step_m: float, degrees: float, n_points: int | None = None
) -> Floats:
    """Lay a serpentine lattice over the polygon; its points inside the polygon are the landing
    points.

    Points are ``step_m`` [m] apart in a row and rows ``step_m sin(degrees)`` apart, with a slant in
    (0, 90] deg, so no two points coincide. The ``n_points`` nearest to the centroid are kept, or
    all. A landing point's id is its row in the result, [L, 2] metres. They are ordered
    counter-clockwise about the centroid from due west, with due west itself last; of two in one
    direction, the nearer comes first.
    """
    lattice = _lattice(polygon.bounds, step_m, np.radians(degrees))
    shapely.prepare(polygon)
    inside = lattice[shapely.contains_xy(polygon, lattice)]
    checks.require(
        len(inside) > 0,
        "region.lattice_step",
        f"{step_m:g} m",
        f"lays no landing point inside the polygon of {polygon.area:g} m^2; take a shorter one",
    )
    if n_points is not None:
        remedy = f"lower it, or region.lattice_step ({step_m:g} m)"
        checks.require(
            n_points <= len(inside),
            "region.n_landing_points",
            n_points,
            f"is more than the {len(inside)} inside the polygon: {remedy}",
        )
    return _by_direction(inside, shapely.get_coordinates(polygon.centroid)[0], n_points)


def sample_interior(polygon: Area, n: int, rng: Generator) -> Floats:
    """Draw points uniformly in the polygon, strictly inside, [n, 2] metres.

    First a triangle of its constrained Delaunay triangulation is drawn by area, then a point in it
    (Osada et al., "Shape Distributions", 2002, eq. 1). Points that rounding has put on the boundary
    are drawn again.
    """
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    corners = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]
    share = shapely.area(triangles)
    shapely.prepare(polygon)
    points = np.empty((0, 2))
    for _ in range(_MAX_ROUNDS if share.sum() > 0 else 0):
        triangle = rng.choice(len(share), n - len(points), p=share / share.sum())
        a, b, c = corners[triangle].swapaxes(0, 1)
        root = np.sqrt(rng.random((len(a), 1)))
        along = rng.random((len(a), 1))
        drawn = (1 - root) * a + root * (1 - along) * b + root * along * c
        points = np.vstack([points, drawn[shapely.contains_xy(polygon, drawn)]])
        if len(points) == n:
            return points
    raise InputError(f"polygon: {polygon.area:g} m^2 has no inside to draw {n} points from")


def _require_area(corners: Floats, source: str) -> Floats:
    """Return the corners if they enclose an area."""
    n_distinct = len(np.unique(corners, axis=0))
    if n_distinct < 3:
        raise InputError(f"{source}: {n_distinct} distinct points; a polygon needs at least 3")
    # The hull, not the ring itself: a bow tie has zero area too, but its fault is that its edges
    # cross.
    if _hull(corners).area <= 1e-12 * np.ptp(corners, axis=0).max() ** 2:
        raise InputError(f"{source}: no area: all {len(corners)} points lie on one line")
    return corners


def _hull(corners: Floats) -> Polygon:
    """Convex hull of points [V, 2]; its area is zero if they lie on one line."""
    return cast(Polygon, MultiPoint(corners).convex_hull)


def _disc(rng: Generator, area_m2: float, n: int) -> Floats:
    """Draw points [n, 2] uniformly in the disc of the given area about (0, 0)."""
    radius = np.sqrt(area_m2 / np.pi * rng.random(n))
    angle = 2 * np.pi * rng.random(n)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def _lattice(bounds: tuple[float, float, float, float], step: float, slant: float) -> Floats:
    """All lattice points in the bounding box and a margin around it, row by row, [P, 2]."""
    min_x, min_y, max_x, max_y = bounds
    width = max_x - min_x
    height = max_y - min_y
    rise = step * np.sin(slant)
    # Compared as products, since a quotient by a tiny step could overflow.
    if (width + 4 * step) * (height + rise) > MAX_CANDIDATES * step * rise:
        problem = (
            f"is too fine for a polygon of {width:g} m x {height:g} m: over {MAX_CANDIDATES} points"
        )
        raise InputError(f"region.lattice_step: {step:g} m {problem}; take a longer one")
    rows = []
    start = min_x
    ends = itertools.cycle([(max_x, 1), (min_x, -1)])
    for y, (end, sign) in zip(min_y + rise * np.arange(int(height / rise) + 1), ends, strict=False):
        # A bound missed by a rounding error counts as reached.
        n_steps = int(np.ceil(sign * (end - start) / step - 1e-9))
        x = start + sign * step * np.arange(n_steps + 1)
        rows.append(np.column_stack([x, np.full_like(x, y)]))
        start = x[-1] + 2 * sign * step * np.cos(slant)
    return np.concatenate(rows)


def _by_direction(points: Floats, centre: Floats, n: int | None) -> Floats:
    """The ``n`` points nearest to the centre (all if not given), counter-clockwise from due west,
    [n, 2]."""
    # Rounded, so that ties are ties on every machine; 0.0 removes negative zeros, which would move
    # due west.
    x, y = (np.round(points - centre, 9) + 0.0).T
    distance = np.round(np.hypot(x, y), 6)
    angle = np.round(np.arctan2(y, x), 12)
    order = np.lexsort([distance, angle])
    nearest = np.argsort(distance[order], kind="stable")[:n]
    return points[order[np.sort(nearest)]]
