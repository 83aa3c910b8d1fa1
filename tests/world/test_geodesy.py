"""Conversion between latitude and longitude and local metres: known distances, and round trips."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from damian.world.regions.geodesy import (
    EARTH_RADIUS_M,
    area_centroid,
    to_latlon,
    to_local,
)

OFFSETS_M = st.floats(-35_000, 35_000)


def test_distance_and_bearing_agree_with_vector_geometry_on_the_sphere():
    rng = np.random.default_rng(0)
    lat, lon = rng.uniform(-89, 89, 500), rng.uniform(-180, 180, 500)
    for origin in [(0.0, 0.0), (52.8, -4.1), (-80.0, 179.0)]:
        x, y = to_local(lat, lon, origin)
        expected = [_local_by_vectors(a, b, origin) for a, b in zip(lat, lon, strict=True)]
        np.testing.assert_allclose(np.stack([x, y], -1), expected, atol=1e-3)


def _local_by_vectors(lat, lon, origin):
    """Distance from the angle between two vectors, and bearing from the tangent plane at the origin."""
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


# --- the centroid of an area --------------------------------------------------------------------


def on_sphere(lon, lat):
    """Unit vectors of places, [..., 3]."""
    lon, lat = np.radians(lon), np.radians(lat)
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], -1)


def centroid_by_integration(rings, depth=5):
    """Mean of the unit vectors over the area, by fans of triangles cut into small flat ones: its direction.

    Each ring is a fan about its first corner; triangles that turn clockwise count negative.
    """
    total = np.zeros(3)
    for ring in rings:
        corners = on_sphere(*ring[:-1].T)
        fan = np.stack([np.repeat(corners[:1], len(corners) - 2, 0), corners[1:-1], corners[2:]], 1)
        for _ in range(depth):
            a, b, c = fan.swapaxes(0, 1)
            ab, bc, ca = (
                (x + y) / np.linalg.norm(x + y, axis=-1)[:, None] for x, y in [(a, b), (b, c), (c, a)]
            )
            fan = np.concatenate(
                [np.stack(t, 1) for t in [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]]
            )
        normal, middle = np.cross(fan[:, 1] - fan[:, 0], fan[:, 2] - fan[:, 0]) / 2, fan.sum(1)
        middle /= np.linalg.norm(middle, axis=1)[:, None]
        total += (np.sum(normal * middle, 1)[:, None] * middle).sum(0)
    return total / np.linalg.norm(total)


def star_rings(rng, size_deg, lat, lon, hole):
    """A ragged ring about a place, counter-clockwise, and if wanted a hole in it, clockwise; degrees."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, 9))
    shell = np.stack([np.cos(angle) / np.cos(np.radians(lat)), np.sin(angle)], -1)
    shell = [lon, lat] + size_deg * rng.uniform(0.3, 1, 9)[:, None] * shell
    hole_ring = [lon, lat] + 0.2 * (shell[::-1] - [lon, lat]) + [0.02 * size_deg, 0]
    return [np.vstack([ring, ring[:1]]) for ring in ([shell, hole_ring] if hole else [shell])]


@given(
    seed=st.integers(0, 2**32 - 1),
    size_km=st.sampled_from([0.03, 1.0, 100.0, 500.0]),
    lat=st.floats(-70, 70),
    lon=st.floats(-180, 180),
    hole=st.booleans(),
)
@settings(max_examples=40)
def test_the_centroid_of_an_area_is_that_of_a_numerical_integration(seed, size_km, lat, lon, hole):
    rings = star_rings(np.random.default_rng(seed), size_km / 111, lat, lon, hole)
    place = on_sphere(*area_centroid(rings)[::-1])
    error_m = EARTH_RADIUS_M * np.linalg.norm(place - centroid_by_integration(rings))
    assert error_m < max(1e-4 * size_km * 1000 / 100, 0.2)


def test_the_centroid_of_an_area_across_the_antimeridian_or_around_the_pole_is_inside():
    strait = np.array([[179.0, 10], [181, 10], [181, 12], [179, 12], [179, 10]])
    shifted = area_centroid([strait - [20, 0]])
    assert area_centroid([strait]) == pytest.approx((shifted[0], -180), abs=1e-9)
    cap = np.array([[0.0, 80], [90, 80], [180, 80], [270, 80], [360, 80]])
    assert area_centroid([cap])[0] == pytest.approx(90, abs=1e-6)
