"""Settings of the simulated world: UAVs, region, motion, signal source, batteries and actions."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from damian.common import checks
from damian.settings.fields import Settings, check_place, constant, setting

RESOLUTION = 0.01
"""Places are told apart to this distance [m]."""


@dataclass
class RegionConfig(Settings):
    """Region, landing points and start positions (paper, section 3.2)."""

    section: ClassVar[str] = "region"

    kind: str = setting(
        "random",
        "Origin of the region: ``random``, ``vertices``, ``fir`` (Eurocontrol table), ``geojson``, or "
        "``package.module:function`` of your own.",
        choices=("random", "vertices", "fir", "geojson"),
        paths=True,
    )
    min_area: float = setting(
        100000.0, "Smallest area of a random region [m^2].", above=0, unit="m^2", kinds=("random",)
    )
    max_area: float = setting(
        200000.0, "Largest area of a random region [m^2].", above=0, unit="m^2", kinds=("random",)
    )
    pool: int = setting(
        1,
        "Number of random regions drawn once per seed; every episode of every world uses one of them.",
        low=1,
        high=10_000,
        kinds=("random",),
    )
    vertices: list = setting(
        [], "Polygon corners [x, y] in metres, for ``kind=vertices``.", kinds=("vertices",)
    )
    path: str = setting(
        "",
        "File to read, for ``kind=fir`` and ``kind=geojson``; ``damian:fir.csv`` is the table of the "
        "package.",
        kinds=("fir", "geojson"),
    )
    id: str = setting("", "Airspace ID of the region in the FIR table.", kinds=("fir",))
    index: int | None = setting(
        None, "Index of the feature in the GeoJSON file, counted from 0.", low=0, kinds=("geojson",)
    )
    where: str | None = setting(
        None,
        "Property that selects the feature of the GeoJSON file, as ``property:value``.",
        kinds=("geojson",),
    )
    lattice_step: float = setting(
        30.0, "Distance between neighbouring landing points of a lattice row [m].", above=0, unit="m"
    )
    lattice_angle: float = setting(
        45.0, "Slant of the landing-point lattice [deg], in (0, 90].", above=0, high=90, unit="deg"
    )
    n_landing_points: int | None = setting(
        None, "Number of landing points kept, those nearest to the centroid; all if not given.", low=1
    )
    initial_conditions: int = setting(
        1024,
        "Number of initial conditions (UAV starts and source walk) drawn per seed, divided among the "
        "regions.",
        low=1,
        high=checks.WORLDS,
    )
    start_positions: list | None = setting(
        None,
        "One place inside the region per UAV, which starts on the nearest landing point; drawn if not "
        "given. A place is [x, y], metres east and north in the coordinates of the region's vertices, or "
        "of the centroid of a region from a file; there it may also be {lat: 53.1, lon: -4.5} in degrees.",
    )
    start_together: bool = setting(
        False,
        "Whether all UAVs start on the same drawn landing point; given start positions may then share one.",
    )
    options: Any = setting(
        None, "Settings of a region source of your own, as a mapping.", kinds=("vertices",)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.in_range("region.max_area", self.max_area, self.min_area, unit="m^2")
        checks.in_range("region.initial_conditions", self.initial_conditions, self.pool)
        apart = self.lattice_step * math.sin(math.radians(self.lattice_angle))
        problem = (
            f"lays rows of landing points {apart:g} m apart, but places are told apart to {RESOLUTION} m"
        )
        checks.require(apart >= RESOLUTION, "region.lattice_step", f"{self.lattice_step:g} m", problem)
        required_keys = {"vertices": ["vertices"], "fir": ["path", "id"], "geojson": ["path"]}
        for key in required_keys.get(self.kind, []):
            problem = f"is missing: region.kind={self.kind} needs it"
            checks.require(bool(getattr(self, key)), f"region.{key}", "it", problem)
        problem = (
            f"means nothing with region.kind={self.kind}: only your own package.module:function reads it"
        )
        checks.require(self.options is None or ":" in self.kind, "region.options", self.options, problem)
        self.refuse_unread()
        for place in self.start_positions or []:
            check_place("region.start_positions", place)


@dataclass
class MotionConfig(Settings):
    """How UAVs move."""

    section: ClassVar[str] = "motion"

    kind: str = setting(
        "instant",
        "``instant``: a UAV is at its target when the step ends; ``polynomial``: flights take several "
        "steps; ``package.module:Class``: a ``MotionModel`` of your own.",
        choices=("instant", "polynomial"),
        paths=True,
    )
    degree: int = setting(
        5, "Degree of the time law of each phase: 3, 5 or 7.", choices=(3, 5, 7), kinds=("polynomial",)
    )
    max_speed: float = setting(
        5.0, "Speed limit of a phase [m/s].", low=1e-3, unit="m/s", kinds=("polynomial",)
    )
    max_acceleration: float = setting(
        2.0, "Acceleration limit of a phase [m/s^2].", low=1e-3, unit="m/s^2", kinds=("polynomial",)
    )
    sensing_time: float = setting(
        0.0, "Time that a landed UAV senses before it may choose again [s].", low=0, unit="s"
    )
    min_level: float = setting(1.0, "Flight level of the first UAV [m].", above=0, unit="m")
    max_level: float = setting(
        20.0,
        "Highest flight level [m]. UAVs that fly instantly share levels if there are too few for all of "
        "them.",
        above=0,
        unit="m",
    )
    level_separation: float = setting(
        0.5, "Vertical distance between the flight levels of two UAVs [m].", above=0, unit="m"
    )
    options: Any = setting(
        None, "Settings of a motion model of your own, as a mapping.", kinds=("polynomial",)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        problem = f"means nothing with motion.kind={self.kind}"
        checks.require(self.options is None or ":" in self.kind, "motion.options", self.options, problem)
        checks.in_range("motion.max_level", self.max_level, self.min_level, unit="m")


@dataclass
class SourceConfig(Settings):
    """The signal source that the UAVs search for."""

    section: ClassVar[str] = "source"

    level_db: float = setting(140.0, "Sound level at 1 m [dB re 1e-12 W/m^2].", low=-300, high=300, unit="dB")
    microphone_db: float = constant(
        105.0,
        "Lowest level that a UAV's microphone detects [dB re 1e-12 W/m^2]. Only its distance from "
        "``level_db`` counts.",
        low=0,
        unit="dB",
    )
    motion: str = setting(
        "static", "``static``, or ``dynamic``: the source walks over hotspots.", choices=("static", "dynamic")
    )
    emission: str = setting(
        "constant",
        "``constant``; ``per_stop`` or ``per_step``: on or off, drawn at each stop or simulation step.",
        choices=("constant", "per_stop", "per_step"),
    )
    emission_probability: float = setting(
        0.5, "Probability that an intermittent source is on.", low=0, high=1
    )
    after_walk: str = setting(
        "loop",
        "What a dynamic source does after the last stop of its walk. ``loop``: it goes straight back to "
        "its first hotspot and makes the same round again, with the same waits (an emission per stop is "
        "drawn anew); ``stop``: it stays there, silent for good.",
        choices=("loop", "stop"),
        kinds=("dynamic",),
    )
    position: Any = setting(
        None,
        "Position, or start of the walk: [x, y] in metres, or {lat: 53.1, lon: -4.5} in degrees (as for "
        "region.start_positions); drawn for each initial condition if not given.",
    )
    n_hotspots: int = setting(10, "Number of hotspots of a walk.", low=1, high=1000, kinds=("dynamic",))
    min_stops: int = setting(
        3, "Smallest number of inner points around a hotspot.", low=1, kinds=("dynamic",)
    )
    max_stops: int = setting(
        7, "Largest number of inner points around a hotspot.", high=1000, low=1, kinds=("dynamic",)
    )
    local_distance: float = setting(
        50.0,
        "Largest distance of an inner point from its hotspot [m].",
        above=0,
        unit="m",
        kinds=("dynamic",),
    )
    speed: float = setting(
        20.0, "Largest speed on the way to another hotspot [m/s].", above=0, unit="m/s", kinds=("dynamic",)
    )
    acceleration: float = setting(
        2.5, "Acceleration on the way to another hotspot [m/s^2].", above=0, unit="m/s^2", kinds=("dynamic",)
    )
    local_speed: float = setting(
        1.7, "Largest speed between stops around one hotspot [m/s].", above=0, unit="m/s", kinds=("dynamic",)
    )
    local_acceleration: float = setting(
        1.1,
        "Acceleration between stops around one hotspot [m/s^2].",
        above=0,
        unit="m/s^2",
        kinds=("dynamic",),
    )
    min_wait: float = setting(60.0, "Shortest wait at a stop [s].", low=0, unit="s", kinds=("dynamic",))
    max_wait: float = setting(360.0, "Longest wait at a stop [s].", low=0, unit="s", kinds=("dynamic",))

    @property
    def variant(self) -> str:
        return self.motion

    @property
    def emits(self) -> float:
        """Probability that the source emits in a step, if nothing else is known of it."""
        return 1.0 if self.emission == "constant" else self.emission_probability

    def __post_init__(self) -> None:
        super().__post_init__()
        level, least = f"{self.level_db} dB", f"microphone_db={self.microphone_db:g} dB"
        problem = f"is not above {least}: not heard even at 1 m"
        checks.require(self.microphone_db < self.level_db, "source.level_db", level, problem)
        moves = self.motion == "dynamic"
        problem = "needs source.motion=dynamic: a static source does not walk"
        checks.require(moves or self.after_walk == "loop", "source.after_walk", "stop", problem)
        problem = "needs source.motion=dynamic: a static source has one stop; take constant or per_step"
        checks.require(moves or self.emission != "per_stop", "source.emission", "per_stop", problem)
        if self.position is not None:
            check_place("source.position", self.position)
        checks.in_range("source.max_stops", self.max_stops, self.min_stops, 1000)
        checks.in_range("source.max_wait", self.max_wait, self.min_wait, unit="s")


@dataclass
class BatteryConfig(Settings):
    """Batteries of the UAVs, and the places where they charge."""

    section: ClassVar[str] = "battery"

    enabled: bool = setting(
        False,
        "Whether flights drain the battery; if not, it stays full.",
        kinds=("charging",),
    )
    engine_power_kw: float = setting(
        10.0,
        "Engine power at the reference speed, and in takeoff and landing [kW].",
        above=0,
        unit="kW",
        kinds=("charging",),
    )
    reference_speed: float = setting(
        20.0,
        "Cruise speed at which the engine takes its full power [m/s].",
        above=0,
        unit="m/s",
        kinds=("charging",),
    )
    capacity_kwh: float = setting(
        9.0, "Energy of a full battery [kWh].", low=1e-6, unit="kWh", kinds=("charging",)
    )
    efficiency: float = setting(
        12.0, "Efficiency factor; the consumption is divided by it.", above=0, kinds=("charging",)
    )
    charging_power_kw: float = setting(
        4.0, "Power with which a landed UAV charges [kW].", above=0, unit="kW", kinds=("charging",)
    )
    resolution: float = setting(
        5.0,
        "Observed battery levels are rounded down to a multiple of this [%].",
        above=0,
        high=100,
        unit="%",
        kinds=("charging",),
    )
    charging_points: list | None = setting(
        None,
        "Places inside the region, [x, y] in metres or {lat: 53.1, lon: -4.5} in degrees (as for "
        "region.start_positions); UAVs charge at the landing point nearest each, or anywhere if not "
        "given.",
        kinds=("charging",),
    )

    @property
    def variant(self) -> str:
        return "charging" if self.enabled else "none"

    def __post_init__(self) -> None:
        super().__post_init__()
        given, problem = (
            self.charging_points != [],
            "is not a list of places; leave it out to charge anywhere",
        )
        checks.require(given, "battery.charging_points", "[]", problem)
        for place in self.charging_points or []:
            check_place("battery.charging_points", place)
        problem = "needs battery.enabled=true: the batteries stay full"
        alone = self.charging_points and not self.enabled
        checks.require(not alone, "battery.charging_points", self.charging_points, problem)


@dataclass
class ActionConfig(Settings):
    """The (distance, heading) actions of the UAVs (paper, section 4.2)."""

    section: ClassVar[str] = "actions"

    kind: str = setting(
        "discrete",
        "``discrete`` (every listed distance with every listed heading) or ``continuous``.",
        choices=("discrete", "continuous"),
    )
    distances: list[float] = setting(
        [0.0, 50.0, 100.0, 150.0, 200.0],
        "Distances [m]; 0 holds the position. Continuous actions reach up to the largest distance.",
        low=0,
        unit="m",
    )
    headings: list[float] = setting(
        [-135.0, -90.0, -45.0, 0.0, 45.0, 90.0, 135.0, 180.0],
        "Headings clockwise from north [deg]; only discrete actions use them.",
        low=-360,
        high=360,
        unit="deg",
    )
    mask: bool = setting(
        True,
        "Mask discrete actions without effect: target outside the region, battery too low, UAV in flight.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("distances", "headings"):
            values = getattr(self, name)
            checks.require(len(values) > 0, f"actions.{name}", values, "is empty")
            checks.distinct(f"actions.{name}", values)
        checks.above("actions.distances (largest)", max(self.distances), 0.0, "m")

    @property
    def n_actions(self) -> int:
        """Number of discrete actions."""
        return len(self.distances) * len(self.headings)


@dataclass
class WorldConfig(Settings):
    """All settings of the simulation."""

    agents: int = setting(3, "Number of UAVs.", low=1, high=1000)
    region: RegionConfig = setting(RegionConfig)
    motion: MotionConfig = setting(MotionConfig)
    source: SourceConfig = setting(SourceConfig)
    battery: BatteryConfig = setting(BatteryConfig)
    actions: ActionConfig = setting(ActionConfig)
    sensors: list[Any] = setting(
        [],
        "Sensors of your own (``damian.sensor``), whose readings the messages carry: each "
        "``package.module:name``, or ``{sensor: package.module:name, ...}`` with parameters of the "
        "sensor.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        starts, problem = (
            self.region.start_positions,
            f"are not one for each of the {self.agents} UAVs (agents)",
        )
        good = starts is None or len(starts) == self.agents
        checks.require(good, "region.start_positions", f"{len(starts or [])} places", problem)
