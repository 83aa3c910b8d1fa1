"""Actions against plain loops: booking in index order, nearest points, inside tests, the action
table."""

import math
from fractions import Fraction

import numpy as np
import pytest
import shapely
import torch
import twin
from helpers import SQUARE, both_kinds
from hypothesis import given, settings, strategies as st
from shapely.affinity import translate
from shapely.geometry import MultiPolygon, Polygon

from damian.common.errors import InputError
from damian.world import airspace as search, landing
from damian.world.airspace import build_airspace, build_cells, inside, nearest_points
from damian.world.config import RegionConfig, WorldConfig
from damian.world.landing import ActionConfig, Ranking, assign_landing_points
from damian.world.regions.region import Region
from damian.world.simulation import Simulation


def random_bookings(seed, n_worlds, n_agents, n_points, together):
    """Random preferences, standing points (at most 3 if ``together``), and reach, below 0 for some
    UAVs."""
    rng = np.random.default_rng(seed)
    n_candidates = min(2 * n_agents - 1, n_points)
    ranked = np.stack([rng.permutation(n_points)[:n_candidates] for _ in range(40)])
    # Few different preferences make UAVs compete: many UAVs share a row.
    row = rng.integers(0, rng.integers(1, 40, endpoint=True), (n_worlds, n_agents))
    if together:
        standing = rng.integers(0, min(n_points, 3), (n_worlds, n_agents))
    else:
        standing = np.stack([rng.permutation(n_points)[:n_agents] for _ in range(n_worlds)])
    # Rounded, so that some distances are just in reach.
    ranking = Ranking(
        torch.as_tensor(ranked).int(), torch.as_tensor(rng.random(ranked.shape).round(1))
    )
    reach = torch.as_tensor(rng.uniform(-0.3, 1.2, row.shape).round(1))
    return ranking, torch.as_tensor(row), torch.as_tensor(standing), reach


def booked_by_twin(ranking, row, standing, reach):
    """Points that UAVs book one after the other; out of reach means holding."""
    reached = ranking.distance[row] <= reach.unsqueeze(-1)
    wishes = torch.where(reached, ranking.point[row].long(), standing.unsqueeze(-1)).tolist()
    ready = [True] * row.shape[1]
    return [
        twin.assign_landing_points(*each, ready)
        for each in zip(wishes, standing.tolist(), strict=True)
    ]


@pytest.mark.parametrize("few", [0, 25])
@settings(max_examples=settings.default.max_examples // 3)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_agents=st.integers(1, 25),
    spare=st.integers(0, 20),
    together=st.booleans(),
)
def test_booking_at_once_and_one_by_one_equals_a_sequential_loop(
    few, seed, n_agents, spare, together
):
    n_points = n_agents + spare
    case = random_bookings(seed, 6, n_agents, n_points, together)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(landing, "_FEW_AGENTS", few)
        patch.setattr(landing, "BOOKING_CHUNK", 4 * n_points)  # four worlds at once
        ours = assign_landing_points(*case, n_points)
    assert ours.tolist() == booked_by_twin(*case)
    assert together or all(len({*world}) == n_agents for world in ours.tolist())
    assert ours[case[-1] < 0].equal(case[2][case[-1] < 0])


def centimetres(point, target):
    """Distance of two places in whole centimetres, half a one rounded up, without rounding errors.

    The boundary lies 1e-8 m below the half, so that float error cannot move a true half across it.
    """
    squared = sum(
        (100 * (Fraction(p) - Fraction(t))) ** 2 for p, t in zip(point, target, strict=True)
    )
    up = Fraction(500_001, 1_000_000)
    whole = math.isqrt(squared.numerator // squared.denominator)
    return whole + ((whole + 1 - up) ** 2 <= squared)


def nearest_by_loop(points, target, n):
    """The n nearest points; of equally near ones the lowest id first."""
    ids = sorted(range(len(points)), key=lambda i: (centimetres(points[i], target), i))
    return (ids + [-1] * n)[:n]


def some_points(rng, kind, n):
    """Scattered points, points in two far clusters, or a lattice whose points are often equally
    far."""
    if kind == "lattice":
        east, north = np.divmod(np.arange(n), math.ceil(math.sqrt(n)))
        return np.stack([east * 30.0, north * 30 * math.sin(math.pi / 4)], -1)[rng.permutation(n)]
    points = rng.uniform(-200, 200, (n, 2))
    return points + 5000.0 * (kind == "clusters") * rng.integers(0, 2, (n, 1))


@settings(max_examples=settings.default.max_examples // 4)
@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.lists(
        st.sampled_from(["scattered", "clusters", "lattice"]),
        min_size=1,
        max_size=3,
    ),
    n=st.integers(1, 9),
)
def test_the_nearest_points_are_those_of_a_loop_in_exact_arithmetic(seed, kinds, n):
    rng = np.random.default_rng(seed)
    lattices = [some_points(rng, kind, int(rng.integers(1, 40))) for kind in kinds]
    radii = rng.uniform(20, 500, len(kinds))
    polygons = [
        shapely.MultiPoint(points).buffer(r) for points, r in zip(lattices, radii, strict=True)
    ]
    region = rng.integers(len(kinds), size=12)
    target = np.empty((12, 2))
    for i, (points, radius) in enumerate((lattices[r], radii[r]) for r in region):
        distance = rng.uniform(0, 0.9 * radius)
        angle = rng.uniform(0, 2 * math.pi)
        if rng.random() < 0.5:  # round numbers, so that points may be equally near
            distance = min(rng.choice([0.0, 15.0, 30.0, 45.005]), distance)
            angle = math.pi / 4 * rng.integers(8)
        move = distance * np.array([math.sin(angle), math.cos(angle)])
        target[i] = points[rng.integers(len(points))] + move
    most = max(map(len, lattices))
    padded = np.stack(
        [np.pad(p, ((0, most - len(p)), (0, 0)), constant_values=np.inf) for p in lattices]
    )
    n = min(n, most)
    cells = build_cells(lattices, polygons, n)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "_SLOTS", int(rng.choice([10, 2**18])))
        ours = nearest_points(cells, *map(torch.as_tensor, (padded, region, target)), n)
    for found, r, place in zip(ours.tolist(), region, target.tolist(), strict=True):
        assert found == nearest_by_loop(lattices[r].tolist(), place, n)


HORSESHOE = Polygon([(0, 0), (10, 0), (10, 8), (7, 8), (7, 3), (3, 3), (3, 8), (0, 8)])
HOLED = Polygon([(-4, -3), (9, -5), (12, 4), (3, 9), (-6, 5)], [[(0, 0), (4, 0), (4, 4), (0, 4)]])


@pytest.mark.parametrize(
    "polygon", [HORSESHOE, HOLED, MultiPolygon([HORSESHOE, translate(HOLED, 20, 3)])]
)
def test_inside_equals_shapelys_contains(polygon):
    rng = np.random.default_rng(3)
    airspace = build_airspace([Region(polygon, "test")], RegionConfig(lattice_step=1.0), 1)
    west, south, east, north = polygon.bounds
    target = rng.uniform([west - 1, south - 1], [east + 1, north + 1], (2000, 2))
    # A quarter of the targets have the y of some corner, so that their rays meet the ends of edges.
    corners = shapely.get_coordinates(polygon)
    target[:500, 1] = corners[rng.integers(len(corners), size=500), 1]
    target = target.astype(np.float32).astype(float)
    off_boundary = shapely.distance(polygon.boundary, shapely.points(target)) > 1e-3
    ours = inside(airspace.edges[0], torch.as_tensor(target[off_boundary], dtype=torch.float32))
    expected = shapely.contains_xy(polygon, target[off_boundary])
    assert 300 < expected.sum() < len(expected) - 300
    assert ours.numpy().tolist() == expected.tolist()


@both_kinds
def test_actions_that_lead_nowhere_are_refused_unless_there_is_one_landing_point(kind):
    def build(distance, kept=None):
        region = RegionConfig(
            "vertices", vertices=SQUARE, n_landing_points=kept, initial_conditions=1
        )
        actions = ActionConfig(kind, distances=[0.0, distance], headings=[90.0])
        return Simulation(
            WorldConfig(
                agents=1,
                region=region,
                actions=actions,
            ),
            1.0,
            stops=1,
            seed=0,
        )

    with pytest.raises(InputError, match=r"actions.distances: .* lead from no landing point"):
        build(10.0)
    assert build(16.0).candidates.max_distance == 16.0
    assert build(10.0, kept=1).airspace.max_points == 1
