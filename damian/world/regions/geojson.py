"""Reads one area of a GeoJSON file (RFC 7946)."""

import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely.geometry import shape

from damian.common.errors import InputError
from damian.common.text_files import listed, named, near, read_text, show
from damian.world.regions.geodesy import Floats
from damian.world.regions.region import Region, local_region

_SHAPES = ("Polygon", "MultiPolygon")


class _Feature(NamedTuple):
    """One feature of a GeoJSON file; ``place`` is its path in the document, such as ``features[2]``."""

    place: str
    properties: dict[str, Any]
    geometry: dict[str, Any]

    @property
    def is_area(self) -> bool:
        return self.geometry.get("type") in _SHAPES


def read_geojson(path: str | os.PathLike[str], index: int | None = None, where: str | None = None) -> Region:
    """Read one Polygon or MultiPolygon of a GeoJSON file, a bare geometry or that of a feature.

    Positions are longitude, latitude; a height is ignored. Parts of a MultiPolygon that touch or overlap are
    united.

    Args:
        path: the file.
        index: the feature's index, counted from 0 over all features of the file.
        where: a property that only the feature has, as ``property=value`` or ``property:value`` (the latter
            for command lines that give ``=`` a meaning of their own). Neither ``index`` nor ``where`` is
            needed if only one feature is an area.

    Raises:
        InputError: the file cannot be read, the chosen geometry is invalid, or the choice does not single
            out one feature.
    """
    with named(path):
        try:
            features = _features(json.loads(read_text(Path(path))))
            chosen = _choose(features, index, where)
            parts = _parts(chosen)
        except InputError:
            raise
        except Exception as error:  # a file can hold anything at any place
            raise InputError(f"is not GeoJSON: {error!r}") from None
        name = chosen.properties.get("name")
        name = name if isinstance(name, str) else f"{Path(path).stem} {chosen.place}".strip()
        return local_region(parts, name, None, chosen.place or "geometry")


def _features(document: dict[str, Any]) -> list[_Feature]:
    """All features of a document; a bare geometry counts as a feature without properties."""
    kind = document["type"]
    if kind in _SHAPES:
        return [_Feature("", {}, document)]
    if kind not in ("Feature", "FeatureCollection"):
        raise InputError(f"type {show(kind)} is not one of Polygon, MultiPolygon, Feature, FeatureCollection")
    alone = kind == "Feature"
    return [
        _Feature("" if alone else f"features[{i}]", each.get("properties") or {}, each.get("geometry") or {})
        for i, each in enumerate([document] if alone else document["features"])
    ]


def _choose(features: list[_Feature], index: int | None, where: str | None) -> _Feature:
    """Find the feature chosen by ``index`` or ``where``, or else the only one that is an area."""
    if index is not None and where is not None:
        raise InputError(f"index {index} and where {show(where)} both choose; give one of them")
    if index is not None:
        if index >= len(features):
            raise InputError(f"index {index} is not between 0 and {len(features) - 1}")
        return features[index]
    if where is not None:
        return _choose_by_property(features, where)
    areas = [each for each in features if each.is_area]
    if len(areas) != 1:
        choice = listed(f"{each.place} {show(each.properties)}" for each in areas)
        raise InputError(f"{len(areas)} features are areas: choose one by index or property=value: {choice}")
    return areas[0]


def _choose_by_property(features: list[_Feature], where: str) -> _Feature:
    """Find the only feature with this property value, which may be written as in Python or as in JSON."""
    key, separator, value = where.partition("=" if "=" in where else ":")
    if not separator:
        raise InputError(f"where {show(where)} is not property=value")
    values = [{str(each.properties.get(key)), json.dumps(each.properties.get(key))} for each in features]
    found = [each for each, spellings in zip(features, values, strict=True) if value in spellings]
    if len(found) != 1:
        known = {str(each.properties[key]) for each in features if key in each.properties}
        hint = near(value, known) if known else near(key, {name for e in features for name in e.properties})
        raise InputError(f"where {show(where)} fits {len(found)} features, not one; {hint}")
    return found[0]


def _parts(chosen: _Feature) -> list[list[Floats]]:
    """Closed rings of each polygon part, each [V, 2] degrees (longitude, latitude)."""
    if not chosen.is_area:
        kind = show(chosen.geometry.get("type"))
        raise InputError(f"{chosen.place}.geometry: type {kind} is not one of Polygon, MultiPolygon")
    area = shape(chosen.geometry)
    corners = shapely.get_coordinates(area)
    outside = np.flatnonzero(~(np.abs(corners) <= [180, 90]).all(axis=1))
    if len(outside):
        raise InputError(
            f"{chosen.place}: {corners[outside[0]].tolist()} is not a longitude between -180 and 180 deg and "
            "a latitude between -90 and 90 deg"
        )
    return [
        [shapely.get_coordinates(ring) for ring in shapely.get_rings(part)]
        for part in shapely.get_parts(area)
    ]
