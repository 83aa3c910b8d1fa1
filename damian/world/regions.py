"""Operative regions from files: Eurocontrol FIR tables (CSV) and GeoJSON (RFC 7946).

Latitudes and longitudes become local metres about the region's centroid. Polygons keep their holes
and their concave parts. Everything wrong in a file is one `InputError` that says where.
"""

import csv
import difflib
import io
import json
import os
import reprlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon

from damian.errors import InputError
from damian.world.geodesy import Floats, to_local, wrap_longitude
from damian.world.polygon import polygon_from_rings

MAX_BYTES = 50_000_000
"""Larger files are refused unread."""

_ID, _SEQUENCE = "Airspace ID", "Sequence Number"
_LOWEST, _HIGHEST = "Min Flight Level", "Max Flight Level"
_LATITUDE, _LONGITUDE = "Latitude", "Longitude"
_COLUMNS = (_ID, _LOWEST, _HIGHEST, _SEQUENCE, _LATITUDE, _LONGITUDE)
_BOUNDS = {
    _LATITUDE: (-90.0, 90.0, "deg"),
    _LONGITUDE: (-180.0, 180.0, "deg"),
    _LOWEST: (0.0, 1000.0, "FL"),
    _HIGHEST: (0.0, 1000.0, "FL"),
    _SEQUENCE: (0.0, 1e6, ""),
}
_SHAPES = ("Polygon", "MultiPolygon")


@dataclass(frozen=True)
class Region:
    """Where UAVs fly.

    Attributes:
        polygon: local metres, x east and y north.
        name: what the file calls it.
        origin: (latitude, longitude) of (0, 0) in degrees; ``None`` where there is no place on
            Earth.
        levels: lowest and highest flight level [FL, hundreds of feet], as in the table.
    """

    polygon: Polygon | MultiPolygon
    name: str
    origin: tuple[float, float] | None = None
    levels: tuple[float, float] | None = None


class _Row(NamedTuple):
    """One line of a FIR table."""

    line: int
    cells: dict[str, str]


class _Candidate(NamedTuple):
    """One feature of a GeoJSON file; ``place`` is where it stands in there."""

    place: str
    properties: dict[str, Any]
    geometry: Any


def read_fir(path: str | os.PathLike[str], airspace_id: str) -> Region:
    """Read one airspace of a FIR table.

    Columns: ``Airspace ID, Min Flight Level, Max Flight Level, Sequence Number, Latitude,
    Longitude``, any others beside them; rows in any order, their sequence numbers 0, 1, 2, ... go
    round the polygon. Only the rows of the chosen airspace are checked.

    Raises:
        InputError: the file, its table, or the chosen airspace is wrong.
    """
    with _named(path):
        table = _read_table(_read_text(Path(path)))
        rows = [row for row in table if row.cells[_ID] == airspace_id]
        if not rows:
            known = {row.cells[_ID] for row in table}
            raise InputError(f"no {_ID} {_show(airspace_id)}; {_near(airspace_id, known)}")
        rows, levels = _in_sequence(rows), _levels(rows)
        corners = [[_number(row, column) for column in (_LONGITUDE, _LATITUDE)] for row in rows]
        return _region([[np.array(corners)]], airspace_id, levels, airspace_id)


def read_geojson(path: str | os.PathLike[str], index: int | None = None, where: str | None = None) -> Region:
    """Read one Polygon or MultiPolygon of a GeoJSON file, bare or within features.

    Positions are longitude, latitude; a height is ignored. Rings must be closed, as RFC 7946 asks
    (an open one may be a file cut short). Parts of a MultiPolygon that touch or overlap are united.

    Args:
        path: the file.
        index: which feature, counted from 0 over all features of the file.
        where: which feature, as ``property=value``; needless, like ``index``, where only one
            feature is an area.

    Raises:
        InputError: the file or the chosen shape is wrong, or the choice is not of one feature.
    """
    with _named(path):
        features = _candidates(_parse_json(_read_text(Path(path))))
        chosen = _choose(features, index, where)
        name = chosen.properties.get("name")
        name = name if isinstance(name, str) else f"{Path(path).stem} {chosen.place}".strip()
        return _region(_parts(chosen), name, None, chosen.place or "geometry")


# --- FIR tables ---------------------------------------------------------------------------------


def _read_table(text: str) -> list[_Row]:
    """Every line with its cells by column, stripped."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except csv.Error as error:
        raise InputError(f"line {reader.line_num}: {error}; give comma-separated values") from None
    (first, header), *lines = [row for row in lines if any(row[1])] or [(1, [])]
    wrong = [column for column in _COLUMNS if header.count(column) != 1]
    if wrong:
        found = _list(map(_show, header))
        raise InputError(
            f"line {first}: column {', '.join(wrong)} missing or doubled; the columns are {found}"
        )
    for number, cells in lines:
        if len(cells) != len(header):
            raise InputError(f"line {number}: {len(cells)} values for {len(header)} columns")
    return [_Row(number, dict(zip(header, cells, strict=True))) for number, cells in lines]


def _in_sequence(rows: list[_Row]) -> list[_Row]:
    """Rows ordered by their sequence numbers, which must be 0, 1, 2, ..."""
    keyed = sorted((_number(row, _SEQUENCE), row) for row in rows)
    for expected, (number, row) in enumerate(keyed):
        if number == expected:
            continue
        problem = f"line {row.line}: {_SEQUENCE} {row.cells[_SEQUENCE]}"
        if expected and number == keyed[expected - 1][0]:
            raise InputError(f"{problem} is on line {keyed[expected - 1][1].line} too")
        raise InputError(f"{problem} where {expected} is next; number the points 0, 1, 2, ...")
    return [row for _, row in keyed]


def _levels(rows: list[_Row]) -> tuple[float, float]:
    """The lowest and highest flight level, the same in all rows."""
    first = min(rows)
    low, high = (_common(rows, first, column) for column in (_LOWEST, _HIGHEST))
    if low > high:
        raise InputError(f"line {first.line}: {_LOWEST} {low:g} FL is above {_HIGHEST} {high:g} FL")
    return low, high


def _common(rows: list[_Row], first: _Row, column: str) -> float:
    """The number that a column has in every row."""
    level = _number(first, column)
    for row in rows:
        value = _number(row, column)
        if value != level:
            raise InputError(
                f"line {row.line}: {column} {value:g} FL is not the {level:g} FL of line "
                f"{first.line}; an airspace has one"
            )
    return level


def _number(row: _Row, column: str) -> float:
    """A cell as a number within its column's bounds."""
    text, (low, high, unit) = row.cells[column], _BOUNDS[column]
    try:
        # Python would read 1_0 as ten.
        value = float("_" if "_" in text else text)
    except ValueError:
        raise InputError(f"line {row.line}: {column} {_show(text)} is not a number") from None
    if not low <= value <= high:
        written = f"{text[:40]} {unit}".strip()
        raise InputError(f"line {row.line}: {column} {written} is not between {low:g} and {high:g} {unit}")
    return value


# --- GeoJSON ------------------------------------------------------------------------------------


def _parse_json(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"line {error.lineno}: not JSON: {error.msg}") from None
    except RecursionError:
        raise InputError("JSON nested too deeply for a GeoJSON file") from None
    except ValueError as error:
        raise InputError(f"not JSON: {error}") from None


def _candidates(document: Any) -> list[_Candidate]:
    """Every feature of a document; a bare geometry is one without properties."""
    kind = document.get("type") if isinstance(document, dict) else None
    if kind in _SHAPES:
        return [_Candidate("", {}, document)]
    if kind == "Feature":
        return [_feature("", document)]
    if kind != "FeatureCollection":
        raise InputError(
            f"type {_show(kind)} is not one of Polygon, MultiPolygon, Feature, FeatureCollection"
        )
    features = document.get("features")
    if not isinstance(features, list) or not features:
        raise InputError(f"features {_show(features)} is not a list of at least one feature")
    return [_feature(f"features[{i}]", feature) for i, feature in enumerate(features)]


def _feature(place: str, feature: Any) -> _Candidate:
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise InputError(f"{place}: {_show(feature)} is not a Feature")
    properties = feature.get("properties")
    properties = properties if isinstance(properties, dict) else {}
    return _Candidate(place, properties, feature.get("geometry"))


def _choose(candidates: list[_Candidate], index: int | None, where: str | None) -> _Candidate:
    """The one feature that is meant."""
    if index is not None and where is not None:
        raise InputError(f"index {index} and where {_show(where)} both choose; give one of them")
    if index is not None:
        if not 0 <= index < len(candidates):
            raise InputError(f"index {index} is not between 0 and {len(candidates) - 1}")
        return candidates[index]
    if where is not None:
        return _where(candidates, where)
    areas = [c for c in candidates if _kind(c.geometry) in _SHAPES]
    if len(areas) == 1 or len(candidates) == 1:
        return (areas or candidates)[0]
    if not areas:
        raise InputError(f"none of {len(candidates)} features is a Polygon or MultiPolygon")
    choice = _list(f"{c.place} {_show(c.properties)}" for c in areas)
    raise InputError(f"choose one of {len(areas)} features by index or property=value: {choice}")


def _where(candidates: list[_Candidate], where: str) -> _Candidate:
    """The one feature whose property has that value, as written in Python or in JSON."""
    key, equals, value = where.partition("=")
    if not equals:
        raise InputError(f"where {_show(where)} is not property=value")
    having = [c for c in candidates if key in c.properties]
    if not having:
        known = {name for c in candidates for name in c.properties}
        raise InputError(f"no feature has a property {_show(key)}; {_near(key, known)}")
    found = [c for c in having if value in _spellings(c.properties[key])]
    if len(found) == 1:
        return found[0]
    if found:
        places = _list(c.place for c in found)
        raise InputError(f"where {_show(where)} fits {len(found)} features: {places}")
    known = {text for c in having for text in _spellings(c.properties[key])[:1]}
    raise InputError(f"no feature has {key}={_show(value)}; {_near(value, known)}")


def _spellings(value: Any) -> tuple[str, ...]:
    """How a property may be written: ``north``, ``3``, ``true``; a nested one not at all."""
    if isinstance(value, str):
        return (value,)
    return () if isinstance(value, dict | list) else (json.dumps(value), str(value))


def _parts(chosen: _Candidate) -> list[list[Floats]]:
    """Rings of every part, each [V, 2] degrees (longitude, latitude), closed."""
    kind = _kind(chosen.geometry)
    place = f"{chosen.place}.geometry".lstrip(".")
    if kind not in _SHAPES:
        raise InputError(f"{place}: type {_show(kind)} is not one of Polygon, MultiPolygon")
    place += ".coordinates"
    coordinates = chosen.geometry.get("coordinates")
    if kind == "Polygon":
        return [_rings(place, coordinates)]
    parts = _filled(place, coordinates)
    return [_rings(f"{place}[{i}]", part) for i, part in enumerate(parts)]


def _rings(place: str, rings: Any) -> list[Floats]:
    rings = _filled(place, rings)
    return [_ring(f"{place}[{i}]", ring) for i, ring in enumerate(rings)]


def _ring(place: str, ring: Any) -> Floats:
    positions = _filled(place, ring)
    corners = [_position(f"{place}[{i}]", p) for i, p in enumerate(positions)]
    if corners[0] != corners[-1]:
        raise InputError(f"{place}: not closed: its last position is not its first {corners[0]}")
    return np.array(corners, dtype=np.float64)


def _position(place: str, position: Any) -> list[float]:
    """Longitude and latitude of a position."""
    if not isinstance(position, list) or len(position) < 2:
        raise InputError(f"{place}: {_show(position)} is not [longitude, latitude]")
    for name, value in zip((_LONGITUDE, _LATITUDE), position, strict=False):
        low, high, unit = _BOUNDS[name]
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and low <= value <= high):
            raise InputError(
                f"{place}: {name.lower()} {_show(value)} is not a number between {low:g} and {high:g} {unit}"
            )
    return position[:2]


def _filled(place: str, value: Any) -> list[Any]:
    if not isinstance(value, list) or not value:
        raise InputError(f"{place}: {_show(value)} is not a list with something in it")
    return value


def _kind(geometry: Any) -> Any:
    return geometry.get("type") if isinstance(geometry, dict) else None


# --- both ---------------------------------------------------------------------------------------


def _region(
    parts: Sequence[Sequence[Floats]],
    name: str,
    levels: tuple[float, float] | None,
    source: str,
) -> Region:
    """A region in metres about its centroid; ``parts`` in degrees (longitude, latitude)."""
    near = parts[0][0][0, 0]
    turned = [[_turn_towards(ring, near) for ring in rings] for rings in parts]
    unit = "deg (longitude, latitude)"
    polygons = [polygon_from_rings(rings, source, unit) for rings in turned]
    # Parts cut apart at the antimeridian share an edge, which a MultiPolygon may not.
    shape = cast(Polygon | MultiPolygon, shapely.union_all(polygons))
    if shape.bounds[2] - shape.bounds[0] > 180:
        raise InputError(f"{source}: more than 180 deg of longitude wide; take a smaller region")
    origin = (shape.centroid.y, float(wrap_longitude(shape.centroid.x)))
    local = shapely.transform(shape, lambda c: np.column_stack(to_local(c[:, 1], c[:, 0], origin)))
    if not local.is_valid:
        raise InputError(f"{source}: edges cross once laid out in metres; take a smaller region")
    return Region(local, _one_line(name), origin, levels)


def _turn_towards(ring: Floats, lon_deg: float) -> Floats:
    """The ring by whole turns of longitude, each corner within half a turn of ``lon_deg``."""
    turns = np.round((lon_deg - ring[:, 0]) / 360)
    return ring + np.column_stack([360 * turns, np.zeros_like(turns)])


def _read_text(file: Path) -> str:
    """A whole file as text, with or without a byte order mark."""
    try:
        if not file.exists():
            raise InputError("no such file")
        if not file.is_file():
            raise InputError("is not a file")
        size = file.stat().st_size
        if size > MAX_BYTES:
            raise InputError(f"{size} bytes are more than the {MAX_BYTES} that are read")
        text = file.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"byte {error.start} is not UTF-8 text") from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}") from None
    if not text.strip():
        raise InputError("is empty")
    return text


@contextmanager
def _named(path: str | os.PathLike[str]) -> Iterator[None]:
    """Put the file's name before every error, and each on one line that can be printed."""
    try:
        yield
    except InputError as error:
        raise InputError(_one_line(f"{path}: {error}")) from None


def _one_line(text: str) -> str:
    """Text without line breaks and without halves of characters, which JSON may hold."""
    return " ".join(text.encode(errors="backslashreplace").decode().split())


def _show(value: Any) -> str:
    """A value as written in Python, cut short."""
    return reprlib.repr(value)


def _list(items: Iterable[str]) -> str:
    """The first eight items and how many more there are."""
    items = list(items)
    more = [f"and {len(items) - 8} more"] if len(items) > 8 else []
    return ", ".join(items[:8] + more) or "none"


def _near(written: str, known: Iterable[str]) -> str:
    """What may have been meant."""
    lowered = {name.lower(): name for name in sorted(known)}
    near = difflib.get_close_matches(written.lower(), lowered, n=5)
    if near:
        return f"did you mean {_list(_show(lowered[name]) for name in near)}?"
    return f"the file has {_list(map(_show, lowered.values()))}"
