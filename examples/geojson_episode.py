"""An episode of ``damian fly`` over a real region as GeoJSON (RFC 7946), which any map tool opens.

    damian fly region=llanbedr delay=paper "formats=[]" hydra.run.dir=runs/flight
    python examples/geojson_episode.py runs/flight/episode_0.json

writes episode_0.geojson beside it.
"""

import json
import sys
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
from damian.world.regions.geodesy import LatLon, to_latlon

_CORNERS = 16
"""Corners of a quarter of a footprint."""
_DIGITS = 7
"""Decimals of longitudes and latitudes: a centimetre."""


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
    if episode.origin is None:
        raise InputError(
            "geojson: its region has no place on Earth, as llanbedr has, fir or geojson"
        )
    features = [
        {
            "type": "Feature",
            "properties": properties,
            "geometry": _on_earth(geometry, episode.origin),
        }
        for geometry, properties in _features(episode, step)
    ]
    return {"type": "FeatureCollection", "features": features}


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


def _on_earth(geometry: Any, origin: LatLon) -> dict[str, Any]:
    """A geometry of local metres in longitude and latitude, with holes clockwise."""

    def degrees(metres: NDArray[np.float64]) -> NDArray[np.float64]:
        latitude, longitude = to_latlon(metres[:, 0], metres[:, 1], origin)
        longitude = origin[1] + (longitude - origin[1] + 180) % 360 - 180
        return np.column_stack([longitude, latitude]).round(_DIGITS)

    placed = shapely.transform(geometry, degrees)
    return json.loads(shapely.to_geojson(shapely.orient_polygons(placed)))


def _path(places: Floats) -> shapely.LineString | shapely.Point:
    """A path [T + 1, 2] as a line, or as a point if it leads nowhere."""
    return shapely.LineString(places) if (places != places[0]).any() else shapely.Point(places[0])


def main(file: str) -> None:
    """Write a stored episode as GeoJSON, with what is true and believed at its last instant."""
    episode = Episode.load(Path(file))
    found = feature_collection(episode, episode.n_steps)
    write_atomically(Path(file).with_suffix(".geojson"), json.dumps(found, separators=(",", ":")))


if __name__ == "__main__":
    main(sys.argv[1])
