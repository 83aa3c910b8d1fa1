"""Latitude and longitude to local metres: known places, and there and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from damian.world.regions.geodesy import EARTH_RADIUS_M, to_latlon, to_local, wrap_longitude

ONE_DEGREE_M = EARTH_RADIUS_M * np.pi / 180
NEAR_M = st.floats(-35_000, 35_000)


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


def test_distance_and_bearing_agree_with_vectors_on_the_sphere():
    rng = np.random.default_rng(0)
    lat, lon = rng.uniform(-89, 89, 500), rng.uniform(-180, 180, 500)
    for origin in [(0.0, 0.0), (52.8, -4.1), (-80.0, 179.0)]:
        x, y = to_local(lat, lon, origin)
        slow = [_slow_local(a, b, origin) for a, b in zip(lat, lon, strict=True)]
        np.testing.assert_allclose(np.stack([x, y], -1), slow, atol=1e-3)


def _slow_local(lat, lon, origin):
    """Distance by the angle between two vectors, bearing by their tangent plane."""
    phi, lam = np.radians(origin)
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    north = np.cross(up, east)
    phi, lam = np.radians([lat, lon])
    place = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    angle = np.arctan2(np.linalg.norm(np.cross(up, place)), up @ place)
    flat = np.array([place @ east, place @ north])
    return EARTH_RADIUS_M * angle * flat / np.linalg.norm(flat)


@given(st.floats(-89.4, 89.4), st.floats(-180, 180), NEAR_M, NEAR_M)
def test_metres_survive_the_way_to_degrees_and_back_within_50_km(lat, lon, x, y):
    there = to_latlon(x, y, (lat, lon))
    np.testing.assert_allclose(to_local(*there, (lat, lon)), [x, y], atol=1e-6)


@given(st.floats(-89, 89), st.floats(-179.999, 179.999), st.floats(-0.4, 0.4), st.floats(-0.4, 0.4))
def test_degrees_survive_the_way_to_metres_and_back(lat, lon, d_lat, d_lon):
    place = lat + d_lat, float(wrap_longitude(lon + d_lon))
    there = to_latlon(*to_local(*place, (lat, lon)), (lat, lon))
    assert there[0] == pytest.approx(place[0], abs=1e-11)
    turn = float(wrap_longitude(there[1] - place[1]))
    assert turn * np.cos(np.radians(place[0])) == pytest.approx(0, abs=1e-11)


@given(st.floats(-60, 60), st.floats(1, 50_000))
def test_going_east_over_the_antimeridian_wraps_the_longitude_and_stays_near(lat, x):
    origin = (lat, 179.99999)
    there = to_latlon(x + 10, 0.0, origin)
    assert -180 <= there[1] < -179
    assert to_local(*there, origin)[0] == pytest.approx(x + 10, abs=1e-6)


@given(st.floats(-1e4, 1e4))
def test_a_wrapped_longitude_is_in_one_turn_and_the_same_direction(lon):
    wrapped = float(wrap_longitude(lon))
    assert -180 <= wrapped < 180
    assert np.cos(np.radians(wrapped - lon)) == pytest.approx(1, abs=1e-12)


def test_both_ways_work_on_arrays_of_any_shape():
    x, y = np.meshgrid(np.linspace(-1e4, 1e4, 5), np.linspace(-2e4, 2e4, 3))
    back = to_local(*to_latlon(x, y, (52.8, -4.1)), (52.8, -4.1))
    assert back[0].shape == (3, 5)
    np.testing.assert_allclose(back, [x, y], atol=1e-6)
