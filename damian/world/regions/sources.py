"""The sources of regions: random polygons, vertices, tables of airspaces, maps, and your own."""

import inspect
from collections.abc import Callable

import numpy as np

from damian.common import checks
from damian.common.registry import Registry
from damian.common.text_files import data_file
from damian.world.config import RegionConfig
from damian.world.regions.files import read_area
from damian.world.regions.fir import read_fir
from damian.world.regions.polygon import polygon_from_vertices, random_polygon
from damian.world.regions.region import Region, centred

RegionSource = Callable[[RegionConfig, np.random.Generator], list[Region]]
"""From the settings and a random generator to the regions; each episode flies over one of them."""

REGION_SOURCES = Registry[RegionSource](
    "region source", inspect.isfunction, "is not a function (config, rng) -> list[Region]"
)
"""Region sources by ``region.kind``, or as ``package.module:function``."""


@REGION_SOURCES.register("random")
def _random_regions(config: RegionConfig, rng: np.random.Generator) -> list[Region]:
    polygons = [random_polygon(rng, config.min_area, config.max_area) for _ in range(config.pool)]
    return [Region(polygon, f"random region {i}") for i, polygon in enumerate(polygons)]


@REGION_SOURCES.register("vertices")
def _region_of_vertices(config: RegionConfig, rng: np.random.Generator) -> list[Region]:
    return [Region(polygon_from_vertices(config.vertices, "region.vertices"), "vertices region 0")]


@REGION_SOURCES.register("fir")
def _region_of_fir_table(config: RegionConfig, rng: np.random.Generator) -> list[Region]:
    return [read_fir(data_file(config.path), config.id)]


@REGION_SOURCES.register("geojson")
def _region_of_map(config: RegionConfig, rng: np.random.Generator) -> list[Region]:
    return [read_area(data_file(config.path), config.index, config.where)]


def regions_of(config: RegionConfig, rng: np.random.Generator) -> list[Region]:
    """Read the region from its file or vertices, or draw ``pool`` random regions."""
    source = REGION_SOURCES.get(config.kind, "region.kind")
    found = [centred(region) for region in source(config, rng)]
    most, problem = config.initial_conditions, "regions: each needs at least one initial condition"
    checks.require(len(found) <= most, "region.initial_conditions", f"{most} for {len(found)}", problem)
    return found
