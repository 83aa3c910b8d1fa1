"""Settings of the simulated world: UAVs, region, motion, signal source, batteries and actions."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from damian.common import checks
from damian.world.airspace import Airspace, build_airspace
from damian.world.battery import BatteryConfig
from damian.world.landing import ActionConfig
from damian.world.motion import MotionConfig, flight_levels
from damian.world.regions.config import RegionConfig
from damian.world.sensors import sensors_of
from damian.world.signal_source import SourceConfig

FLIGHT_LEVEL_M = 30.48
"""Metres per flight level of a published region (one flight level is 100 feet)."""


@dataclass
class WorldConfig:
    """All settings of the simulation."""

    agents: int = 3
    """Number of UAVs."""
    region: RegionConfig = field(default_factory=RegionConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    source: SourceConfig = field(default_factory=SourceConfig)
    battery: BatteryConfig = field(default_factory=BatteryConfig)
    actions: ActionConfig = field(default_factory=ActionConfig)
    sensors: list[Any] = field(default_factory=list)
    """Sensors of one's own (``damian.sensor``), whose readings the messages carry: each
    ``package.module:name``, or ``{sensor: package.module:name, ...}`` with parameters of the sensor."""

    def __post_init__(self) -> None:
        checks.in_range("agents", self.agents, 1, 1000)  # their distances grow with the square
        flight_levels(self.motion, self.agents)
        sensors_of(self.sensors)  # refuses what is no sensor
        starts = self.region.start_positions
        checks.require(
            starts is None or len(starts) == self.agents,
            "region.start_positions",
            f"{len(starts or [])} places",
            f"are not one for each of the {self.agents} UAVs (agents)",
        )
        n_places = len({tuple(start) for start in starts or ()})
        should = "are equal for some UAVs only: give each UAV its own place, or all of them the same"
        together = starts is None or n_places in (1, self.agents)
        checks.require(together, "region.start_positions", starts, should)

    def airspace(self, rng: np.random.Generator) -> Airspace:
        """Build the regions and their landing points.

        Args:
            rng: random generator, for random regions.

        Raises:
            InputError: a wrong file or polygon, fewer landing points than UAVs, or a flight level of a
                UAV outside those of its region.
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
