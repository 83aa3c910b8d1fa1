"""Zones, and flights around them, against a plain search over all corners."""

import heapq
import itertools

import numpy as np
import pytest
import shapely
import torch
from helpers import both_kinds, clock

from damian import ScenarioConfig, UavEnv
from damian.world.config import ActionConfig, MotionConfig, RegionConfig
from damian.world.paths import detours
from damian.world.regions.polygon import landing_lattice

DENTED = [[0, 0], [400, 0], [400, 300], [220, 300], [200, 180], [180, 300], [0, 300]]
ZONES = [[[100, 40], [150, 60], [140, 200]], [[230, 90], [330, 120], [240, 150]]]
WAYS = shapely.Polygon(DENTED) - shapely.union_all([shapely.Polygon(zone) for zone in ZONES])


def shortest(polygon, origin, goal):
    """Length of the shortest way in a polygon by Dijkstra's search over all corners, if there is
    one."""
    places = [tuple(origin), tuple(goal), *set(map(tuple, shapely.get_coordinates(polygon)))]
    best = {}
    queue = [(0.0, 0)]
    while queue:
        length, here = heapq.heappop(queue)
        if here in best:
            continue
        best[here] = length
        for other in set(range(len(places))) - set(best):
            if shapely.covers(polygon, shapely.LineString([places[here], places[other]])):
                heapq.heappush(
                    queue,
                    (length + float(np.hypot(*np.subtract(places[here], places[other]))), other),
                )
    return best.get(1)


@pytest.mark.parametrize("apart", [False, True])
def test_ways_between_all_landing_points_are_the_shortest_ones(apart):
    polygon = shapely.union_all([WAYS, shapely.box(450, 0, 600, 150)]) if apart else WAYS
    points = landing_lattice(polygon, 90.0, 60.0)
    found = detours([polygon], [points], 1000.0)
    table = torch.as_tensor(points, dtype=torch.float32)
    pairs = torch.tensor(list(itertools.permutations(range(len(points)), 2)))
    length = found.length(*pairs.T, table)
    expected = [shortest(polygon, points[i], points[j]) for i, j in pairs.tolist()]
    assert None in expected or not apart
    expected = torch.tensor([torch.inf if each is None else each for each in expected])
    torch.testing.assert_close(length, expected, rtol=1e-5, atol=1e-3)
    ways = shapely.linestrings(found.way(*pairs.T, table).double().numpy())
    assert shapely.covers(shapely.buffer(polygon, 1e-3), ways[length.isfinite().numpy()]).all()
    assert len(found.pair) < len(pairs), "straight ways need no detour"


@both_kinds
def test_no_uav_leaves_the_region_or_enters_a_zone(kind):
    region = RegionConfig(
        kind="vertices", vertices=DENTED, zones=ZONES, zone_margin=5.0, lattice_step=25.0
    )
    motion = MotionConfig(kind="polynomial", max_speed=30.0, max_acceleration=10.0)
    actions = ActionConfig(kind=kind, distances=[0.0, 80.0, 160.0])
    settings = {"region": region, "motion": motion, "actions": actions, "clock": clock("0.5s")}
    env = UavEnv(ScenarioConfig(agents=4, **settings), num_worlds=16, seed=3)
    polygon = env.simulation.airspace.regions[0].polygon
    assert len(polygon.interiors) == 2
    env.set_seed(0)
    flown = env.rollout(60, break_when_any_done=False)["state"]
    places = flown[..., : 3 * 4].unflatten(-1, (4, 3))[..., :2].flatten(0, -2).double()
    outside = ~shapely.covers(shapely.buffer(polygon, 1e-2), shapely.points(places.numpy()))
    assert not outside.any()
    stands = env.simulation.vehicles.on_ground(env.state)
    assert env.state.position[stands][:, :2].equal(env.simulation.points[env.state.goal[stands]])
    flights = env.simulation.airspace.detours.row(env.state.origin, env.state.goal)
    assert (flights < len(env.simulation.airspace.detours.pair)).any(), "some fly around"


@pytest.mark.parametrize(
    ("zones", "message"),
    [
        (-1, "region.zones: -1 is not a list"),
        ([[[0, 0], [1, 1]]], "region.zones: .* three or more corners"),
        ([[[-10, -10], [500, -10], [500, 500], [-10, 500]]], "region.zones: .* leave nothing"),
        (
            "zones.geojson",
            "region.zones: zones.geojson is a map, but vertices region 0 has no position",
        ),
    ],
)
def test_zones_that_cannot_be_are_refused(zones, message):
    with pytest.raises(ValueError, match=message):
        UavEnv(
            ScenarioConfig(
                region=RegionConfig(
                    kind="vertices",
                    vertices=DENTED,
                    zones=zones,
                )
            ),
            1,
            0,
        )
