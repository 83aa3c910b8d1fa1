"""Operative regions in local metres about their centroid, and places that settings give in them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import shapely

from damian.common import checks
from damian.common.errors import InputError
from damian.common.text_files import one_line
from damian.world.regions.geodesy import Floats, LatLon, area_centroid, to_local
from damian.world.regions.polygon import Area, polygon_from_rings

_SLACK = 1e-6
"""Share of the area of a region that may lie between edges which cross once laid out in metres."""


@dataclass(frozen=True)
class Region:
    """Region that the UAVs fly over.

    Attributes:
        polygon: in local metres, x east and y north. The worlds compute in these coordinates.
        name: its name in the file, or one made up from its kind.
        origin: (latitude, longitude) of the local origin (0, 0) in degrees; ``None`` for a region
            without a position on Earth.
        levels: lowest and highest flight level [FL, hundreds of feet]; ``None`` if not known.
        offset: place of the local origin in the coordinates of the settings (east, north) [m]; not
            (0, 0) if vertices were given, or drawn, about another origin.
    """

    polygon: Area
    name: str
    origin: LatLon | None = None
    levels: tuple[float, float] | None = None
    offset: tuple[float, float] = (0.0, 0.0)


def centred(region: Region) -> Region:
    """The region in metres about its centroid; one with a position on Earth is so already.

    Corners are rounded to a grid of 1/65536 m about the lower left one, so that the same shape has
    the same local coordinates, bit for bit, wherever its origin lies.
    """
    if region.origin is not None:
        return region
    corner = np.array(region.polygon.bounds[:2])
    polygon = shapely.transform(region.polygon, lambda xy: to_grid(xy - corner))
    centroid = to_grid(shapely.get_coordinates(polygon.centroid)[0])
    reason = shapely.is_valid_reason(polygon)
    checks.require(
        polygon.is_valid, region.name, reason, "[m] once rounded to 1/65536 m: draw it larger"
    )
    east, north = (corner + centroid).tolist()
    polygon = shapely.transform(polygon, lambda xy: xy - centroid)
    return replace(
        region, polygon=polygon, offset=(region.offset[0] + east, region.offset[1] + north)
    )


def to_grid(metres: Floats) -> Floats:
    """Lengths [*] rounded to 1/65536 m."""
    return np.round(metres * 65536) / 65536


def local_places(key: str, places: Sequence[Any], region: Region) -> Floats:
    """Places of the settings in local metres of a region, [P, 2]; all of them must lie inside.

    Each is ``[x, y]``, metres east and north in the coordinates in which the region is given
    (those of ``region.vertices``; of a file: about the area's centroid), or, where a file gives the
    region,
    ``{lat: 53.1, lon: -4.5}`` in degrees. ``key`` is that of the setting, for errors.
    """
    local = to_local_places(key, places, region)
    inside = shapely.contains_xy(region.polygon, local)
    if not inside.all():
        first = int(np.argmin(inside))
        given, (x, y) = places[first], local[first]
        shown = f"{given} (at [{x:g}, {y:g}] m)" if isinstance(given, Mapping) else f"{[*given]} m"
        west, south, east, north = np.round(np.tile(region.offset, 2) + region.polygon.bounds, 2)
        bounds = f"x {west:.10g} to {east:.10g} m, y {south:.10g} to {north:.10g} m"
        raise InputError(f"{key}: {shown} is not inside {region.name} ({bounds})")
    return local


def to_local_places(key: str, places: Sequence[Any], region: Region) -> Floats:
    """As ``local_places``, but they may lie anywhere."""
    return np.array([_local_place(key, place, region) for place in places])


def _local_place(key: str, place: Any, region: Region) -> Floats:
    """A place in local metres, [2]."""
    if not isinstance(place, Mapping):
        return to_grid(np.array(place, float) - region.offset)
    checks.require(
        region.origin is not None,
        key,
        place,
        f"has latitude and longitude, but {region.name} has no position on Earth: give [x, y] in "
        "metres, or take a region from a FIR table or GeoJSON file",
    )
    return np.stack(to_local(place["lat"], place["lon"], cast(LatLon, region.origin)))


def local_region(
    parts: Sequence[Sequence[Floats]],
    name: str,
    levels: tuple[float, float] | None,
    source: str,
    excluded: Sequence[Sequence[Floats]] = (),
) -> Region:
    """Build a region in metres about the centroid of its area on the sphere from polygon parts in
    degrees.

    Edges are straight in local metres: nearly great circles, not parallels of latitude. ``source``
    begins error messages.

    Args:
        parts: for each part its rings, the shell first; each [V, 2] degrees (longitude, latitude).
        name: of the region.
        levels: lowest and highest flight level [FL], if known.
        excluded: parts that are cut out.
    """

    def united(some: Sequence[Sequence[Floats]]) -> Area:
        unwrapped = [
            [_unwrap_longitude(ring, parts[0][0][0, 0]) for ring in rings] for rings in some
        ]
        polygons = [
            polygon_from_rings(rings, source, "deg (longitude, latitude)") for rings in unwrapped
        ]
        return cast(Area, shapely.union_all(polygons))

    # Parts that were cut at the antimeridian share an edge, which a valid MultiPolygon must not.
    shape = united(parts)
    if excluded:
        shape = cast(Area, shape - united(excluded))
        if shape.is_empty:
            raise InputError(f"{source}: all of it is excluded; take a larger region")
    if shape.bounds[2] - shape.bounds[0] > 180:
        raise InputError(f"{source}: more than 180 deg of longitude wide; take a smaller region")
    oriented = shapely.get_parts(shapely.orient_polygons(shape))
    origin = area_centroid([shapely.get_coordinates(ring) for ring in shapely.get_rings(oriented)])
    local = shapely.transform(shape, lambda c: np.column_stack(to_local(c[:, 1], c[:, 0], origin)))
    return Region(_made_valid(local, source), one_line(name), origin, levels)


def _made_valid(local: Area, source: str) -> Area:
    """A polygon in metres without the little by which holes cross the edges that they touch in
    degrees."""
    if local.is_valid:
        return local
    valid = shapely.make_valid(local, method="structure", keep_collapsed=False)
    if not abs(valid.area - local.area) < _SLACK * local.area:
        raise InputError(f"{source}: edges cross once laid out in metres; take a smaller region")
    return cast(Area, valid)


def _unwrap_longitude(ring: Floats, lon_deg: float) -> Floats:
    """Shift each corner by whole turns of longitude to within 180 deg of ``lon_deg``."""
    whole_turns = np.round((lon_deg - ring[:, 0]) / 360)
    return ring + np.column_stack([360 * whole_turns, np.zeros_like(whole_turns)])
