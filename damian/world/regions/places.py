"""Places that settings give, as metres or as latitude and longitude, in a region's local metres.

A place is ``[x, y]``, metres east and north in the coordinates in which the region is given (those of
``region.vertices``; of a FIR table or GeoJSON file: about the area's centroid), or, for these two kinds of
region, ``{lat: 53.1, lon: -4.5}`` in degrees.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from damian.common.errors import InputError
from damian.world.regions.geodesy import Floats, to_local
from damian.world.regions.region import Region, to_grid


def local_places(key: str, places: Sequence[Any], region: Region) -> Floats:
    """Places of the settings in local metres of a region, [P, 2].

    Args:
        key: of the setting, for errors.
        places: each ``[x, y]`` or ``{lat: ..., lon: ...}``.
        region: all of them must lie inside.
    """
    local = np.array([_local(key, place, region) for place in places])
    inside = shapely.contains_xy(region.polygon, local)
    if not inside.all():
        first = int(np.argmin(inside))
        given, (x, y) = places[first], local[first]
        shown = f"{given} (at [{x:g}, {y:g}] m)" if isinstance(given, Mapping) else f"{[*given]} m"
        west, south, east, north = np.round(np.tile(region.offset, 2) + region.polygon.bounds, 2)
        raise InputError(
            f"{key}: {shown} is not inside {region.name} (x {west:.10g} to {east:.10g} m, y {south:.10g} to "
            f"{north:.10g} m)"
        )
    return local


def _local(key: str, place: Any, region: Region) -> Floats:
    """A place in local metres, [2]."""
    if not isinstance(place, Mapping):
        return to_grid(np.array(place, float) - region.offset)
    if region.origin is None:
        raise InputError(
            f"{key}: {place} has latitude and longitude, but {region.name} has no position on Earth: give "
            "[x, y] in metres, or take a region from a FIR table or GeoJSON file"
        )
    return np.stack(to_local(place["lat"], place["lon"], region.origin))
