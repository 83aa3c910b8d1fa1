"""Places in settings, as metres or latitude and longitude, and the one-line errors of wrong
ones."""

import json
import math

import helpers
import numpy as np
import pytest
import torch

from damian.common.errors import InputError
from damian.world.config import BatteryConfig, SourceConfig, WorldConfig
from damian.world.regions.geodesy import to_latlon
from damian.world.regions.sources import RegionConfig, regions_of
from damian.world.simulation import Simulation

SQUARE = RegionConfig("vertices", vertices=helpers.SQUARE, initial_conditions=4)
CORNERS = helpers.ring(8.0, 45.0, 8.003, 45.002)


def build(region, **settings):
    places = {
        name: settings.pop(name)
        for name in ("start_positions", "start_together")
        if name in settings
    }
    region = RegionConfig(**(vars(region) | places))
    return Simulation(WorldConfig(region=region, **settings), 1.0, 2, 0)


def test_places_of_a_geographic_region_may_be_in_degrees_or_metres(tmp_path):
    file = tmp_path / "park.geojson"  # about 236 m by 222 m
    file.write_text(json.dumps({"type": "Polygon", "coordinates": [CORNERS]}))
    park = RegionConfig(kind="geojson", path=str(file), initial_conditions=4)
    origin = regions_of(park, np.random.default_rng(0))[0].origin
    metres = [[-80.0, 0.0], [0.0, 50.0], [60.0, -70.0]]
    degrees = [
        dict(zip(("lat", "lon"), map(float, to_latlon(*xy, origin)), strict=True)) for xy in metres
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
        torch.testing.assert_close(
            other.initial.source, worlds[0].initial.source, atol=1e-4, rtol=0
        )
    assert int(worlds[0].vehicles.chargers.sum()) == 2
    places = worlds[0].initial.position[0, :, :2]
    assert (places - torch.tensor(metres)).norm(dim=-1).max() < 20


@pytest.mark.parametrize(
    "place",
    [
        [math.nan, 1.0],
        {
            "lat": 1.0,
            "lng": 2.0,
        },
        [0.0, 100.0],
        {"lat": 53.1, "lon": -4.5},
    ],
    ids=[
        "not finite",
        "a misspelt key",
        "on the boundary",
        "of a region without a position on Earth",
    ],
)
def test_a_wrong_place_is_refused_by_its_key(place):
    with pytest.raises(InputError, match=r"^source.position\b"):
        build(SQUARE, source=SourceConfig(position=place))


@pytest.mark.parametrize("second", [[10.0, 10.0], [10.5, 10.0]])
def test_two_start_positions_lead_to_one_landing_point_only_if_uavs_start_together(second):
    places = [[10.0, 10.0], second, [150.0, 150.0]]
    with pytest.raises(
        InputError, match=r"^region.start_positions: .* lead to the same landing point"
    ):
        build(SQUARE, start_positions=places)
    goal = build(SQUARE, start_positions=places, start_together=True).initial.goal
    assert goal[0, 0] == goal[0, 1] != goal[0, 2]
