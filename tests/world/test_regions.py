"""FIR tables and GeoJSON: regions of valid files, and the one-line error of each invalid file."""

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import Polygon

import damian
from damian.common.errors import InputError
from damian.world.regions.fir import read_fir
from damian.world.regions.geodesy import EARTH_RADIUS_M, to_latlon
from damian.world.regions.geojson import read_geojson
from damian.world.regions.region import Region

DATA = Path(__file__).parents[1] / "data" / "regions"
FIR, ZONES = DATA / "fir.csv", DATA / "zones.geojson"
SHIPPED = Path(damian.__file__).parent / "data" / "fir.csv"
DEGREE_M = EARTH_RADIUS_M * np.pi / 180


def _places(region: Region) -> np.ndarray:
    """Corners of a region converted back to degrees, [V, 2] (latitude, longitude)."""
    assert region.origin is not None
    return np.column_stack(to_latlon(*shapely.get_coordinates(region.polygon).T, region.origin))


# --- valid files --------------------------------------------------------------------------------


def test_the_shipped_table_holds_the_llanbedr_polygon():
    region = read_fir(SHIPPED, "LlanbedrTest")
    assert (region.name, region.levels) == ("LlanbedrTest", (0, 60))
    assert region.origin == pytest.approx((52.813, -4.129), abs=1e-3)
    assert _places(region)[[0, 9]] == pytest.approx(
        np.array([[52.814992, -4.132176], [52.814502, -4.132138]]), abs=1e-9
    )
    assert len(region.polygon.exterior.coords) == 11
    # Expected area from the shoelace formula on a flat map at the region's latitude.
    flat = Polygon(_places(region)[:, ::-1]).area * DEGREE_M**2 * np.cos(np.radians(52.813))
    assert region.polygon.area == pytest.approx(flat, rel=1e-4)


def test_rows_of_a_table_are_ordered_by_sequence_number():
    region = read_fir(FIR, "North Bay")
    assert region.levels == (10, 45.5)
    corners = [[52.8, -4.13], [52.8, -4.12], [52.81, -4.12], [52.81, -4.13], [52.8, -4.13]]
    np.testing.assert_allclose(_places(region), corners, atol=1e-9)
    width = 0.01 * DEGREE_M * np.cos(np.radians(52.805))
    assert region.polygon.area == pytest.approx(width * 0.01 * DEGREE_M, rel=1e-4)


def test_a_hole_stays_a_hole_and_heights_are_ignored():
    region = read_geojson(ZONES, where="name=lake")
    assert len(region.polygon.interiors) == 1
    outer_area = Polygon(region.polygon.exterior).area
    assert region.polygon.area == pytest.approx(outer_area * 8 / 9, rel=1e-3)
    assert not region.polygon.contains(region.polygon.centroid)


SQUARE = [[[8.0, 45.0], [8.01, 45.0], [8.01, 45.01], [8.0, 45.01], [8.0, 45.0]]]
POINT = {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [8, 45]}}


def _polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


def _feature(geometry, **properties):
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def _collection(*features):
    return {"type": "FeatureCollection", "features": list(features)}


@pytest.mark.parametrize(
    "document",
    [
        _polygon(*SQUARE),
        {"type": "MultiPolygon", "coordinates": [SQUARE]},
        _feature(_polygon(*SQUARE)),
        _collection(POINT, _feature(_polygon(*SQUARE))),
    ],
    ids=["Polygon", "MultiPolygon", "Feature", "FeatureCollection"],
)
def test_each_kind_of_geojson_yields_its_only_area(tmp_path, document):
    file = tmp_path / "square.geojson"
    file.write_text(json.dumps(document), encoding="utf-8-sig")
    region = read_geojson(file)
    corners = [[45, 8], [45, 8.01], [45.01, 8.01], [45.01, 8], [45, 8]]
    area = (0.01 * DEGREE_M) ** 2 * np.cos(np.radians(45.005))
    assert region.polygon.area == pytest.approx(area, rel=1e-4)
    assert sorted(_places(region).round(9).tolist()) == sorted(corners)


def test_parts_cut_at_the_antimeridian_are_united(tmp_path):
    west = [[179.9, 1], [180, 1], [180, 1.1], [179.9, 1.1], [179.9, 1]]
    east = [[-180, 1], [-179.9, 1], [-179.9, 1.1], [-180, 1.1], [-180, 1]]
    file = tmp_path / "cut.geojson"
    file.write_text(json.dumps({"type": "MultiPolygon", "coordinates": [[west], [east]]}))
    region = read_geojson(file)
    assert isinstance(region.polygon, Polygon)
    assert region.polygon.area == pytest.approx(0.2 * 0.1 * DEGREE_M**2, rel=1e-3)


# --- invalid files ------------------------------------------------------------------------------

HEADER = "Airspace ID,Min Flight Level,Max Flight Level,Sequence Number,Latitude,Longitude\n"
ROWS = ("A,0,60,0,52.80,-4.13", "A,0,60,1,52.80,-4.12", "A,0,60,2,52.81,-4.12")


def _table(*last_rows: str, header: str = HEADER) -> str:
    """Valid table with its last rows replaced."""
    return header + "\n".join([*ROWS[: len(ROWS) - len(last_rows)], *last_rows]) + "\n"


INVALID_TABLES = {
    "not UTF-8": (b"Airspace ID\xff", "byte 11 is not UTF-8"),
    "latitude 95": (_table("A,0,60,2,95,-4.12"), "line 4: Latitude 95 deg is not between -90"),
    "crossing edges": (_table() + "A,0,60,3,52.79,-4.125\n", "A: edges cross at [-4.1225, 52.8] deg"),
}


@pytest.mark.parametrize(("text", "message"), INVALID_TABLES.values(), ids=INVALID_TABLES)
def test_an_invalid_table_raises_one_line_that_names_the_file_and_the_fault(tmp_path, text, message):
    file = tmp_path / "bad.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    _assert_one_line_error(file, message, lambda: read_fir(file, "A"))


FAR_HOLE = [[18, 45], [18.01, 45], [18.01, 45.01], [18, 45]]
RING = SQUARE[0]
TWO_FEATURES = _collection(_feature(_polygon(RING), zone="a"), _feature(_polygon(RING), zone="b"))

INVALID_GEOJSON = {
    "not JSON": ('{"type":\n oops}', {}, "is not GeoJSON: JSONDecodeError"),
    "no choice": (
        TWO_FEATURES,
        {},
        "2 features are areas: choose one by index or property=value: features[0]",
    ),
    "where no value": (TWO_FEATURES, {"where": "zone=c"}, "fits 0 features, not one; the file has 'a', 'b'"),
    "hole outside": (_polygon(RING, FAR_HOLE), {}, "hole lies outside shell at [18, 45] deg"),
}


@pytest.mark.parametrize(("content", "choice", "message"), INVALID_GEOJSON.values(), ids=INVALID_GEOJSON)
def test_an_invalid_geojson_raises_one_line_that_names_the_file_and_the_fault(
    tmp_path, content, choice, message
):
    file = tmp_path / "bad.geojson"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    _assert_one_line_error(file, message, lambda: read_geojson(file, **choice))


def _assert_one_line_error(file: Path, message: str, read) -> None:
    with pytest.raises(InputError) as error:
        read()
    line = str(error.value)
    assert line.startswith(f"{file}: ")
    assert message in line
    assert len(line.splitlines()) == 1
