"""Geometries in GeoJSON (RFC 7946), which any map tool opens."""

import json
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from damian.world.regions.geodesy import LatLon, to_latlon, wrap_longitude

DIGITS = 7
"""Decimals of longitudes and latitudes: a centimetre."""


def on_earth(geometry: Any, origin: LatLon) -> dict[str, Any]:
    """A geometry of local metres in longitude and latitude, with holes clockwise."""

    def degrees(metres: NDArray[np.float64]) -> NDArray[np.float64]:
        latitude, longitude = to_latlon(metres[:, 0], metres[:, 1], origin)
        longitude = origin[1] + wrap_longitude(longitude - origin[1])
        return np.column_stack([longitude, latitude]).round(DIGITS)

    return json.loads(
        shapely.to_geojson(shapely.orient_polygons(shapely.transform(geometry, degrees)))
    )
