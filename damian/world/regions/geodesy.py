"""Converts latitude and longitude to local metres and back, on a sphere.

Local metres are an azimuthal equidistant projection about an origin: x points east, y points north,
and
distance and bearing from the origin are exact. Formulas: R. W. Sinnott, "Virtues of the Haversine"
(1984), and the direct geodesic problem on a sphere. Distances on the sphere differ by up to 0.6 %
from those on the WGS 84 ellipsoid.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
LatLon = tuple[float, float]
"""A latitude and a longitude [deg]."""

EARTH_RADIUS_M = 6_371_008.8
"""Mean radius of the Earth (IUGG R1)."""


def to_local(lat_deg: ArrayLike, lon_deg: ArrayLike, origin: LatLon) -> tuple[Floats, Floats]:
    """Convert latitudes in [-90, 90] and longitudes, [*] degrees, to metres [*] east and north of
    ``origin``.

    They are ``x = d sin b`` and ``y = d cos b``, by the haversine distance d and the initial
    bearing b from the origin (latitude, longitude) in degrees. The bearing of its antipode is
    arbitrary.
    """
    lat = np.radians(np.asarray(lat_deg, float))
    lat_0 = np.radians(origin[0])
    d_lat = lat - lat_0
    d_lon = np.radians(np.asarray(lon_deg, float) - origin[1])
    cos_lat = np.cos(lat)
    across = np.sin(d_lon / 2) ** 2
    haversine = np.sin(d_lat / 2) ** 2 + np.cos(lat_0) * cos_lat * across
    half_chord = np.sqrt(np.clip(haversine, 0, 1))
    distance = 2 * EARTH_RADIUS_M * np.arcsin(half_chord)
    east = cos_lat * np.sin(d_lon)
    # Equals cos(lat_0) sin(lat) - sin(lat_0) cos(lat) cos(d_lon), without cancellation near the
    # origin.
    north = np.sin(d_lat) + 2 * np.sin(lat_0) * cos_lat * across
    return _by_bearing(distance, np.arctan2(east, north))


def _by_bearing(length: Floats, bearing: Floats) -> tuple[Floats, Floats]:
    """Parts east and north of lengths [*] in the directions of bearings [*] rad."""
    return length * np.sin(bearing), length * np.cos(bearing)


def to_latlon(x_m: ArrayLike, y_m: ArrayLike, origin: LatLon) -> tuple[Floats, Floats]:
    """Convert metres east and north [*] to latitudes and longitudes [*]; the inverse of
    ``to_local``.

    Latitudes are in [-90, 90] and longitudes in [-180, 180) degrees.
    """
    x = np.asarray(x_m, float)
    y = np.asarray(y_m, float)
    lat_0 = np.radians(origin[0])
    arc = np.hypot(x, y) / EARTH_RADIUS_M
    east, north = _by_bearing(np.sin(arc), np.arctan2(x, y))
    height = np.cos(arc)
    sin_lat = np.sin(lat_0)
    cos_lat = np.cos(lat_0)
    # Cartesian coordinates on the unit sphere, with the origin's meridian as the x-z plane. Near
    # the poles an arcsine would lose half the digits of the latitude; the arctangent keeps them.
    out = height * cos_lat - north * sin_lat
    up = height * sin_lat + north * cos_lat
    lat = np.degrees(np.arctan2(up, np.hypot(out, east)))
    lon = np.degrees(np.arctan2(east, out)) + origin[1]
    return lat, lon - 360 * np.floor((lon + 180) / 360)


def area_centroid(rings: Sequence[Floats]) -> LatLon:
    """Centroid of a polygon's area on the sphere, as (latitude, longitude) in degrees.

    It is the place below the mean of all points of the area in space. For a polygon whose edges are
    great circles this mean has a closed form, the sum over the edges of their length times the
    normal of their plane (J. E. Brock, "The Inertia Tensor for a Spherical Triangle", 1975), so
    that regions of any size, across the antimeridian or around a pole, have it exactly. The area
    lies to the left of each closed ring, [V, 2] degrees (longitude, latitude): shells run
    counter-clockwise and holes clockwise.
    """
    lon_0, lat_0 = map(float, rings[0][0])
    base = lat_0, lon_0
    upward = np.array([0.0, 0.0, 1.0])
    moment = np.zeros(3)
    for ring in rings:
        lon, lat = ring.T
        x, y = to_local(lat, lon, base)
        distance = np.hypot(x, y) / EARTH_RADIUS_M
        shrinks = np.sinc(distance / np.pi)
        outward = np.column_stack([x, y]) / EARTH_RADIUS_M * shrinks[:, None]
        # Corners east, north and up of the base, in Earth radii. Near the base the closed form
        # would lose all digits; the part of it that cancels over a closed ring is therefore left
        # out.
        up = -2 * np.sin(distance / 2) ** 2
        offset = np.column_stack([outward, up])
        start = offset[:-1]
        end = offset[1:]
        edge = end - start
        bent = np.cross(start, end)
        normal = np.cross(upward, edge) + bent
        half_chord = np.linalg.norm(edge, axis=1) / 2
        angle = 2 * np.arcsin(np.minimum(half_chord, 1))
        excess = 1 / np.sinc(angle / np.pi) - 1
        moment += (excess[:, None] * normal + bent).sum(0)
    east, north, up = moment
    arc = EARTH_RADIUS_M * np.arctan2(np.hypot(east, north), up)
    x, y = _by_bearing(arc, np.arctan2(east, north))
    lat, lon = to_latlon(x, y, base)
    return float(lat), float(lon)
