"""An episode on a real region as GeoJSON (RFC 7946), which any map tool opens."""

import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.affinity import translate

from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError
from damian.show.episode import Episode, Floats
from damian.show.frame import frame_of
from damian.world.regions.geodesy import to_latlon, wrap_longitude

DIGITS = 7
"""Decimals of longitudes and latitudes: a centimetre."""
_CORNERS = 16
"""Corners of a quarter of a footprint."""


def save_geojson(episode: Episode, path: Path) -> None:
    """Write an episode as GeoJSON, with what is true and believed at its last instant.

    Raises:
        InputError: its region has no place on Earth.
        RunError: the file cannot be written.
    """
    write_atomically(path, json.dumps(feature_collection(episode, episode.n_steps), separators=(",", ":")))


def feature_collection(episode: Episode, step: int) -> dict[str, Any]:
    """An episode up to an instant as a FeatureCollection.

    The property ``kind`` of a feature says what it is: ``region``, ``landing points``, ``track`` (of a UAV,
    with ``times`` [s] of its points, if it is one line), ``source track`` (if it is known), ``footprint``
    and ``coverage`` (what its footprints have covered) of a UAV, ``believed position`` (with ``age_s``), and
    ``belief`` (a cell, with the ``probability`` that the source is in it).

    Args:
        episode: flown over a real region.
        step: number of steps to write.

    Raises:
        InputError: the region has no place on Earth.
    """
    origin, features = origin_of(episode), []
    for geometry, properties in _features(episode, step):
        on_earth = _on_earth(geometry, origin)
        if on_earth["type"] != "LineString":
            properties.pop("times", None)
        features.append({"type": "Feature", "properties": properties, "geometry": on_earth})
    return {"type": "FeatureCollection", "features": features}


def origin_of(episode: Episode) -> tuple[float, float]:
    """Latitude and longitude of the point (0, 0) of an episode [deg].

    Raises:
        InputError: the region has no place on Earth.
    """
    if episode.origin is None:
        problem = "its region has no latitude and longitude; fly over region=llanbedr, fir or geojson"
        raise InputError(f"geojson: {problem}")
    return episode.origin


def _features(episode: Episode, step: int) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Geometries in local metres, each with its properties."""
    yield episode.region, {"kind": "region"}
    yield shapely.MultiPoint(episode.landing_points), {"kind": "landing points"}
    times, frame = episode.time[: step + 1].tolist(), frame_of(episode, step, trail=None)
    for number, uav in enumerate(frame.uavs):
        path, label = uav.path[:, :2], {"uav": number, "name": uav.name}
        places: Any = shapely.points(path)
        footprints: Any = shapely.buffer(places, episode.radius, quad_segs=_CORNERS)
        covered = shapely.intersection(shapely.union_all(footprints), episode.region)
        yield _path(path), {"kind": "track", **label, "times": times}
        yield footprints[-1], {"kind": "footprint", **label, "spotted": uav.spots}
        yield covered, {"kind": "coverage", **label}
        yield shapely.Point(uav.believed), {"kind": "believed position", **label, "age_s": uav.age}
    if episode.source is not None:
        yield _path(episode.source[: step + 1]), {"kind": "source track", "times": times}
    for area, probability in frame.cells:
        yield area, {"kind": "belief", "probability": round(probability, 5)}


def _path(places: Floats) -> shapely.LineString | shapely.Point:
    """A path [T + 1, 2] as a line, or as a point if it leads nowhere."""
    return shapely.LineString(places) if (places != places[0]).any() else shapely.Point(places[0])


def _on_earth(geometry: Any, origin: tuple[float, float]) -> dict[str, Any]:
    """A geometry of local metres in longitude and latitude, cut at the antimeridian, holes clockwise."""
    edge = -180.0 if origin[1] < 0 else 180.0  # no other antimeridian is within half a turn of the origin

    def degrees(metres: NDArray[np.float64]) -> NDArray[np.float64]:
        latitude, longitude = to_latlon(metres[:, 0], metres[:, 1], origin)
        longitude = origin[1] + wrap_longitude(longitude - origin[1])
        # Points that the rounding below moves onto the antimeridian are put there before anything is cut.
        longitude[np.abs(longitude - edge) < 10.0**-DIGITS] = edge
        return np.column_stack([longitude, latitude])

    parts = [_turned(part) for part in _cut(shapely.transform(geometry, degrees), edge)]
    lines = parts[0].geom_type == "LineString"
    whole = parts[0] if len(parts) == 1 else (shapely.multilinestrings if lines else shapely.union_all)(parts)
    rounded = shapely.transform(whole, lambda xy: xy.round(DIGITS))
    if shapely.get_dimensions(rounded) == 2 and not rounded.is_valid:  # a gap below a centimetre has closed
        rounded = shapely.make_valid(rounded, method="structure", keep_collapsed=False)
    return json.loads(shapely.to_geojson(shapely.orient_polygons(rounded)))


def _turned(part: Any) -> Any:
    """A geometry on one side of the antimeridian, turned to longitudes in [-180, 180]."""
    west, _, east, _ = part.bounds
    return translate(part, -360 * np.round((west + east) / 720))


def _cut(geometry: Any, edge: float) -> list[Any]:
    """Parts of a geometry in degrees, each on one side of the antimeridian of longitude ``edge``."""
    west, _, east, _ = geometry.bounds
    if not west < edge < east:
        return [geometry]
    if shapely.get_num_geometries(geometry) > 1:
        return [piece for part in shapely.get_parts(geometry) for piece in _cut(part, edge)]
    if geometry.geom_type == "LineString":
        return _cut_path(shapely.get_coordinates(geometry), edge)
    sides = [shapely.box(low, -90, low + 360, 90) for low in (edge - 360, edge)]
    pieces = shapely.get_parts(shapely.intersection(geometry, sides))
    # Where an area only touches the antimeridian, the other side has a line or a point of it.
    return [*pieces[shapely.get_dimensions(pieces) == 2]]


def _cut_path(places: NDArray[np.float64], edge: float) -> list[shapely.LineString]:
    """A path [T, 2] in degrees, cut where it crosses longitude ``edge``; all of its points stay, in order."""
    beyond = places[:, 0] - edge
    last = np.flatnonzero(beyond[:-1] * beyond[1:] < 0)
    share = beyond[last] / (beyond[last] - beyond[last + 1])
    crossings = places[last] + share[:, None] * (places[last + 1] - places[last])
    crossings[:, 0] = edge
    places = np.insert(places, last + 1, crossings, axis=0)
    side = np.sign(places[:, 0] - edge)
    off = np.flatnonzero(side)
    cuts = off[1:][side[off[1:]] != side[off[:-1]]] - 1
    return [shapely.LineString(places[a : b + 1]) for a, b in pairwise([0, *cuts, len(places) - 1])]
