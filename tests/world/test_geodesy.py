"""Conversion between latitude and longitude and local metres: known distances, and round trips."""

import numpy as np
import pytest
from helpers import ring
from hypothesis import given, strategies as st

from damian.world.regions.geodesy import EARTH_RADIUS_M, area_centroid, to_latlon, to_local

OFFSETS_M = st.floats(-35_000, 35_000)


def test_distance_and_bearing_agree_with_vector_geometry_on_the_sphere():
    rng = np.random.default_rng(0)
    lat = rng.uniform(-89, 89, 500)
    lon = rng.uniform(-180, 180, 500)
    for origin in [(0.0, 0.0), (52.8, -4.1), (-80.0, 179.0)]:
        x, y = to_local(lat, lon, origin)
        expected = [_local_by_vectors(a, b, origin) for a, b in zip(lat, lon, strict=True)]
        np.testing.assert_allclose(np.stack([x, y], -1), expected, atol=1e-3)


def _local_by_vectors(lat, lon, origin):
    """Distance from the angle between two vectors, and bearing from the tangent plane at the
    origin."""
    phi, lam = np.radians(origin)
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    north = np.cross(up, east)
    phi, lam = np.radians([lat, lon])
    place = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    angle = np.arctan2(np.linalg.norm(np.cross(up, place)), up @ place)
    flat = np.array([place @ east, place @ north])
    return EARTH_RADIUS_M * angle * flat / np.linalg.norm(flat)


@given(st.floats(-89.4, 89.4), st.floats(-180, 180), OFFSETS_M, OFFSETS_M)
def test_local_metres_within_50_km_survive_the_round_trip_over_degrees(lat, lon, x, y):
    place = to_latlon(x, y, (lat, lon))
    np.testing.assert_allclose(to_local(*place, (lat, lon)), [x, y], atol=1e-6)


def test_the_centroid_of_an_area_across_the_antimeridian_or_around_the_pole_is_inside():
    strait = np.array(ring(179.0, 10.0, 181.0, 12.0))
    shifted = area_centroid([strait - [20, 0]])
    assert area_centroid([strait]) == pytest.approx((shifted[0], -180), abs=1e-9)
    cap = np.array([[0.0, 80], [90, 80], [180, 80], [270, 80], [360, 80]])
    assert area_centroid([cap])[0] == pytest.approx(90, abs=1e-6)
