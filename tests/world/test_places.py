"""Places in settings, as metres or latitude and longitude, and the one-line errors of wrong ones."""

import json
import math

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given
from hypothesis import strategies as st

from damian.common.errors import InputError
from damian.world.battery import BatteryConfig
from damian.world.config import WorldConfig
from damian.world.regions.config import RegionConfig, regions_of
from damian.world.regions.geodesy import to_latlon
from damian.world.regions.places import local_places
from damian.world.regions.region import Region, centred
from damian.world.signal_source import SourceConfig
from damian.world.simulation import Simulation

SQUARE = RegionConfig(
    kind="vertices", vertices=[[0, 0], [200, 0], [200, 200], [0, 200]], initial_conditions=4
)
CORNERS = [[8.0, 45.0], [8.003, 45.0], [8.003, 45.002], [8.0, 45.002], [8.0, 45.0]]


@pytest.fixture
def park(tmp_path) -> RegionConfig:
    """A region of about 236 m by 222 m with a position on Earth."""
    file = tmp_path / "park.geojson"
    file.write_text(json.dumps({"type": "Polygon", "coordinates": [CORNERS]}))
    return RegionConfig(kind="geojson", path=str(file), initial_conditions=4)


def build(region, **settings) -> Simulation:
    places = {name: settings.pop(name) for name in ("start_positions", "start_together") if name in settings}
    region = RegionConfig(**(vars(region) | places))
    return Simulation(WorldConfig(region=region, **settings), 1.0, 2, 0)


@given(lat=st.floats(-80, 80), lon=st.floats(-180, 180), x=st.floats(-400, 400), y=st.floats(-400, 400))
def test_a_place_in_degrees_is_the_same_place_in_metres(lat, lon, x, y):
    region = Region(shapely.box(-500, -500, 500, 500), "test", (lat, lon))
    place = dict(zip(("lat", "lon"), map(float, to_latlon(x, y, (lat, lon))), strict=True))
    np.testing.assert_allclose(local_places("key", [place], region), [[x, y]], atol=1e-5)
    np.testing.assert_allclose(local_places("key", [[x, y]], region), [[x, y]], atol=1e-5)


def test_places_of_a_geographic_region_may_be_in_degrees_or_metres(park):
    origin = regions_of(park, np.random.default_rng(0))[0].origin
    metres = [[-80.0, 0.0], [0.0, 50.0], [60.0, -70.0]]
    degrees = [
        {"lat": float(lat), "lon": float(lon)} for lat, lon in (to_latlon(*xy, origin) for xy in metres)
    ]
    worlds = [
        build(
            park,
            start_positions=places,
            source=SourceConfig(position=places[1]),
            battery=BatteryConfig(enabled=True, charging_points=places[:2]),
        )
        for places in (metres, degrees, [metres[0], degrees[1], metres[2]])
    ]
    for other in worlds[1:]:
        assert other.initial.goal.equal(worlds[0].initial.goal)
        assert other.vehicles.chargers.equal(worlds[0].vehicles.chargers)
        torch.testing.assert_close(other.initial.source, worlds[0].initial.source, atol=1e-4, rtol=0)
    assert int(worlds[0].vehicles.chargers.sum()) == 2
    places = worlds[0].initial.position[0, :, :2]
    assert (places - torch.tensor(metres)).norm(dim=-1).max() < 20


def test_places_are_in_the_coordinates_in_which_the_vertices_are_given():
    worlds = build(SQUARE, source=SourceConfig(position=[20.0, 150.0]))
    offset = torch.tensor(worlds.airspace.regions[0].offset)
    torch.testing.assert_close(worlds.initial.source[0] + offset, torch.tensor([20.0, 150.0]))
    assert offset.tolist() == [100.0, 100.0]


def test_every_region_of_a_pool_must_contain_a_given_place():
    pool = RegionConfig(pool=3, initial_conditions=6)
    middle = [0.0, 0.0]
    worlds = build(
        pool,
        source=SourceConfig(position=middle),
        battery=BatteryConfig(enabled=True, charging_points=[middle]),
    )
    for index, region in enumerate(worlds.airspace.regions):
        local = -torch.tensor(region.offset)
        assert worlds.initial.source[2 * index].tolist() == pytest.approx(local.tolist(), abs=2e-5)
    assert int(worlds.vehicles.chargers.sum()) == 3
    with pytest.raises(
        InputError, match=r"^source.position: \[0.0, 190.0\] m is not inside random region \d "
    ):
        build(RegionConfig(pool=10), source=SourceConfig(position=[0.0, 190.0]))


@pytest.mark.parametrize(
    "place",
    [
        [0.0],
        [math.nan, 1.0],
        {"lat": 1.0, "lng": 2.0},
        {"lat": 95.0, "lon": 0.0},
        [0.0, 100.0],  # on the boundary
        {"lat": 53.1, "lon": -4.5},  # of a region without a position on Earth
    ],
)
@pytest.mark.parametrize("key", ["region.start_positions", "source.position", "battery.charging_points"])
def test_a_wrong_place_is_refused_by_its_key(key, place):
    wrong = {
        "region.start_positions": lambda: build(SQUARE, start_positions=[[10.0, 10.0], [90.0, 90.0], place]),
        "source.position": lambda: build(SQUARE, source=SourceConfig(position=place)),
        "battery.charging_points": lambda: build(
            SQUARE, battery=BatteryConfig(enabled=True, charging_points=[[1, 9], place])
        ),
    }
    with pytest.raises(InputError, match=rf"^{key}\b"):
        wrong[key]()


def test_a_place_in_a_hole_of_the_region_is_refused():
    region = Region(shapely.box(-100, -100, 100, 100) - shapely.box(-60, -60, 60, 60), "park")
    with pytest.raises(InputError) as error:
        local_places("source.position", [[80.0, 10.0], [0.0, 10.0]], region)
    assert str(error.value) == (
        "source.position: [0.0, 10.0] m is not inside park (x -100 to 100 m, y -100 to 100 m)"
    )


@pytest.mark.parametrize("second", [[10.0, 10.0], [10.5, 10.0]])
def test_two_start_positions_lead_to_one_landing_point_only_if_uavs_start_together(second):
    places = [[10.0, 10.0], second, [150.0, 150.0]]
    with pytest.raises(InputError) as error:
        build(SQUARE, start_positions=places)
    assert str(error.value) == (
        f"region.start_positions: [10.0, 10.0] and {second} lead to the same landing point of vertices "
        "region 0: take places farther apart, or let UAVs share it by region.start_together=true"
    )
    goal = build(SQUARE, start_positions=places, start_together=True).initial.goal
    assert goal[0, 0] == goal[0, 1] != goal[0, 2]


@pytest.mark.parametrize(
    ("settings", "value", "readers"),
    [
        ({"kind": "vertices", "vertices": CORNERS, "path": "a.csv"}, "path: a.csv", "fir or geojson"),
        ({"vertices": [[0, 0], [9, 9]]}, "vertices: [[0, 0], [9, 9]]", "vertices"),
    ],
)
def test_a_setting_that_the_kind_of_region_does_not_read_is_refused(settings, value, readers):
    with pytest.raises(InputError) as error:
        RegionConfig(**settings)
    problem = f"means nothing with region={settings.get('kind', 'random')}: only {readers} reads it"
    assert str(error.value) == f"region.{value} {problem}"


def test_a_region_that_vanishes_once_rounded_is_refused():
    with pytest.raises(InputError, match=r"^tiny: .* once rounded to 1/65536 m: draw it larger"):
        centred(Region(shapely.Polygon([(0, 0), (1e-6, 0), (0, 1e-6)]), "tiny"))
