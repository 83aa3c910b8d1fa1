"""Conversion between latitude and longitude and local metres: known distances, and round trips."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from damian.world.regions.geodesy import EARTH_RADIUS_M, to_latlon, to_local, wrap_longitude

ONE_DEGREE_M = EARTH_RADIUS_M * np.pi / 180
OFFSETS_M = st.floats(-35_000, 35_000)


def test_one_degree_of_latitude_is_due_north_and_60_nautical_miles():
    x, y = to_local(53.0, -4.0, (52.0, -4.0))
    assert x == pytest.approx(0, abs=1e-6)
    assert y == pytest.approx(ONE_DEGREE_M, rel=1e-12)
    assert y / 1852 == pytest.approx(60, rel=2e-3)


def test_a_degree_of_longitude_on_the_equator_is_due_east():
    x, y = to_local(0.0, 11.0, (0.0, 10.0))
    assert [x, y] == pytest.approx([ONE_DEGREE_M, 0], abs=1e-6)


def test_paris_to_london_is_344_km_to_the_northwest():
    x, y = to_local(51.5074, -0.1278, (48.8566, 2.3522))
    assert np.hypot(x, y) == pytest.approx(343_556, abs=20)
    assert np.degrees(np.arctan2(x, y)) % 360 == pytest.approx(330.0, abs=0.1)


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


@given(st.floats(-89, 89), st.floats(-179.999, 179.999), st.floats(-0.4, 0.4), st.floats(-0.4, 0.4))
def test_degrees_survive_the_round_trip_over_local_metres(lat, lon, d_lat, d_lon):
    place = lat + d_lat, float(wrap_longitude(lon + d_lon))
    returned = to_latlon(*to_local(*place, (lat, lon)), (lat, lon))
    assert returned[0] == pytest.approx(place[0], abs=1e-11)
    error = float(wrap_longitude(returned[1] - place[1]))
    assert error * np.cos(np.radians(place[0])) == pytest.approx(0, abs=1e-11)


@given(st.floats(-60, 60), st.floats(1, 50_000))
def test_a_place_east_of_the_antimeridian_has_a_wrapped_longitude_and_the_same_distance(lat, x):
    origin = (lat, 179.99999)
    place = to_latlon(x + 10, 0.0, origin)
    assert -180 <= place[1] < -179
    assert to_local(*place, origin)[0] == pytest.approx(x + 10, abs=1e-6)


@given(st.floats(-1e4, 1e4))
def test_a_wrapped_longitude_lies_in_one_turn_and_points_in_the_same_direction(lon):
    wrapped = float(wrap_longitude(lon))
    assert -180 <= wrapped < 180
    assert np.cos(np.radians(wrapped - lon)) == pytest.approx(1, abs=1e-12)


def test_both_conversions_work_on_arrays_of_any_shape():
    x, y = np.meshgrid(np.linspace(-1e4, 1e4, 5), np.linspace(-2e4, 2e4, 3))
    returned = to_local(*to_latlon(x, y, (52.8, -4.1)), (52.8, -4.1))
    assert returned[0].shape == (3, 5)
    np.testing.assert_allclose(returned, [x, y], atol=1e-6)
