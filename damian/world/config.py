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
    """Your own sensors (``damian.sensor``), whose readings the messages carry: each
    ``package.module:name``, or ``{sensor: package.module:name, ...}`` with parameters of the sensor."""

    def __post_init__(self) -> None:
        checks.convert_types("", self)
        checks.whole("agents", self.agents, 1, 1000)  # their distances grow with the square
        if self.motion.kind == "polynomial":  # others refuse them when they are built
            flight_levels(self.motion, self.agents)
        sensors_of(self.sensors)  # refuses what is no sensor
        starts = self.region.start_positions
        checks.require(
            starts is None or len(starts) == self.agents,
            "region.start_positions",
            f"{len(starts or [])} places",
            f"are not one for each of the {self.agents} UAVs (agents)",
        )

    def airspace(self, rng: np.random.Generator) -> Airspace:
        """Build the regions and their landing points.

        Args:
            rng: random generator, for random regions.

        Raises:
            InputError: a wrong file or polygon, or fewer landing points than UAVs.
        """
        region = self.region
        return build_airspace(
            region.regions(rng),
            region.lattice_step,
            region.lattice_angle,
            region.n_landing_points,
            self.agents,
        )
