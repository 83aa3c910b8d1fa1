"""Reads one area of a GeoJSON file (RFC 7946)."""

import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from damian.common.errors import InputError
from damian.common.text_files import listed, named, near, read_text, show
from damian.world.regions.geodesy import Floats
from damian.world.regions.region import Region, local_region

_SHAPES = ("Polygon", "MultiPolygon")


class _Candidate(NamedTuple):
    """One feature of a GeoJSON file; ``place`` is its path in the document, such as ``features[2]``."""

    place: str
    properties: dict[str, Any]
    geometry: Any


def read_geojson(path: str | os.PathLike[str], index: int | None = None, where: str | None = None) -> Region:
    """Read one Polygon or MultiPolygon of a GeoJSON file, a bare geometry or that of a feature.

    Positions are longitude, latitude; a height is ignored. Rings must be closed, as RFC 7946 requires
    (an open ring may come from a truncated file). Parts of a MultiPolygon that touch or overlap are united.

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
        features = _candidates(_parse_json(read_text(Path(path))))
        chosen = _choose(features, index, where)
        name = chosen.properties.get("name")
        name = name if isinstance(name, str) else f"{Path(path).stem} {chosen.place}".strip()
        return local_region(_parts(chosen), name, None, chosen.place or "geometry")


def _parse_json(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"not JSON: {error}") from None


def _candidates(document: Any) -> list[_Candidate]:
    """List all features of a document; a bare geometry counts as a feature without properties."""
    kind = document.get("type") if isinstance(document, dict) else None
    if kind in _SHAPES:
        return [_Candidate("", {}, document)]
    if kind == "Feature":
        return [_feature("", document)]
    if kind != "FeatureCollection":
        raise InputError(f"type {show(kind)} is not one of Polygon, MultiPolygon, Feature, FeatureCollection")
    features = document.get("features")
    if not isinstance(features, list) or not features:
        raise InputError(f"features {show(features)} is not a list of at least one feature")
    return [_feature(f"features[{i}]", feature) for i, feature in enumerate(features)]


def _feature(place: str, feature: Any) -> _Candidate:
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise InputError(f"{place}: {show(feature)} is not a Feature")
    properties = feature.get("properties")
    properties = properties if isinstance(properties, dict) else {}
    return _Candidate(place, properties, feature.get("geometry"))


def _choose(candidates: list[_Candidate], index: int | None, where: str | None) -> _Candidate:
    """Find the feature chosen by ``index`` or ``where``, or else the only one that is an area."""
    if index is not None and where is not None:
        raise InputError(f"index {index} and where {show(where)} both choose; give one of them")
    if index is not None:
        if not 0 <= index < len(candidates):
            raise InputError(f"index {index} is not between 0 and {len(candidates) - 1}")
        return candidates[index]
    if where is not None:
        return _choose_by_property(candidates, where)
    areas = [c for c in candidates if _kind(c.geometry) in _SHAPES]
    if len(areas) == 1 or len(candidates) == 1:
        return (areas or candidates)[0]
    if not areas:
        raise InputError(f"none of {len(candidates)} features is a Polygon or MultiPolygon")
    choice = listed(f"{c.place} {show(c.properties)}" for c in areas)
    raise InputError(f"choose one of {len(areas)} features by index or property=value: {choice}")


def _choose_by_property(candidates: list[_Candidate], where: str) -> _Candidate:
    """Find the only feature with this property value, which may be written as in Python or as in JSON."""
    key, separator, value = where.partition("=" if "=" in where else ":")
    if not separator:
        raise InputError(f"where {show(where)} is not property=value")
    with_key = [c for c in candidates if key in c.properties]
    if not with_key:
        known_keys = {name for c in candidates for name in c.properties}
        raise InputError(f"no feature has a property {show(key)}; {near(key, known_keys)}")
    matching = [c for c in with_key if value in _spellings(c.properties[key])]
    if len(matching) == 1:
        return matching[0]
    if matching:
        places = listed(c.place for c in matching)
        raise InputError(f"where {show(where)} fits {len(matching)} features: {places}")
    known_values = {text for c in with_key for text in _spellings(c.properties[key])[:1]}
    raise InputError(f"no feature has {key}={show(value)}; {near(value, known_values)}")


def _spellings(value: Any) -> tuple[str, ...]:
    """List the ways to write a property value: ``north``, ``3``, ``true``; a nested value has none."""
    if isinstance(value, str):
        return (value,)
    return () if isinstance(value, dict | list) else (json.dumps(value), str(value))


def _parts(chosen: _Candidate) -> list[list[Floats]]:
    """Closed rings of each polygon part, each [V, 2] degrees (longitude, latitude)."""
    kind = _kind(chosen.geometry)
    place = f"{chosen.place}.geometry".lstrip(".")
    if kind not in _SHAPES:
        raise InputError(f"{place}: type {show(kind)} is not one of Polygon, MultiPolygon")
    place += ".coordinates"
    coordinates = chosen.geometry.get("coordinates")
    if kind == "Polygon":
        return [_rings(place, coordinates)]
    return [_rings(f"{place}[{i}]", part) for i, part in enumerate(_non_empty_list(place, coordinates))]


def _rings(place: str, rings: Any) -> list[Floats]:
    return [_ring(f"{place}[{i}]", ring) for i, ring in enumerate(_non_empty_list(place, rings))]


def _ring(place: str, ring: Any) -> Floats:
    """A closed ring of positions without their heights, [V, 2] degrees."""
    try:
        corners = np.array([position[:2] for position in _non_empty_list(place, ring)], dtype=np.float64)
    except (TypeError, ValueError, KeyError, OverflowError):
        raise InputError(f"{place}: {show(ring)} is not a list of [longitude, latitude]") from None
    if corners.ndim != 2 or corners.shape[1] != 2:
        raise InputError(f"{place}: {show(ring)} is not a list of [longitude, latitude]")
    outside = np.flatnonzero(~(np.abs(corners) <= [180, 90]).all(axis=1))
    if len(outside):
        first = outside[0]
        raise InputError(
            f"{place}[{first}]: {corners[first].tolist()} is not a longitude between -180 and 180 deg and a "
            "latitude between -90 and 90 deg"
        )
    if (corners[0] != corners[-1]).any():
        raise InputError(f"{place}: not closed: its last position is not its first {corners[0].tolist()}")
    return corners


def _non_empty_list(place: str, value: Any) -> list[Any]:
    if not isinstance(value, list) or not value:
        raise InputError(f"{place}: {show(value)} is not a list with something in it")
    return value


def _kind(geometry: Any) -> Any:
    return geometry.get("type") if isinstance(geometry, dict) else None
