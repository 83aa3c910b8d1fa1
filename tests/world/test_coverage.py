"""Coverage by bit masks, against exact geometry by shapely, the authors' figures and symmetries."""

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
import shapely
import torch
from shapely.affinity import translate
from shapely.geometry import MultiPolygon, Point, Polygon
from twin import exact_share

from damian.world.coverage import build_tables, covered_share

DATA = Path(__file__).parents[1] / "data"
R = 56.2341


def star(rng, low, high):
    """A random polygon around (0, 0) whose vertices lie at distances ``low .. high`` [m]."""
    n = rng.integers(5, 12)
    angle = 2 * np.pi * (np.arange(n) + rng.uniform(0, 0.8, n)) / n
    r = rng.uniform(low, high, n)
    return Polygon(np.stack([r * np.cos(angle), r * np.sin(angle)], -1))


def random_polygon(rng, kind):
    """A random polygon a few footprints wide."""
    if kind == "convex":
        return star(rng, 150, 250).convex_hull
    concave = star(rng, 80, 250)
    if kind == "concave":
        return concave
    if kind == "hole":
        return concave.difference(Point(rng.uniform(-50, 50, 2)).buffer(rng.uniform(15, 60)))
    east = translate(concave, 520)
    return MultiPolygon([concave, east])


def random_points(rng, polygon, count, spread):
    """Random points inside the polygon: all over it, or in squares of half-width ``spread`` [m]."""
    inside = np.empty((0, 2))
    centre = rng.uniform(-60, 60, 2)
    while len(inside) < count:
        low, high = np.split(np.array(polygon.bounds), 2)
        points = rng.uniform(low, high, (500, 2))
        points = points if spread is None else centre + rng.uniform(-spread, spread, (500, 2))
        inside = np.concatenate([inside, points[shapely.contains_xy(polygon, *points.T)]])
        centre = rng.uniform(low, high)
    return inside[:count]


def share_at(polygon, positions, radius=R):
    """Coverage ``[*, N]`` with tables built for exactly these positions ``[*, N, n, 2]`` [m]."""
    positions = np.asarray(positions, float)
    tables = build_tables([polygon], positions.reshape(1, -1, 2), radius)
    ids = torch.arange(positions[..., 0].size).view(positions.shape[:-1])
    return covered_share(tables, ids, torch.tensor(positions, dtype=torch.float32)).numpy()


@pytest.mark.parametrize("kind", ["convex", "concave", "hole", "parts"])
@pytest.mark.parametrize("spread", [None, 70.0, 25.0])
def test_coverage_is_within_one_percent_of_the_exact_area(kind, spread):
    rng = np.random.default_rng([len(kind), int(spread or 0)])
    for n_uavs, n_last in itertools.product(range(1, 7), range(1, 4)):
        polygon = random_polygon(rng, kind)
        positions = random_points(rng, polygon, n_uavs * n_last, spread)
        positions = positions.reshape(n_uavs, n_last, 2)
        got = share_at(polygon, positions)
        exact = exact_share(polygon, positions, R)
        np.testing.assert_allclose(got, exact, rtol=0, atol=0.01)


def test_the_authors_areas_are_reproduced_within_one_percent_of_the_disc():
    golden = json.loads((DATA / "motion_energy_coverage.json").read_text())["coverage"]
    scenario = json.loads((DATA / "usecase1.json").read_text())["scenario"]
    polygon = Polygon(scenario["polygon_vertices_ring"])
    radius = golden["footprint_radius"]
    assert len(golden["cases"]) == 6
    for case in golden["cases"]:
        newest = [[old_new[-1]] for old_new in case["stored_positions_old_new"]]
        expected = np.array(case["clean_current_disc_minus_polygon_and_others_m2"])
        got = share_at(polygon, newest, radius) * math.pi * radius**2
        np.testing.assert_allclose(
            got,
            expected,
            rtol=0,
            atol=0.01 * golden["disc_area"],
        )
