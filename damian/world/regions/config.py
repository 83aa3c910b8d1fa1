"""Settings of the region, of its landing points, and of the positions where the UAVs start."""

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from importlib.resources import files
from typing import Any

import numpy as np
import shapely

from damian.common import checks
from damian.common.errors import naming_errors
from damian.common.registry import Registry
from damian.world.regions.fir import read_fir
from damian.world.regions.geojson import read_geojson
from damian.world.regions.places import check_places
from damian.world.regions.polygon import RESOLUTION, polygon_from_vertices, random_polygon
from damian.world.regions.region import Region, centred


@dataclass
class RegionConfig:
    """Region, landing points and start positions (paper, section 3.2)."""

    kind: str = "random"
    """Origin of the region: ``random``, ``vertices``, ``fir`` (Eurocontrol table), ``geojson``, or
    ``package.module:function``."""
    min_area: float = 100_000.0
    """Smallest area of a random region [m^2]."""
    max_area: float = 200_000.0
    """Largest area of a random region [m^2]."""
    pool: int = 1
    """Number of random regions drawn once per seed; every episode of every world uses one of them."""
    vertices: list = field(default_factory=list)
    """Polygon corners [x, y] in metres, for ``kind=vertices``."""
    path: str = ""
    """File to read, for ``kind=fir`` and ``kind=geojson``; ``damian:fir.csv`` is the table of the package."""
    id: str = ""
    """Airspace ID of the region in the FIR table."""
    index: int | None = None
    """Index of the feature in the GeoJSON file, counted from 0."""
    where: str | None = None
    """Property that selects the feature of the GeoJSON file, as ``property:value``."""
    lattice_step: float = 30.0
    """Distance between neighbouring landing points of a lattice row [m]."""
    lattice_angle: float = 45.0
    """Slant of the landing-point lattice [deg], in (0, 90]."""
    n_landing_points: int | None = None
    """Number of landing points kept, those nearest to the centroid; all if not given."""
    initial_conditions: int = 1024
    """Number of initial conditions (UAV starts and source walk) drawn per seed, divided among the regions."""
    start_positions: list | None = None
    """One place inside the region per UAV, which starts on the nearest landing point; drawn if not given. A
    place is [x, y], metres east and north in the coordinates of the region's vertices, or of the centroid of
    a region from a file; there it may also be {lat: 53.1, lon: -4.5} in degrees."""
    start_together: bool = False
    """Whether all UAVs start on the same drawn landing point; given start positions may then share one."""

    options: Any = None
    """Settings of your own region source, as a mapping."""

    def __post_init__(self) -> None:
        checks.convert_types("region", self)
        REGION_SOURCES.get(self.kind, "region.kind")
        checks.above("region.min_area", self.min_area, 0.0, "m^2")
        checks.in_range("region.max_area", self.max_area, self.min_area, unit="m^2")
        checks.whole("region.pool", self.pool, 1, 10_000)
        checks.whole("region.initial_conditions", self.initial_conditions, self.pool, checks.WORLDS)
        checks.above("region.lattice_step", self.lattice_step, 0.0, "m")
        checks.above("region.lattice_angle", self.lattice_angle, 0.0, "deg")
        checks.in_range("region.lattice_angle", self.lattice_angle, 0.0, 90.0, "deg")
        apart = self.lattice_step * math.sin(math.radians(self.lattice_angle))
        problem = (
            f"lays rows of landing points {apart:g} m apart, but places are told apart to {RESOLUTION:g} m"
        )
        checks.require(apart >= RESOLUTION, "region.lattice_step", f"{self.lattice_step:g} m", problem)
        if self.n_landing_points is not None:
            checks.whole("region.n_landing_points", self.n_landing_points, 1)
        required_keys = {"vertices": ["vertices"], "fir": ["path", "id"], "geojson": ["path"]}
        for key in required_keys.get(self.kind, []):
            problem = f"is missing: region.kind={self.kind} needs it"
            checks.require(bool(getattr(self, key)), f"region.{key}", "it", problem)
        self._refuse_unread()
        check_places("region.start_positions", self.start_positions or [])

    def regions(self, rng: np.random.Generator) -> list[Region]:
        """Read the region from its file or vertices, or draw ``pool`` random regions.

        Raises:
            InputError: the file cannot be read, the vertices form no valid polygon, or the given function
                raises an error or returns no list of regions with valid polygons.
        """
        source, name = REGION_SOURCES.get(self.kind, "region.kind"), f"region.kind: {self.kind}"
        if ":" not in self.kind:
            return [centred(region) for region in source(self, rng)]
        with naming_errors(name):
            found = source(self, rng)
        listed = isinstance(found, list) and found and all(isinstance(each, Region) for each in found)
        checks.require(
            bool(listed), name, f"a {type(found).__name__}", "is not a list of at least one Region"
        )
        for region in found:
            reason = shapely.is_valid_reason(region.polygon)
            checks.require(
                region.polygon.is_valid, f"{name}: {region.name}", reason, "[m]: edges must not cross"
            )
        most, problem = self.initial_conditions, "regions: each needs at least one initial condition"
        checks.require(len(found) <= most, "region.initial_conditions", f"{most} for {len(found)}", problem)
        return [centred(region) for region in found]

    def _refuse_unread(self) -> None:
        """Refuse settings of other kinds of regions, which this kind would ignore."""
        if ":" in self.kind:
            return  # such a function may read any of them
        for setting in fields(self):
            kinds = _READ_BY.get(setting.name, [self.kind])
            default = [] if setting.name == "vertices" else setting.default
            checks.require(
                self.kind in kinds or getattr(self, setting.name) == default,
                f"region.{setting.name}",
                getattr(self, setting.name),
                f"means nothing with region.kind={self.kind}: only {' or '.join(kinds)} reads it",
            )


_READ_BY = {
    "min_area": ["random"],
    "max_area": ["random"],
    "pool": ["random"],
    "vertices": ["vertices"],
    "path": ["fir", "geojson"],
    "id": ["fir"],
    "index": ["geojson"],
    "where": ["geojson"],
    "options": ["a package.module:function"],
}
"""Settings that only some kinds of regions read, and these kinds."""


RegionSource = Callable[[RegionConfig, np.random.Generator], list[Region]]
"""From the settings and a random generator to the regions; each episode flies over one of them."""


def _not_a_source(found: Any) -> str | None:
    return None if inspect.isfunction(found) else "is no function (config, rng) -> list[Region]"


REGION_SOURCES = Registry[RegionSource]("region source", _not_a_source)
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
    return [read_fir(_file(config.path), config.id)]


@REGION_SOURCES.register("geojson")
def _region_of_geojson(config: RegionConfig, rng: np.random.Generator) -> list[Region]:
    return [read_geojson(_file(config.path), config.index, config.where)]


def _file(path: str) -> str:
    """The file of a path; one that begins with ``damian:`` is among the package's own."""
    shipped = path.removeprefix("damian:")
    return path if shipped == path else str(files("damian") / "data" / shipped)
