"""Polygons and landing points, compared with those of the original simulator."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings, strategies as st
from shapely.geometry import MultiPolygon, Point, Polygon

from damian.common.errors import InputError
from damian.world.regions.polygon import (
    landing_lattice,
    largest_vertex_distance,
    polygon_from_vertices,
    random_polygon,
    sample_interior,
)

GOLDEN = json.loads(
    (Path(__file__).parents[1] / "data" / "motion_energy_coverage.json").read_text()
)
SQUARE = Polygon([(0, 0), (100, 0), (100, 100), (0, 100)])
L_SHAPE = Polygon([(0, 0), (300, 0), (300, 100), (100, 100), (100, 300), (0, 300)])
WITH_HOLE = Polygon(SQUARE.buffer(100).exterior, [SQUARE.exterior])
TWO_PARTS = MultiPolygon([SQUARE, shapely.affinity.translate(SQUARE, 250, 40)])
SHAPES = {"square": SQUARE, "L": L_SHAPE, "with a hole": WITH_HOLE, "two parts": TWO_PARTS}


@pytest.mark.parametrize("example", GOLDEN["discretisation_examples"])
def test_the_lattice_has_the_landing_points_of_the_original_for_other_polygons(example):
    n = None if example["n_landing_points"] == "all" else example["n_landing_points"]
    polygon = polygon_from_vertices(example["polygon"], "example")
    points = landing_lattice(polygon, example["step"], example["deg"], n)
    np.testing.assert_allclose(points, example["landing_points_in_id_order"], atol=1e-6)


@pytest.mark.parametrize(
    ("step", "degrees", "n", "message"),
    [
        (500, 45, None, r"region\.lattice_step: 500 m lays no landing point inside the polygon"),
        (
            30,
            45,
            50,
            r"region\.n_landing_points: 50 is more than the 12 inside the polygon: lower it, or",
        ),
        (
            0.01,
            45,
            None,
            r"region\.lattice_step: 0\.01 m is too fine for a polygon of 100 m x 100 m",
        ),
    ],
)
def test_an_impossible_lattice_is_refused(step, degrees, n, message):
    with pytest.raises(InputError, match=f"^{message}"):
        landing_lattice(SQUARE, step, degrees, n)


def test_random_polygons_have_the_statistics_of_the_original():
    stats = GOLDEN["random_polygon_stats"]
    rng = np.random.default_rng(0)
    polygons = [random_polygon(rng, stats["min_area"], stats["max_area"]) for _ in range(300)]
    measured = {
        "area": lambda p: p.area,
        "n_vertices": lambda p: len(p.exterior.coords) - 1,
        "n_grid_points_inside": lambda p: len(landing_lattice(p, 30, 45)),
        "diameter": largest_vertex_distance,
    }
    for name, measure in measured.items():
        sample = np.array([measure(p) for p in polygons])
        # Four standard errors of the difference of two means over 300 and 1000 polygons.
        error = 4 * sample.std() * math.sqrt(1 / 300 + 1 / 1000)
        assert sample.mean() == pytest.approx(stats[name]["mean"], abs=error), name


@settings(max_examples=settings.default.max_examples // 4)
@given(st.integers(0, 2**32 - 1), st.floats(1, 1e10), st.floats(0, 1))
def test_a_random_polygon_is_convex_and_has_an_area_between_the_limits(seed, max_area, share):
    min_area = max(max_area * share, max_area * 1e-6)
    polygon = random_polygon(np.random.default_rng(seed), min_area, max_area)
    assert min_area * (1 - 1e-9) <= polygon.area <= max_area * (1 + 1e-9)
    assert polygon.area == pytest.approx(polygon.convex_hull.area)


def test_a_concave_polygon_stays_concave_whether_its_vertices_are_open_or_closed():
    corners = list(L_SHAPE.exterior.coords)
    for given_corners in (corners, corners[:-1], corners[:1] + corners, corners[::-1]):
        assert polygon_from_vertices(given_corners, "here").equals(L_SHAPE)


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        ([[0, 0], [1, 1]], "2 distinct points"),
        ([[0, 0], [1, 1], [2, 2], [3, 3]], "no area"),
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "edges cross at [0.5, 0.5] m"),
        ([[0, 0], [1, math.nan], [1, 0]], "[1, nan] is not [x, y] in metres"),
    ],
)
def test_vertices_that_form_no_polygon_are_refused(vertices, message):
    with pytest.raises(InputError, match=re.escape(f"region.vertices: {message}")):
        polygon_from_vertices(vertices, "region.vertices")


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_sampled_points_are_strictly_inside_and_uniform(shape):
    points = sample_interior(shape, 4000, np.random.default_rng(0))
    assert points.shape == (4000, 2)
    assert all(shape.contains(Point(p)) for p in points)
    xs, ys = np.linspace(shape.bounds[:2], shape.bounds[2:], 5).T
    counts = np.histogram2d(*points.T, bins=[xs, ys])[0]
    for i, j in np.ndindex(4, 4):
        share = (
            shape.intersection(shapely.box(xs[i], ys[j], xs[i + 1], ys[j + 1])).area / shape.area
        )
        spread = math.sqrt(4000 * share * (1 - share))
        assert counts[i, j] == pytest.approx(4000 * share, abs=4.5 * spread + 1e-6)
