"""An episode on a real region as GeoJSON (RFC 7946), which any map tool opens."""

import json
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

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
    """Write an episode as GeoJSON, with what is true and believed at its last instant."""
    write_atomically(
        path, json.dumps(feature_collection(episode, episode.n_steps), separators=(",", ":"))
    )


def feature_collection(episode: Episode, step: int) -> dict[str, Any]:
    """An episode up to an instant as a FeatureCollection.

    The property ``kind`` of a feature says what it is: ``region`` (with its ``name``), ``landing
    points``, ``track`` (of a UAV, with ``times`` [s] of its points, ``times_utc`` if known, and
    ``altitudes_m`` above the ground; in coordinates they would be above the ellipsoid), ``source
    track`` (if it is known), ``footprint`` and ``coverage`` (what its footprints have covered) of a
    UAV, ``believed position`` (with ``age_s``), and ``belief``
    (a cell, with the ``probability`` that any source is in it). Across the antimeridian, longitudes
    go beyond 180.
    """
    origin = origin_of(episode)
    features = [
        {"type": "Feature", "properties": properties, "geometry": on_earth(geometry, origin)}
        for geometry, properties in _features(episode, step)
    ]
    return {"type": "FeatureCollection", "features": features}


def origin_of(episode: Episode) -> tuple[float, float]:
    """Latitude and longitude of the point (0, 0) of an episode [deg]."""
    if episode.origin is None:
        problem = (
            "its region has no latitude and longitude; fly over region=llanbedr, fir or geojson"
        )
        raise InputError(f"geojson: {problem}")
    return episode.origin


def _features(episode: Episode, step: int) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Geometries in local metres, each with its properties."""
    yield episode.region, {"kind": "region", "name": episode.about.get("region")}
    yield shapely.MultiPoint(episode.landing_points), {"kind": "landing points"}
    frame = frame_of(episode, step)
    times = {"times": episode.time[: step + 1].tolist()}
    if isinstance(
        began := episode.about.get("began"), str
    ):  # a journal's, whose clock is the calendar's
        begin = datetime.fromisoformat(began)
        times["times_utc"] = [
            (begin + timedelta(seconds=time)).isoformat() for time in times["times"]
        ]
    for number, uav in enumerate(frame.uavs):
        path = episode.true[: step + 1, number]
        label = {"uav": number, "name": episode.names[number]}
        up = {"altitudes_m": episode.position[: step + 1, number, 2].round(2).tolist()}
        places: Any = shapely.points(path)
        footprints: Any = shapely.buffer(places, episode.radius, quad_segs=_CORNERS)
        covered = shapely.intersection(shapely.union_all(footprints), episode.region)
        yield _path(path), {"kind": "track", **label, **times, **up}
        yield footprints[-1], {"kind": "footprint", **label, "spotted": uav.spots}
        yield covered, {"kind": "coverage", **label}
        yield shapely.Point(uav.believed), {"kind": "believed position", **label, "age_s": uav.age}
    known = [] if episode.source is None else np.moveaxis(episode.source, 1, 0)
    for number, places in enumerate(known):
        yield _path(places[: step + 1]), {"kind": "source track", "source": number, **times}
    for area, probability in frame.cells:
        yield area, {"kind": "belief", "probability": round(probability, 5)}


def _path(places: Floats) -> shapely.LineString | shapely.Point:
    """A path [T + 1, 2] as a line, or as a point if it leads nowhere."""
    return shapely.LineString(places) if (places != places[0]).any() else shapely.Point(places[0])


def on_earth(geometry: Any, origin: tuple[float, float]) -> dict[str, Any]:
    """A geometry of local metres in longitude and latitude, with holes clockwise."""

    def degrees(metres: NDArray[np.float64]) -> NDArray[np.float64]:
        latitude, longitude = to_latlon(metres[:, 0], metres[:, 1], origin)
        longitude = origin[1] + wrap_longitude(longitude - origin[1])
        return np.column_stack([longitude, latitude]).round(DIGITS)

    return json.loads(
        shapely.to_geojson(shapely.orient_polygons(shapely.transform(geometry, degrees)))
    )
