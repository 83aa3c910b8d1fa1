"""Regions whose holes touch the shell: laid out in metres, a corner may leave the edge that it touches."""

import json

import numpy as np
import pytest
import shapely

from damian.common.errors import InputError
from damian.world.regions.geodesy import EARTH_RADIUS_M, to_local
from damian.world.regions.geojson import read_geojson
from damian.world.regions.polygon import landing_lattice, sample_interior

DEGREE_M = EARTH_RADIUS_M * np.pi / 180
SHELL = [[9.996, 49.996], [10.004, 49.996], [10.004, 50.004], [9.996, 50.004]]
HOLES = {
    "west": [[9.996, 50.001], [9.998, 50.001], [9.998, 49.999]],
    "east": [[10.004, 50.0], [10.002, 49.999], [10.002, 50.001]],
    "south": [[10.0, 49.996], [9.999, 49.998], [10.001, 49.998]],
    "north": [[10.001, 50.004], [10.001, 50.002], [9.999, 50.002]],
    "a corner": [[9.996, 49.996], [9.997, 49.999], [9.999, 49.997]],
}


def read(tmp_path, *rings):
    """The region of a GeoJSON polygon with these rings [V, 2] degrees, which are not closed."""
    file = tmp_path / "region.geojson"
    file.write_text(json.dumps({"type": "Polygon", "coordinates": [[*ring, ring[0]] for ring in rings]}))
    return read_geojson(file)


@pytest.mark.parametrize("hole", HOLES.values(), ids=HOLES)
@pytest.mark.parametrize("latitude", [-30.0, 80.0])
def test_a_hole_may_touch_the_shell(tmp_path, hole, latitude):
    shell, hole = ([[x, y - 50 + latitude] for x, y in ring] for ring in (SHELL, hole))
    region = read(tmp_path, shell, hole)
    assert isinstance(region.polygon, shapely.Polygon)
    assert region.polygon.is_valid
    expected = shapely.Polygon(shell, [hole]).area * DEGREE_M**2 * np.cos(np.radians(latitude))
    assert region.polygon.area == pytest.approx(expected, rel=1e-3)
    longitudes, latitudes = np.transpose(hole)
    inner = shapely.Polygon(np.column_stack(to_local(latitudes, longitudes, region.origin)))
    assert region.polygon.intersection(inner).area < 1e-6 * inner.area
    points = [landing_lattice(region.polygon, 20, 45)]
    points += [sample_interior(region.polygon, 200, np.random.default_rng(0))]
    assert not shapely.contains_xy(inner, np.concatenate(points)).any()


def test_a_hole_that_the_map_moves_across_an_edge_is_refused(tmp_path):
    # Straight in metres, the southern edge runs up to 0.4 deg north of the parallel through its ends.
    shell = [[0, 60], [20, 60], [20, 62], [0, 62]]
    with pytest.raises(InputError, match="edges cross once laid out in metres; take a smaller region"):
        read(tmp_path, shell, [[9, 60.2], [11, 60.2], [10, 60.8]])
