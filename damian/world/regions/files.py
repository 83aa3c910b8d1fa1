"""Reads areas of maps: GeoJSON (RFC 7946), fences of QGroundControl plans, KML, GeoPackage,
shapefiles."""

import json
import os
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely.geometry import mapping

from damian.common.errors import InputError
from damian.common.text_files import listed, named, near, one_line, read_text, show
from damian.world.regions.geodesy import Floats
from damian.world.regions.region import Region, local_region

GeoJson = dict[str, Any]
"""An object of GeoJSON, or the properties of a feature."""
_AREAS = ("Polygon", "MultiPolygon", "GeometryCollection")
_DEGREES = re.compile(r"(CRS:?84|EPSG:[\d.]*:?4326)$", re.IGNORECASE)
"""Names of WGS 84, the coordinate reference system of GPS and of GeoJSON."""
_REMEDY = "save the map in WGS 84 (EPSG:4326)"
_DRAW = "draw a polygon as its fence in QGroundControl, and save it there"
_KML = (".kml", ".kmz")


class _Feature(NamedTuple):
    """One feature of a file; ``place`` is its path in the document, such as ``features[2]``."""

    place: str
    properties: GeoJson
    geometry: GeoJson
    """As in GeoJSON."""
    crs: Any = None
    """Coordinate reference system: a name, an object of GeoJSON, or None for longitude and
    latitude."""
    is_excluded: bool = False
    """Whether UAVs must keep out of it."""

    @property
    def fault(self) -> str:
        """Why it cannot be a region; empty if it can."""
        if any(_polygons(self.geometry)):
            return "is excluded" if self.is_excluded else ""
        kind = self.geometry.get("type")
        return f"is a {kind}{' without corners' * (kind in _AREAS)}" if kind else "has no geometry"


def read_area(
    path: str | os.PathLike[str],
    index: Sequence[int] = (),
    where: Sequence[str] = (),
    every: bool = False,
) -> Region:
    """Read one area of a file, or unite several; the suffix of the file says how it is read.

    An area is a Polygon, a MultiPolygon, or what a GeometryCollection has of them. Heights are
    ignored. Parts that touch or overlap are united; those that a plan excludes are cut out.

    Neither ``index`` nor ``where`` is needed if only one feature is an area. What is no area is
    left out, which a line on stderr tells if nothing was chosen.

    Args:
        path: the file.
        index: the indices of the features, counted from 0 over all of the file.
        where: for each feature a property that only it has, as ``property:value`` or
            ``property=value``; the property's name may be in capitals or not.
        every: unite all features that are areas.

    Raises:
        InputError: the file cannot be read, the chosen geometry is invalid, or the choice does not
            single out features.
    """
    path = Path(path)
    read, kind = _READERS.get(path.suffix.lower(), (_from_geojson, "GeoJSON"))
    with named(path):
        try:
            features = read(path)
            areas = [number for number, each in enumerate(features) if not each.fault]
            chosen = _choose(features, areas if every else index, where)
            parts, excluded = (
                [
                    [_degrees(ring, each) for ring in rings]
                    for each in some
                    for rings in _polygons(each.geometry)
                ]
                for some in (chosen, [each for each in features if each.is_excluded])
            )
        except InputError:
            raise
        except Exception as error:  # a file can hold anything at any place
            raise InputError(f"is not {kind}: {error!r}") from None
        left_out = [each for each in features if each.fault and not each.is_excluded]
        if left_out and (every or not (index or where)):
            _tell(f"{path}: left out: {listed(f'{each.place} {each.fault}' for each in left_out)}")
        names = [_name(each) or f"{path.stem} {each.place}" for each in chosen]
        return local_region(
            parts, listed(names), None, listed(each.place for each in chosen), excluded
        )


@cache
def _tell(line: str) -> None:
    """Print a line once, however many environments read the map."""
    print(one_line(line), file=sys.stderr)


def _value(feature: _Feature, key: str) -> Any:
    """A property of a feature, or the one whose name differs only in capitals: KML writes
    ``Name``."""
    named_so = {each.lower(): value for each, value in feature.properties.items()}
    return feature.properties.get(key, named_so.get(key.lower()))


def _name(feature: _Feature) -> str:
    name = _value(feature, "name")
    return name if isinstance(name, str) else ""


def _from_geojson(path: Path) -> list[_Feature]:
    """All features of GeoJSON; a bare geometry counts as a feature without properties."""
    document = json.loads(read_text(path))
    if document["type"] not in ("Feature", "FeatureCollection"):
        return [_Feature("geometry", {}, document, document.get("crs"))]
    alone = document["type"] == "Feature"
    found = []
    for i, each in enumerate([document] if alone else document["features"]):
        geometry = each.get("geometry") or {}
        crs = next(filter(None, (holder.get("crs") for holder in (geometry, each, document))), None)
        place = "feature" if alone else f"features[{i}]"
        found.append(_Feature(place, each.get("properties") or {}, geometry, crs))
    return found


def _from_plan(path: Path) -> list[_Feature]:
    """The polygons of the fence of a plan, whose corners are latitude and longitude, the first
    once."""
    fence = json.loads(read_text(path)).get("geoFence") or {}
    found = []
    if fence.get("circles"):
        raise InputError("geoFence.circles: a circle is not read; draw a polygon in its place")
    if "polygon" in fence:
        raise InputError(f"geoFence: its version, before 2, is not read: {_DRAW}")
    if not fence.get("polygons"):
        raise InputError(f"geoFence: the plan has none, and a survey is no area: {_DRAW}")
    for i, each in enumerate(fence["polygons"]):
        ring = [[lon, lat] for lat, lon, *_ in each["polygon"]]
        geometry = {"type": "Polygon", "coordinates": [ring + ring[:1]]}
        is_excluded = not each["inclusion"]
        found.append(_Feature(f"geoFence.polygons[{i}]", {}, geometry, None, is_excluded))
    return found


def _from_map(path: Path) -> list[_Feature]:
    """All features of all layers of a file that GDAL reads, but of tables without shapes, such as
    styles."""
    pyogrio = _extra("pyogrio", f"a file {path.suffix}")
    found = []
    if not path.is_file():
        raise InputError("no such file")
    for layer in (name for name, kind in pyogrio.list_layers(path) if kind is not None):
        with warnings.catch_warnings(
            action="ignore", category=RuntimeWarning
        ):  # of outlines that are open
            about, _, shapes, columns = pyogrio.raw.read(path, layer=layer, force_2d=True)
        columns = [column.tolist() for column in columns]
        for i, shape in enumerate(shapes):
            properties = {
                name: column[i] for name, column in zip(about["fields"], columns, strict=True)
            }
            place = f"features[{len(found)}]"
            if path.suffix.lower() in _KML and shape and _is_picture(properties):
                geometry = {"type": "picture (GroundOverlay)"}
            else:
                geometry = _of_wkb(shape, place)
            found.append(_Feature(place, properties, geometry, about["crs"] or {}))
    return found


def _is_picture(properties: GeoJson) -> bool:
    """Is a shape of a KML the outline of a picture? Of all others GDAL says whether they are
    extruded."""
    return properties.get("extrude", 0) not in (0, 1)  # but None, or nan


def _of_wkb(shape: bytes | None, place: str) -> GeoJson:
    """The geometry of well-known binary, as in GeoJSON; empty if there is none."""
    try:
        return mapping(shapely.from_wkb(shape)) if shape else {}
    except shapely.errors.GEOSException as error:
        raise InputError(f"{place}: {error}; draw a closed outline (Polygon)") from None


_READERS = {".plan": (_from_plan, "a plan of QGroundControl")} | {
    suffix: (_from_map, f"a map ({suffix})") for suffix in (*_KML, ".gpkg", ".shp")
}
"""How files are read that are not GeoJSON, and what they are, by their suffixes."""


def _extra(module: str, what: str) -> Any:
    """A module of the extra ``gis``."""
    try:
        return import_module(module)
    except ModuleNotFoundError:
        raise InputError(
            f"{what} needs {module}, which is missing: pip install 'damian[gis]'"
        ) from None


def _choose(features: list[_Feature], index: Sequence[int], where: Sequence[str]) -> list[_Feature]:
    """Find the features chosen by ``index`` or ``where``, or else the only one that is an area."""
    if index:
        if max(index) >= len(features):
            raise InputError(f"region.index: {max(index)} is not between 0 and {len(features) - 1}")
        chosen = [features[number] for number in index]
    elif where:
        chosen = [_fitting(features, each) for each in where]
    else:
        chosen = [each for each in features if not each.fault]
        if len(chosen) > 1:
            choice = listed(f"{each.place} {show(each.properties)}" for each in chosen)
            problem = "choose by region.index=NUMBER or region.where=PROPERTY:VALUE, one or a list"
            raise InputError(f"{len(chosen)} features are areas: {problem}: {choice}")
    wrong = [f"{each.place} {each.fault}" for each in chosen or features if each.fault]
    if wrong or not features:
        faults = listed(wrong or ["it has no features"])
        raise InputError(f"{faults}; a region is an area: draw a closed outline (Polygon)")
    return chosen


def _fitting(features: list[_Feature], where: str) -> _Feature:
    """Find the only feature with this property value, which may be written as in Python or as in
    JSON."""
    # Properties and values may have : and = in them, too.
    pairs = [(where[: sign.start()], where[sign.end() :]) for sign in re.finditer("[:=]", where)]

    def has(feature: _Feature, key: str, value: str) -> bool:
        own = _value(feature, key)
        return value in (str(own), json.dumps(own, ensure_ascii=False, default=str))

    found = [each for each in features if any(has(each, *pair) for pair in pairs)]
    if len(found) != 1:
        names = {name for each in features for name in each.properties}
        key, value = next((pair for pair in pairs if pair[0] in names), pairs[0])
        known = {str(own) for each in features if (own := _value(each, key)) is not None}
        hint = near(value, known) if known else near(key, names)
        raise InputError(f"region.where: {show(where)} fits {len(found)} features, not one; {hint}")
    return found[0]


def _polygons(geometry: GeoJson) -> Iterator[list]:
    """The rings of each polygon of a geometry, the shell first; those without corners are left
    out."""
    kind = geometry.get("type")
    if kind == "GeometryCollection":
        for each in geometry["geometries"]:
            yield from _polygons(each)
    elif kind in _AREAS:
        coordinates = geometry["coordinates"]
        for rings in [coordinates] if kind == "Polygon" else coordinates:
            if rings and rings[0]:
                yield [ring for ring in rings if ring]


def _degrees(ring: Any, feature: _Feature) -> Floats:
    """Corners without their heights in degrees (longitude, latitude), [V, 2]."""
    try:
        corners = np.array([position[:2] for position in ring], dtype=np.float64).reshape(
            len(ring), 2
        )
    except (TypeError, ValueError):
        problem = "its outline is not a list of corners [longitude, latitude]"
        raise InputError(f"{feature.place}: {problem}; a Polygon is a list of outlines") from None
    degrees = corners if feature.crs is None else _from_crs(corners, feature.crs)
    # Areas across the antimeridian have corners beyond 180 degrees.
    outside = np.flatnonzero(~(np.abs(degrees) <= [360, 90]).all(axis=1))
    if len(outside):
        problem = (
            "is not a longitude between -360 and 360 deg and a latitude between -90 and 90 deg"
        )
        raise InputError(f"{feature.place}: {corners[outside[0]].tolist()} {problem}; {_REMEDY}")
    if not np.array_equal(corners[0], corners[-1]):
        raise InputError(
            f"{feature.place}: its outline is open: repeat the first corner at the end"
        )
    return degrees


def _from_crs(corners: Floats, crs: Any) -> Floats:
    """Convert corners [V, 2] (east, north) of a coordinate reference system to longitude and
    latitude."""
    name = crs if isinstance(crs, str) else crs.get("properties", {}).get("name")
    if not isinstance(name, str):
        raise InputError(
            f"its coordinate reference system has no name (crs, or a file .prj): {_REMEDY}"
        )
    if _DEGREES.search(name):
        return corners
    pyproj = _extra("pyproj", f"the coordinate reference system {show(name)}")
    try:
        to_degrees = pyproj.Transformer.from_crs(name, "OGC:CRS84", always_xy=True)
        return np.column_stack(to_degrees.transform(*corners.T))
    except pyproj.exceptions.ProjError as error:
        raise InputError(
            f"its coordinate reference system is not understood: {error}; {_REMEDY}"
        ) from None
