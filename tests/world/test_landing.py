"""Actions against plain loops: booking in index order, nearest points, inside tests, the action table."""

import math

import numpy as np
import pytest
import shapely
import torch
import twin
from exact_distance import nearest_by_loop
from helpers import SQUARE, both_kinds, heading
from hypothesis import given
from hypothesis import strategies as st
from shapely.affinity import scale, translate
from shapely.geometry import MultiPolygon, Polygon

from damian.common.errors import InputError
from damian.world import landing
from damian.world.airspace import build_airspace, inside
from damian.world.config import WorldConfig
from damian.world.landing import (
    ActionConfig,
    Candidates,
    Ranking,
    _assign_serially,
    assign_landing_points,
    displacement,
)
from damian.world.regions.config import RegionConfig
from damian.world.regions.region import Region
from damian.world.simulation import Simulation


def random_bookings(seed, n_worlds, n_agents, n_points, together):
    """Random preferences, standing points (at most 3 if ``together``) and flags of UAVs that may choose."""
    rng = np.random.default_rng(seed)
    n_candidates = min(2 * n_agents - 1, n_points)
    ranked = np.stack([rng.permutation(n_points)[:n_candidates] for _ in range(40)])
    # Few different preferences make UAVs compete: many UAVs share a row.
    row = rng.integers(0, rng.integers(1, 40, endpoint=True), (n_worlds, n_agents))
    if together:
        standing = rng.integers(0, min(n_points, 3), (n_worlds, n_agents))
    else:
        standing = np.stack([rng.permutation(n_points)[:n_agents] for _ in range(n_worlds)])
    ready = rng.random((n_worlds, n_agents)) < rng.choice([0.3, 0.8, 1.0])
    return ranked, row, standing, ready


def booked(ranked, row, standing, ready):
    """Points booked by UAVs, ready or not, whose reach is unlimited."""
    ranking = Ranking(ranked, torch.zeros(ranked.shape))
    return assign_landing_points(ranking, row, standing, torch.where(ready, 0.0, -1.0), 64)


def bookings_within_reach(seed, n_agents, n_points, together):
    """Random bookings of 30 worlds in which some UAVs must stay, and some reach few points."""
    ranked, row, standing, _ = map(torch.as_tensor, random_bookings(seed, 30, n_agents, n_points, together))
    generator = torch.Generator().manual_seed(seed)
    ranking = Ranking(ranked.int(), torch.rand(ranked.shape, generator=generator))
    return ranking, row, standing, 1.5 * torch.rand(row.shape, generator=generator) - 0.3


def deferred_acceptance(ranking, row, standing, reach, n_points):
    """Points booked by deferred acceptance, which otherwise serves only worlds with many UAVs."""
    reached = ranking.distance[row, 0] <= reach
    choice = torch.where(reached, ranking.point[row, 0].long(), standing)
    return landing._assign_in_order(ranking, row, standing, reach, choice, n_points)


@given(
    seed=st.integers(0, 2**32 - 1),
    n_agents=st.integers(1, 25),
    spare=st.integers(0, 20),
    together=st.booleans(),
)
def test_booking_equals_a_sequential_loop(seed, n_agents, spare, together):
    n_points = n_agents + spare
    case = random_bookings(seed, 6, n_agents, n_points, together)
    ranked, row, standing, ready = map(torch.as_tensor, case)
    ours = booked(ranked.int(), row, standing, ready)
    expected = [
        twin.assign_landing_points(ranked[row[b]].tolist(), standing[b].tolist(), ready[b].tolist())
        for b in range(6)
    ]
    assert ours.tolist() == expected
    reach = torch.where(ready, 0.0, -1.0)
    assert _assign_serially(Ranking(ranked, torch.zeros(ranked.shape)), row, standing, reach).equal(ours)


@given(
    seed=st.integers(0, 2**32 - 1),
    n_agents=st.integers(1, 4),
    spare=st.integers(0, 6),
    together=st.booleans(),
)
def test_booking_of_few_uavs_one_by_one_equals_the_other_ways(seed, n_agents, spare, together):
    n_points = n_agents + spare
    ranking, row, standing, reach = bookings_within_reach(seed, n_agents, n_points, together)
    one_by_one = landing._assign_one_by_one(ranking, row, standing, reach)
    assert one_by_one.equal(assign_landing_points(ranking, row, standing, reach, n_points))
    assert one_by_one.equal(deferred_acceptance(ranking, row, standing, reach, n_points))


@given(
    seed=st.integers(0, 2**32 - 1),
    n_agents=st.integers(1, 20),
    spare=st.integers(0, 6),
    together=st.booleans(),
)
def test_deferred_acceptance_equals_serial_assignment_with_any_reach(seed, n_agents, spare, together):
    n_points = n_agents + spare
    ranking, row, standing, reach = bookings_within_reach(seed, n_agents, n_points, together)
    deferred = deferred_acceptance(ranking, row, standing, reach, n_points)
    assert deferred.equal(_assign_serially(ranking, row, standing, reach))


@given(seed=st.integers(0, 2**32 - 1), n_agents=st.integers(2, 12), spare=st.integers(0, 6))
def test_uavs_on_different_points_never_book_the_same(seed, n_agents, spare):
    case = random_bookings(seed, 20, n_agents, n_agents + spare, False)
    ranked, row, standing, ready = map(torch.as_tensor, case)
    ours = booked(ranked.int(), row, standing, ready)
    assert all(len(set(world)) == n_agents for world in ours.tolist())
    assert ours[~ready].equal(standing[~ready])


def test_of_two_uavs_that_choose_one_point_the_first_gets_it_and_the_other_its_next():
    ranked = torch.tensor([[5, 7, 1], [5, 0, 2]], dtype=torch.int32)
    row, standing = torch.tensor([[0, 1], [1, 0]]), torch.tensor([[1, 2], [1, 2]])
    ready = torch.ones(2, 2, dtype=torch.bool)
    assert booked(ranked, row, standing, ready).tolist() == [[5, 0], [5, 7]]


def test_a_point_that_a_uav_leaves_in_this_step_is_not_free_yet():
    ranked = torch.tensor([[5, 7, 1], [1, 6, 2]], dtype=torch.int32)
    row, standing = torch.tensor([[0, 1]]), torch.tensor([[1, 2]])
    ready = torch.ones(1, 2, dtype=torch.bool)
    assert booked(ranked, row, standing, ready).tolist() == [[5, 6]]


def test_a_point_out_of_reach_of_one_uav_goes_to_another_that_can_fly_there():
    ranking = Ranking(torch.tensor([[5, 7, 1], [5, 2, 0]]), torch.tensor([[9.0, 4.0, 0.0], [9.0, 0.0, 4.0]]))
    row, standing = torch.tensor([[0, 1]]), torch.tensor([[1, 2]])
    assert assign_landing_points(ranking, row, standing, torch.tensor([[8.0, 9.0]]), 8).tolist() == [[1, 5]]
    assert assign_landing_points(ranking, row, standing, torch.tensor([[9.0, 9.0]]), 8).tolist() == [[5, 2]]


def test_uavs_on_a_common_start_may_stay_there_or_leave():
    ranked = torch.tensor([[3, 0, 1, 2, 4], [4, 0, 1, 2, 3]], dtype=torch.int32)
    row, standing = torch.tensor([[0, 0, 1]]), torch.tensor([[3, 3, 3]])
    ready = torch.ones(1, 3, dtype=torch.bool)
    assert booked(ranked, row, standing, ready).tolist() == [[3, 3, 4]]


HORSESHOE = Polygon([(0, 0), (10, 0), (10, 8), (7, 8), (7, 3), (3, 3), (3, 8), (0, 8)])
HOLED = Polygon([(-4, -3), (9, -5), (12, 4), (3, 9), (-6, 5)], [[(0, 0), (4, 0), (4, 4), (0, 4)]])
POLYGONS = {
    "concave": HORSESHOE,
    "with a hole": HOLED,
    "in two parts": MultiPolygon([HORSESHOE, translate(HOLED, 20, 3)]),
}


def star(rng):
    """A jagged polygon with a hole near its middle."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, 14))
    radius = rng.uniform(4, 12, 14)
    shell = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    hole = np.stack([np.cos(angle), np.sin(angle)], -1) * 1.5
    return Polygon(shell).buffer(0).difference(Polygon(hole))


def check_inside(polygon, rng):
    """Assert that ``inside`` agrees with shapely at random targets away from the boundary."""
    airspace = build_airspace([Region(polygon, "test", None, None)], 1.0, 45.0, None, 1)
    west, south, east, north = polygon.bounds
    target = rng.uniform([west - 1, south - 1], [east + 1, north + 1], (2000, 2))
    # A quarter of the targets have the y of some corner, so that their rays meet the ends of edges.
    corners = shapely.get_coordinates(polygon)
    target[:500, 1] = corners[rng.integers(len(corners), size=500), 1]
    target = target.astype(np.float32).astype(float)
    off_boundary = shapely.distance(polygon.boundary, shapely.points(target)) > 1e-3
    assert off_boundary.sum() > 1500
    ours = inside(airspace.edges[0], torch.as_tensor(target[off_boundary], dtype=torch.float32))
    expected = shapely.contains_xy(polygon, target[off_boundary])
    assert 0 < expected.sum() < len(expected)
    assert ours.numpy().tolist() == expected.tolist()


@pytest.mark.parametrize("name", POLYGONS)
def test_inside_equals_shapelys_contains(name):
    check_inside(POLYGONS[name], np.random.default_rng(3))


@pytest.mark.parametrize("seed", range(10))
def test_inside_equals_shapelys_contains_for_jagged_polygons(seed):
    rng = np.random.default_rng(seed)
    check_inside(star(rng), rng)


def candidates(kind):
    """Candidates and action settings for two regions, the first with a notch, and one kind of actions."""
    notch = Polygon([(0, 0), (210, 0), (210, 190), (120, 190), (100, 60), (80, 190), (0, 190)])
    regions = [Region(notch, "notch", None, None), Region(HORSESHOE.buffer(40), "oval", None, None)]
    airspace = build_airspace(regions, 30.0, 45.0, None, 3)
    config = ActionConfig(
        kind=kind, distances=[0.0, 41.7, 97.3, 153.9], headings=[-130.0, -31.0, 5.0, 77.0, 180.0]
    )
    return Candidates(airspace, config, 3), config


def test_discrete_and_continuous_actions_have_the_same_first_candidate():
    discrete, config = candidates("discrete")
    continuous, _ = candidates("continuous")
    airspace, table = discrete.airspace, config.table()
    compared = 0
    for region, count in enumerate(airspace.n_points.tolist()):
        points = torch.arange(count) + region * airspace.max_points
        flat = points[:, None].expand(-1, len(table))
        number = torch.arange(len(table)).expand_as(flat)
        share = [[d / 153.9, heading(math.degrees(h))] for d, h in table.tolist()]
        action = torch.tensor(share).expand(count, -1, -1)
        regions = torch.full((count,), region)
        ranking, row = discrete.rank(flat, regions, number)
        expected, expected_row = continuous.rank(flat, regions, action)
        assert expected_row.shape == row.shape == flat.shape
        assert ranking.point[row][..., :1].long().equal(expected.point[expected_row][..., :1])
        compared += row.numel()
    assert compared == 20 * int(airspace.n_points.sum())


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_candidates_are_the_points_nearest_the_target_or_the_uavs_own_point(kind):
    tables, config = candidates(kind)
    polygon = tables.airspace.regions[0].polygon
    points = tables.airspace.points[0].tolist()
    flat = torch.arange(int(tables.airspace.n_points[0]))[:, None]
    rng = np.random.default_rng(0)
    number = torch.as_tensor(rng.integers(config.n_actions, size=flat.shape))
    share = torch.as_tensor(rng.random((*flat.shape, 2)), dtype=torch.float32)
    displacements = config.table()[number[:, 0]]
    if kind == "continuous":
        displacements = share[:, 0] * torch.tensor([153.9, 2 * math.pi])
    action = number if kind == "discrete" else share
    ranking, row = tables.rank(flat, torch.zeros(len(flat), dtype=torch.long), action)
    outside = 0
    for own, (distance, bearing) in enumerate(displacements.tolist()):
        x, y = points[own]
        target = (x + distance * math.sin(bearing), y + distance * math.cos(bearing))
        ranked = ranking.point[row[own, 0]].tolist()
        assert len(ranked) == 2 * 3 - 1
        if shapely.contains_xy(polygon, *target):
            nearest = sorted(math.dist(p, target) for p in points)[:5]
            assert [math.dist(points[p], target) for p in ranked] == pytest.approx(nearest, abs=1e-3)
        else:
            assert ranked == [own] * 5
            outside += 1
    assert 10 < outside < len(displacements) - 10


@pytest.mark.parametrize("name", POLYGONS)
def test_the_landing_points_of_actions_are_ranked_as_by_a_loop_in_exact_arithmetic(name):
    polygon, actions = scale(POLYGONS[name], 20, 20), ActionConfig(distances=[0.0, 50.0, 97.0])
    airspace = build_airspace([Region(polygon, name)], 30.0, 45.0, None, 3)
    ranking = Candidates(airspace, actions, 3).ranking
    points = airspace.exact_points[0].tolist()
    moves = [(d, math.radians(h)) for d in actions.distances for h in actions.headings]
    outside = 0
    for row in np.random.default_rng(0).integers(len(points) * len(moves), size=100).tolist():
        own, (distance, bearing) = row // len(moves), moves[row % len(moves)]
        target = [
            points[own][0] + distance * math.sin(bearing),
            points[own][1] + distance * math.cos(bearing),
        ]
        inside_polygon = shapely.contains_xy(polygon, *target)
        expected = nearest_by_loop(points, target, 5) if inside_polygon else [own] * 5
        assert ranking.point[row].tolist() == expected
        outside += not inside_polygon
    assert 10 < outside < 80


def test_tables_that_do_not_fit_are_refused_with_their_size():
    airspace = build_airspace([Region(shapely.box(0, 0, 7000, 7000), "large")], 30.0, 45.0, None, 100)
    with pytest.raises(InputError) as error:
        Candidates(airspace, ActionConfig(), 100)
    assert str(error.value) == (
        "region.lattice_step: 76657 landing points with 40 actions and 199 candidates each need 4.9 GB, more "
        "than 4 GB: raise region.lattice_step, set region.n_landing_points, list fewer actions.distances or "
        "actions.headings, lower region.pool, or take actions.kind=continuous"
    )
    Candidates(airspace, ActionConfig(kind="continuous"), 100)


def test_headings_are_clockwise_from_north():
    displaced = displacement(torch.tensor([10.0] * 4), torch.tensor([0.0, 90, 180, 270]).deg2rad())
    expected = [[0.0, 10.0], [10.0, 0.0], [0.0, -10.0], [-10.0, 0.0]]
    assert displaced.tolist() == [pytest.approx(pair, abs=1e-5) for pair in expected]


def test_the_table_holds_every_heading_of_the_first_distance_then_of_the_next():
    config = ActionConfig(distances=[0.0, 10.0], headings=[0.0, 90.0, -90.0])
    expected = [[d, math.radians(h)] for d in (0.0, 10.0) for h in (0.0, 90.0, -90.0)]
    assert config.n_actions == 6
    assert config.table().tolist() == [pytest.approx(row) for row in expected]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"kind": "both"}, "actions.kind: both is not one of discrete, continuous"),
        ({"distances": []}, "actions.distances: [] is empty"),
        ({"headings": []}, "actions.headings: [] is empty"),
        ({"distances": [-1.0]}, "actions.distances: -1.0 m is not at least 0 m"),
        ({"distances": [0.0]}, "actions.distances (largest): 0.0 m is not above 0 m"),
        ({"headings": [400.0]}, "actions.headings: 400.0 deg is not between -360 and 360 deg"),
    ],
)
def test_wrong_actions_are_named_with_their_value_and_unit(changed, message):
    with pytest.raises(InputError) as error:
        ActionConfig(**changed)
    assert str(error.value) == message


@both_kinds
def test_actions_that_lead_nowhere_are_refused_unless_there_is_one_landing_point(kind):
    def build(distance, kept=None):
        region = RegionConfig("vertices", vertices=SQUARE, n_landing_points=kept, initial_conditions=1)
        actions = ActionConfig(kind, distances=[0.0, distance], headings=[90.0])
        return Simulation(WorldConfig(agents=1, region=region, actions=actions), 1.0, trail=1, seed=0)

    with pytest.raises(
        InputError, match=r"actions.distances: \[0.0, 10.0\] \[m\] lead from no landing point"
    ):
        build(10.0)
    assert build(16.0).candidates.max_distance == 16.0
    assert build(10.0, kept=1).airspace.max_points == 1
