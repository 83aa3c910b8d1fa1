"""The sources of regions: random polygons, vertices, tables of airspaces, maps, and your own."""

import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import cast

import numpy as np
import shapely
from numpy.random import Generator
from shapely.geometry import Polygon

from damian.common import checks
from damian.common.registry import Registry
from damian.common.text_files import data_file
from damian.world.config import RegionConfig
from damian.world.regions.files import read_area
from damian.world.regions.fir import read_fir
from damian.world.regions.geodesy import Floats, LatLon, to_latlon, to_local
from damian.world.regions.polygon import (
    Area,
    polygon_from_rings,
    polygon_from_vertices,
    random_polygon,
    sample_interior,
)
from damian.world.regions.region import Region, centred, to_local_places

RegionSource = Callable[[RegionConfig, Generator], list[Region]]
"""From the settings and a random generator to the regions; each episode flies over one of them."""

REGION_SOURCES = Registry[RegionSource](
    "region source", inspect.isfunction, "is not a function (config, rng) -> list[Region]"
)
"""Region sources by ``region.kind``, or as ``package.module:function``."""


@REGION_SOURCES.register("random")
def _random_regions(config: RegionConfig, rng: Generator) -> list[Region]:
    polygons = [random_polygon(rng, config.min_area, config.max_area) for _ in range(config.pool)]
    return [Region(polygon, f"random region {i}") for i, polygon in enumerate(polygons)]


@REGION_SOURCES.register("vertices")
def _region_of_vertices(config: RegionConfig, rng: Generator) -> list[Region]:
    return [Region(polygon_from_vertices(config.vertices, "region.vertices"), "vertices region 0")]


@REGION_SOURCES.register("fir")
def _region_of_fir_table(config: RegionConfig, rng: Generator) -> list[Region]:
    return [read_fir(data_file(config.path, "region.path"), config.id)]


@REGION_SOURCES.register("geojson")
def _region_of_map(config: RegionConfig, rng: Generator) -> list[Region]:
    return [
        read_area(data_file(config.path, "region.path"), config.index or (), config.where or ())
    ]


def _without_zones(region: Region, config: RegionConfig, rng: Generator) -> Region:
    """The region without the zones where nobody lands or flies, which become holes of it or cut its
    edge."""
    if not config.zones:
        return region
    if isinstance(config.zones, list):
        zones = [
            polygon_from_rings(
                [to_local_places("region.zones", corners, region)], "region.zones", "m"
            )
            for corners in config.zones
        ]
    elif isinstance(config.zones, str):
        zones = [_zones_of_map(config.zones, region)]
    else:
        zones = [_random_zone(region.polygon, config, rng) for _ in range(int(config.zones))]
    widened = shapely.buffer(zones, config.zone_margin, join_style="mitre")
    kept = region.polygon - shapely.union_all(widened)
    checks.require(
        not kept.is_empty, "region.zones", config.zones, f"leave nothing of {region.name}"
    )
    return replace(region, polygon=kept)


def _zones_of_map(path: str, region: Region) -> shapely.Geometry:
    """All areas of a map, in local metres of a region."""
    checks.require(
        region.origin is not None,
        "region.zones",
        path,
        f"is a map, but {region.name} has no position on Earth: give corners in metres",
    )
    area = read_area(data_file(path, "region.zones"), every=True)
    origins = cast(LatLon, area.origin), cast(LatLon, region.origin)

    def moved(places: Floats) -> Floats:
        latitude, longitude = to_latlon(places[:, 0], places[:, 1], origins[0])
        return np.column_stack(to_local(latitude, longitude, origins[1]))

    return shapely.transform(area.polygon, moved)


def _random_zone(polygon: Area, config: RegionConfig, rng: Generator) -> Polygon:
    """A random convex zone about a place in the region."""
    zone = random_polygon(rng, config.zone_area, 2 * config.zone_area)
    place = sample_interior(polygon, 1, rng)[0]
    scale = np.sqrt(config.zone_area / zone.area)
    return shapely.transform(zone, lambda corners: place + scale * corners)


def regions_of(config: RegionConfig, rng: Generator) -> list[Region]:
    """Read the region from its file or vertices, or draw ``pool`` random regions."""
    source = REGION_SOURCES.get(config.kind, "region.kind")
    found = [_without_zones(centred(region), config, rng) for region in source(config, rng)]
    most = config.initial_conditions
    checks.require(
        len(found) <= most,
        "region.initial_conditions",
        f"{most} for {len(found)}",
        "regions: each needs at least one initial condition",
    )
    return found
