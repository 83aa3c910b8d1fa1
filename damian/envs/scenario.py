"""What a world is made of: every setting of the environment, with its unit, default and check."""

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from damian.common import checks
from damian.delays.laws import DelayConfig
from damian.envs.clocks import ClockConfig
from damian.server.features import ObservationConfig
from damian.server.rewards import EpisodeConfig, RewardConfig
from damian.world.airspace import Airspace, build_airspace
from damian.world.battery import BatteryConfig
from damian.world.landing import ActionConfig
from damian.world.motion import MotionConfig, flight_levels
from damian.world.regions.fir import read_fir
from damian.world.regions.geojson import read_geojson
from damian.world.regions.polygon import polygon_from_vertices, random_polygon
from damian.world.regions.region import Region
from damian.world.signal_source import SourceConfig

FLIGHT_LEVEL_M = 30.48
"""A flight level is a hundred feet."""


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
    situations: int = 1024
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
        checks.in_range("region.situations", self.situations, self.pool, 1e6)
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


@dataclass
class ScenarioConfig:
    """A whole scenario; ``UavEnv(ScenarioConfig(agents=5), num_worlds=64)``."""

    agents: int = 3
    """Number of UAVs."""
    region: RegionConfig = field(default_factory=RegionConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    source: SourceConfig = field(default_factory=SourceConfig)
    battery: BatteryConfig = field(default_factory=BatteryConfig)
    actions: ActionConfig = field(default_factory=ActionConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    task: RewardConfig = field(default_factory=RewardConfig)
    episode: EpisodeConfig = field(default_factory=EpisodeConfig)
    clock: ClockConfig = field(default_factory=ClockConfig)
    delay: DelayConfig = field(default_factory=DelayConfig)

    def __post_init__(self) -> None:
        checks.in_range("agents", self.agents, 1)
        self.delay.check(self.clock.dt)
        flight_levels(self.motion, self.agents)
        self._check_ends()
        held = self.observation.own and self.clock.steps("server") > 1
        should = "does not go with clock.server: between two broadcasts nothing that is seen changes"
        checks.require(not held, "observation.own", True, should)
        alone = self.agents == 1 and self.observation.actor == ["agent_distances"]
        checks.require(not alone, "observation", "agent_distances", "is all that a single UAV sees")
        starts = self.region.start_positions
        checks.require(
            starts is None or len(starts) == self.agents,
            "region.start_positions",
            f"{len(starts or [])} places",
            f"are not one for each of the {self.agents} UAVs (agents)",
        )

    def _check_ends(self) -> None:
        """An end that can never come is a mistake."""
        checks.require(
            self.episode.discharged_share is None or self.battery.enabled,
            "episode.discharged_share",
            self.episode.discharged_share,
            "needs battery.enabled=true: the batteries stay full",
        )
        checks.require(
            not self.episode.end_with_source or self.source.motion == "dynamic",
            "episode.end_with_source",
            True,
            "needs source.motion=dynamic: a static source never ends its walk",
        )

    @property
    def time_scale(self) -> float:
        """What times are divided by [s]: as written, else the time limit, else an hour."""
        limit = None if self.episode.max_steps is None else self.episode.max_steps * self.clock.dt
        return self.observation.time_scale or limit or 3600.0

    def airspace(self, rng: np.random.Generator) -> Airspace:
        """Regions with their landing lattices.

        Raises:
            InputError: a wrong file or polygon, or fewer landing points than UAVs.
        """
        region = self.region
        regions = region.regions(rng)
        for level in flight_levels(self.motion, self.agents):
            for low, high in (r.levels for r in regions if r.levels is not None):
                checks.in_range(
                    "motion.min_level + i * motion.level_separation",
                    level,
                    low * FLIGHT_LEVEL_M,
                    high * FLIGHT_LEVEL_M,
                    "m",
                )
        return build_airspace(
            regions,
            region.lattice_step,
            region.lattice_angle,
            region.n_landing_points,
            self.agents,
        )


def leftovers(written: Any, config: Any, path: str = "") -> list[str]:
    """Keys that were written but that no field of the config takes (Hydra's ``+a.b=1`` slips in)."""
    known = {f.name: getattr(config, f.name) for f in fields(config)}
    unknown = [f"{path}{key}" for key in written if key not in known]
    for key, value in known.items():
        if hasattr(value, "__dataclass_fields__") and key in written:
            unknown += leftovers(written[key], value, f"{path}{key}.")
    return unknown
