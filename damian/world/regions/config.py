"""Which region the UAVs fly over, its landing points, and where the UAVs start."""

from dataclasses import dataclass, field

import numpy as np

from damian.common import checks
from damian.world.regions.fir import read_fir
from damian.world.regions.geojson import read_geojson
from damian.world.regions.polygon import polygon_from_vertices, random_polygon
from damian.world.regions.region import Region


@dataclass
class RegionConfig:
    """Where the UAVs fly (SPEC 1)."""

    kind: str = "random"
    """``random``, ``vertices``, ``fir`` (Eurocontrol table) or ``geojson``."""
    min_area: float = 100_000.0
    """Smallest random region [m^2]."""
    max_area: float = 200_000.0
    """Largest random region [m^2]."""
    pool: int = 1
    """Random regions drawn once per seed; every episode of every world takes one of them."""
    vertices: list = field(default_factory=list)
    """Corners [x, y] in metres, for ``vertices``."""
    path: str = ""
    """File, for ``fir`` and ``geojson``."""
    id: str = ""
    """Airspace ID in a FIR table."""
    index: int | None = None
    """Which feature of a GeoJSON file."""
    where: str | None = None
    """Which feature of a GeoJSON file, as ``property:value``."""
    lattice_step: float = 30.0
    """Distance between landing points in a row [m]."""
    lattice_angle: float = 45.0
    """Slant of the lattice [deg]."""
    n_landing_points: int | None = None
    """Keep only the nearest to the centroid; all of them if not given."""
    initial_conditions: int = 1024
    """Beginnings (starts, source walk) drawn per seed and shared out among the regions."""
    start_positions: list | None = None
    """Where each UAV starts, [x, y] in metres (its nearest landing point); drawn if not given."""
    start_together: bool = False
    """Let all UAVs start on one drawn landing point."""

    def __post_init__(self) -> None:
        checks.one_of("region.kind", self.kind, ["random", "vertices", "fir", "geojson"])
        checks.above("region.min_area", self.min_area, 0.0, "m^2")
        checks.in_range("region.max_area", self.max_area, self.min_area, unit="m^2")
        checks.in_range("region.pool", self.pool, 1)
        checks.in_range("region.initial_conditions", self.initial_conditions, self.pool, 1e6)
        checks.require(
            self.pool == 1 or self.kind == "random",
            "region.pool",
            self.pool,
            f"means nothing with region.kind={self.kind}: only random regions are drawn",
        )
        checks.above("region.lattice_step", self.lattice_step, 0.0, "m")
        checks.above("region.lattice_angle", self.lattice_angle, 0.0, "deg")
        checks.in_range("region.lattice_angle", self.lattice_angle, 0.0, 90.0, "deg")
        if self.n_landing_points is not None:
            checks.in_range("region.n_landing_points", self.n_landing_points, 1)
        needs = {"vertices": ["vertices"], "fir": ["path", "id"], "geojson": ["path"]}
        for key in needs.get(self.kind, []):
            should = f"is missing: region.kind={self.kind} needs it"
            checks.require(bool(getattr(self, key)), f"region.{key}", "it", should)
        for start in self.start_positions or []:
            checks.place("region.start_positions", start)

    def regions(self, rng: np.random.Generator) -> list[Region]:
        """Read or draw the regions.

        Raises:
            InputError: a file or a polygon is wrong.
        """
        if self.kind == "fir":
            return [read_fir(self.path, self.id)]
        if self.kind == "geojson":
            return [read_geojson(self.path, self.index, self.where)]
        if self.kind == "vertices":
            polygons = [polygon_from_vertices(self.vertices, "region.vertices")]
        else:
            polygons = [random_polygon(rng, self.min_area, self.max_area) for _ in range(self.pool)]
        return [Region(p, f"{self.kind} region {i}", None, None) for i, p in enumerate(polygons)]
