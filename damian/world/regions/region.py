"""Operative regions, in local metres about their centroid."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon

from damian.common.errors import InputError
from damian.common.text_files import one_line
from damian.world.regions.geodesy import Floats, to_local, wrap_longitude
from damian.world.regions.polygon import polygon_from_rings


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


def local_region(
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
    return Region(local, one_line(name), origin, levels)


def _turn_towards(ring: Floats, lon_deg: float) -> Floats:
    """The ring by whole turns of longitude, each corner within half a turn of ``lon_deg``."""
    turns = np.round((lon_deg - ring[:, 0]) / 360)
    return ring + np.column_stack([360 * turns, np.zeros_like(turns)])
