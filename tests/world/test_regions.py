"""FIR tables and maps: regions of valid files, and the one-line error of each invalid file."""

import json
import sys
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pyogrio
import pyproj
import pytest
import shapely
from helpers import ring
from shapely.geometry import Polygon

import damian
from damian.common.errors import InputError
from damian.world.config import RegionConfig
from damian.world.regions.files import read_area
from damian.world.regions.fir import read_fir
from damian.world.regions.geodesy import EARTH_RADIUS_M, to_latlon

DATA = Path(__file__).parents[1] / "data" / "regions"
FIR = DATA / "fir.csv"
ZONES = DATA / "zones.geojson"
OUTLINES = DATA / "outlines.geojson"
SHIPPED = Path(damian.__file__).parent / "data" / "fir.csv"
DEGREE_M = EARTH_RADIUS_M * np.pi / 180


def _places(region):
    """Corners of a region converted back to degrees, [V, 2] (latitude, longitude)."""
    assert region.origin is not None
    return np.column_stack(to_latlon(*shapely.get_coordinates(region.polygon).T, region.origin))


def test_the_shipped_table_holds_the_llanbedr_polygon():
    region = read_fir(SHIPPED, "LlanbedrTest")
    assert (region.name, region.levels) == ("LlanbedrTest", (0, 60))
    assert region.origin == pytest.approx((52.813, -4.129), abs=1e-3)
    ends = [[52.814992, -4.132176], [52.814502, -4.132138]]
    np.testing.assert_allclose(_places(region)[[0, 9]], ends, atol=1e-9)
    assert len(region.polygon.exterior.coords) == 11
    # Expected area from the shoelace formula on a flat map at the region's latitude.
    flat = Polygon(_places(region)[:, ::-1]).area * DEGREE_M**2 * np.cos(np.radians(52.813))
    assert region.polygon.area == pytest.approx(flat, rel=1e-4)


def test_rows_of_a_table_are_ordered_by_sequence_number():
    region = read_fir(FIR, "North Bay")
    assert region.levels == (10, 45.5)
    corners = [[52.8, -4.13], [52.8, -4.12], [52.81, -4.12], [52.81, -4.13], [52.8, -4.13]]
    np.testing.assert_allclose(_places(region), corners, atol=1e-9)


def test_a_hole_stays_a_hole_and_heights_are_ignored():
    region = read_area(ZONES, where=["name=lake"])
    outer_area = Polygon(region.polygon.exterior).area
    assert region.polygon.area == pytest.approx(outer_area * 8 / 9, rel=1e-3)


def test_policies_are_measured_over_ten_outlines_of_which_four_have_a_hole():
    names = [each["properties"]["name"] for each in json.loads(OUTLINES.read_text())["features"]]
    polygons = [read_area(OUTLINES, where=[f"name:{name}"]).polygon for name in names]
    assert len({*names}) == 10
    assert sum(len(polygon.interiors) for polygon in polygons) == 4
    areas = [polygon.area for polygon in polygons]
    assert min(areas) == pytest.approx(120_000, rel=0.01)
    assert max(areas) == pytest.approx(280_000, rel=0.01)


RING = ring(8.0, 45.0, 8.01, 45.01)
POINT = {
    "type": "Feature",
    "properties": {},
    "geometry": {"type": "Point", "coordinates": [8, 45]},
}


def _polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


def _feature(geometry, **properties):
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def _collection(*features):
    return {"type": "FeatureCollection", "features": list(features)}


def _written(folder, name, content):
    file = folder / name
    file.write_text(content if isinstance(content, str) else json.dumps(content), "utf-8")
    return file


UNEVEN = [[[8.0, 45.0, 10], [8.01, 45.0], [8.01, 45.01, 11, 5], [8.0, 45.01], [8.0, 45.0, 10]]]
PARTLY_EMPTY = {"type": "MultiPolygon", "coordinates": [[], [RING]]}
FOLDED = {"type": "GeometryCollection", "geometries": [POINT["geometry"], _polygon(RING)]}


@pytest.mark.parametrize(
    "geometry",
    [
        _polygon(*UNEVEN),
        PARTLY_EMPTY,
        {"type": "GeometryCollection", "geometries": [FOLDED]},
    ],
)
def test_heights_empty_parts_and_collections_do_not_hide_an_area(tmp_path, geometry):
    empty = _feature(_polygon())
    file = _written(
        tmp_path, "square.geojson", _collection(empty, _feature(None), _feature(geometry))
    )
    plain = read_area(_written(tmp_path, "plain.json", _polygon(RING)))
    assert read_area(file).polygon.equals(plain.polygon)


def _crs(name):
    return {"type": "name", "properties": {"name": name}}


@pytest.mark.parametrize("holder", ["collection", "feature", "geometry"])
def test_the_coordinate_reference_system_of_geojson_is_obeyed(tmp_path, holder):
    grid = pyproj.Transformer.from_crs(
        "EPSG:4326", "EPSG:3035", always_xy=True
    )  # its axes: north, east
    geometry = _polygon([list(grid.transform(*corner)) for corner in RING])
    feature = _feature(geometry)
    document = _collection(feature) | {"crs": _crs("EPSG:3857")}  # the innermost counts
    holders = {"collection": document, "feature": feature, "geometry": geometry}
    holders[holder]["crs"] = _crs("urn:ogc:def:crs:EPSG::3035")
    corners = _places(read_area(_written(tmp_path, "utm.geojson", document)))
    np.testing.assert_allclose(corners, np.array(RING)[:, ::-1], atol=1e-9)


@pytest.mark.parametrize("turns", [-1, 0])
def test_longitudes_of_an_area_across_the_antimeridian_may_go_beyond_180_degrees(tmp_path, turns):
    lon, lat = np.array(ring(179.99, -17, 180.01, -16.99)).T
    found = []
    for written in (lon + 360 * turns, (lon + 180) % 360 - 180):
        outline = np.column_stack([written, lat]).tolist()
        found.append(read_area(_written(tmp_path, "fiji.geojson", _polygon(outline))))
    beyond, wrapped = found
    assert beyond.polygon.equals_exact(wrapped.polygon, 1e-6)
    assert beyond.origin == pytest.approx(wrapped.origin)


PLACEMARK = """<Folder><Placemark><name>{}</name><Polygon><outerBoundaryIs><LinearRing><coordinates>
{}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></Folder>"""


def _map(file):
    """Two areas with heights in a file of a suffix that GDAL knows."""
    areas = {
        "Łąka: a=b": [[*corner, 100.0] for corner in RING],
        "yard": [[x + 0.01, y, 0.0] for x, y in RING],
    }
    if file.suffix == ".kml":
        rings = {
            n: " ".join(",".join(map(str, corner)) for corner in area) for n, area in areas.items()
        }
        folders = "".join(PLACEMARK.format(name, ring) for name, ring in rings.items())
        kml = f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{folders}</Document></kml>'
        return _written(file.parent, file.name, kml)
    about = {"geometry_type": "Polygon Z", "crs": "EPSG:4326", "encoding": "UTF-8"}
    wkb = shapely.to_wkb(np.array([Polygon(area) for area in areas.values()]))
    pyogrio.raw.write(file, wkb, [np.array([*areas], dtype=object)], ["Name"], **about)
    return file


@pytest.mark.parametrize("suffix", [".gpkg", ".shp", ".kml", ".kmz"])
def test_maps_of_other_kinds_are_read_by_their_suffix(tmp_path, suffix):
    file = _map(tmp_path / f"map{suffix.replace('z', 'l')}")
    if suffix == ".kmz":
        with ZipFile(tmp_path / "map.kmz", "w") as archive:
            archive.write(file, "doc.kml")
        file = tmp_path / "map.kmz"
    square = read_area(_written(tmp_path, "square.geojson", _polygon(RING)))
    region = read_area(file, where=["Name:Łąka: a=b"])
    assert region.name == "Łąka: a=b"
    assert region.polygon.normalize().equals_exact(square.polygon.normalize(), 1e-6)
    assert read_area(file, index=[1]).name == "yard"


def test_the_fence_of_a_plan_is_latitude_and_longitude_without_what_it_excludes(tmp_path):
    def fence(outline, inclusion):
        return {
            "inclusion": inclusion,
            "polygon": [[lat, lon] for lon, lat in outline[:-1]],
            "version": 1,
        }

    inner = ring(8.0, 45.0, 8.005, 45.01)
    fences = {"circles": [], "polygons": [fence(inner, False), fence(RING, True)]}
    plan = {"fileType": "Plan", "geoFence": fences}
    whole = read_area(_written(tmp_path, "square.geojson", _polygon(RING))).polygon.area
    half = read_area(_written(tmp_path, "fence.plan", plan))
    assert half.polygon.area == pytest.approx(whole / 2, rel=1e-4)
    assert half.origin == pytest.approx((45.005, 8.0075), abs=1e-6)
    fences["circles"] = [
        {
            "circle": {"center": [45, 8], "radius": 40},
            "inclusion": False,
        }
    ]
    file = _written(tmp_path, "circle.plan", plan)
    _assert_one_line_error(file, "geoFence.circles: a circle is not read", lambda: read_area(file))


PICTURES = """<GroundOverlay><name>photo</name><Icon><href>photo.png</href></Icon><LatLonBox>
<north>45.1</north><south>45</south><east>8.1</east><west>8</west></LatLonBox></GroundOverlay><Placemark><name>start</name><Point>
<coordinates>8,45</coordinates></Point></Placemark><Placemark><name>outline</name><LinearRing><coordinates>{}
</coordinates></LinearRing></Placemark></Document>"""


def test_only_areas_of_a_map_count_and_what_else_is_in_it_is_told_once(tmp_path, capsys):
    file = _map(tmp_path / "map.kml")
    drawn = read_area(file, every=True).polygon
    rings = " ".join(f"{x},{y}" for x, y in RING)
    text = file.read_text("utf-8").replace("</Document>", PICTURES.format(rings))
    text = text.replace("<Polygon>", "<MultiGeometry><Polygon>", 1)
    text = text.replace("</Polygon>", "</Polygon></MultiGeometry>", 1)
    file.write_text(text, "utf-8")
    assert not capsys.readouterr().err
    for _ in range(2):
        assert read_area(file, every=True).polygon.equals(drawn)
    told = (
        "features[0] is a picture (GroundOverlay), features[1] is a Point, features[2] has no "
        "geometry"
    )
    assert capsys.readouterr().err == f"{file}: left out: {told}\n"
    both = read_area(file, where=["name:Łąka: a=b", "NAME=yard"])
    assert both.polygon.equals(drawn)
    assert not capsys.readouterr().err  # what is left out was not chosen
    points = _collection(POINT, _feature(_polygon(RING)))
    read_area(_written(tmp_path, "points.geojson", points))
    assert "points.geojson: left out: features[0] is a Point" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        (
            {"where": "park"},
            "region.where: park must be PROPERTY:VALUE, for example region.where=name:park",
        ),
        ({"index": 0, "where": "name:park"}, "region.where: .* both choose"),
        ({"index": []}, "region.index: .* chooses no feature"),
        ({"where": []}, "region.where: .* chooses no feature"),
    ],
)
def test_a_wrong_choice_of_features_is_refused_by_its_key(choice, message):
    with pytest.raises(InputError, match=f"^{message}"):
        RegionConfig(kind="geojson", path="park.geojson", **choice)


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyogrio", None)
    file = tmp_path / "map.gpkg"
    message = "needs pyogrio, which is missing: pip install 'damian[gis]'"
    _assert_one_line_error(file, message, lambda: read_area(file))


def test_parts_cut_at_the_antimeridian_are_united(tmp_path):
    west = ring(179.9, 1, 180, 1.1)
    east = ring(-180, 1, -179.9, 1.1)
    parts = {"type": "MultiPolygon", "coordinates": [[west], [east]]}
    region = read_area(_written(tmp_path, "cut.geojson", parts))
    assert isinstance(region.polygon, Polygon)
    assert region.polygon.area == pytest.approx(0.2 * 0.1 * DEGREE_M**2, rel=1e-3)


HEADER = b"Airspace ID,Min Flight Level,Max Flight Level,Sequence Number,Latitude,Longitude\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"Airspace ID\xff", "byte 11 is not UTF-8"),
        (HEADER + b"A,0,60,0,95,-4.13", "line 2: Latitude 95 deg is not between -90"),
        (
            HEADER + b"A,0,60,0,52,-4.13\nA,0,60,2,52,-4.12",
            "Sequence Number [0.0, 2.0] do not count from 0",
        ),
    ],
)
def test_an_invalid_table_raises_one_line_that_names_the_file_and_the_fault(
    tmp_path, text, message
):
    file = tmp_path / "bad.csv"
    file.write_bytes(text)
    _assert_one_line_error(file, message, lambda: read_fir(file, "A"))


FAR_HOLE = [[18, 45], [18.01, 45], [18.01, 45.01], [18, 45]]
TWO_FEATURES = _collection(_feature(_polygon(RING), zone="a"), _feature(_polygon(RING), zone="b"))

CORNERS = [[lat, lon] for lon, lat in RING]
SURVEY = {"items": [{"complexItemType": "survey", "polygon": CORNERS}]}
LINE = _feature({"type": "LineString", "coordinates": RING})
METRES = _polygon([[5e5, 4e6], [6e5, 4e6], [6e5, 5e6]])


@pytest.mark.parametrize(
    ("content", "choice", "message"),
    [
        ('{"type":\n oops}', {}, "is not GeoJSON: JSONDecodeError"),
        (
            TWO_FEATURES,
            {},
            "2 features are areas: choose by region.index=NUMBER or region.where=PROPERTY",
        ),
        (TWO_FEATURES, {"where": ["zone=c"]}, "fits 0 features, not one; the file has 'a', 'b'"),
        (LINE, {}, "feature is a LineString; a region is an area: draw a closed outline (Polygon)"),
        (METRES, {}, "[500000.0, 4000000.0] is not a longitude"),
        (_polygon(RING) | {"crs": _crs("EPSG:999999")}, {}, "reference system is not understood: "),
        (
            _polygon(RING[:-1]),
            {},
            "geometry: its outline is open: repeat the first corner at the end",
        ),
        (_polygon(RING, FAR_HOLE), {}, "hole lies outside shell at [18, 45] deg"),
    ],
)
def test_an_invalid_map_raises_one_line_that_names_the_file_and_the_fault(
    tmp_path, content, choice, message
):
    file = _written(tmp_path, "bad.geojson", content)
    _assert_one_line_error(file, message, lambda: read_area(file, **choice))


@pytest.mark.parametrize(
    ("fence", "message"),
    [
        ({}, "geoFence: the plan has none, and a survey is no area: draw a polygon as its fence"),
        (
            {"geoFence": {"polygons": [{"inclusion": True, "polygon": CORNERS[:2]}]}},
            "2 distinct points",
        ),
    ],
)
def test_a_plan_without_the_outline_of_a_fence_is_refused_with_the_remedy(tmp_path, fence, message):
    file = _written(tmp_path, "fence.plan", {"fileType": "Plan", "mission": SURVEY, **fence})
    _assert_one_line_error(file, message, lambda: read_area(file))


def _assert_one_line_error(file, message, read):
    with pytest.raises(InputError) as error:
        read()
    line = str(error.value)
    assert line.startswith(f"{file}: ")
    assert message in line
    assert len(line.splitlines()) == 1
