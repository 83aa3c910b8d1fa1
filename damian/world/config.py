"""Settings of the simulated world: UAVs, region, motion, signal source, batteries and actions."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from damian.common import checks
from damian.common.fields import Settings, chance, check_place, constant, metres, rules, setting

RANDOM = ("random",)
GEOJSON = ("geojson",)
FILES = ("fir", "geojson")
POLYNOMIAL, DYNAMIC, CHARGING = ("polynomial",), ("dynamic",), ("charging",)
"""Variants of a section that read a setting (``kinds``)."""
FOOTPRINT = "footprint"
"""The sensor that tells the radius of a UAV's footprint, if it is drawn."""
RANDOMISED = (
    "motion.max_speed",
    "motion.max_acceleration",
    "battery.capacity_kwh",
    "motion.abort",
    "wind.speed",
    "wind.direction",
    "wind.gusts",
    "source.level_db",
    "source.miss",
    "source.false_alarm",
    "delay.loss",
)
"""Settings that may be drawn for each world and episode."""


@dataclass
class RegionConfig(Settings):
    """Region, landing points and start positions (paper, section 3.2).

    A place is [x, y] in metres, east and north in the coordinates of the vertices, or from the
    centroid of a
    region from a file, which also takes {lat: 53.1, lon: -4.5} in degrees.
    """

    section = "region"

    kind: str = setting(
        "random",
        "Origin: random, vertices, fir (Eurocontrol table), geojson, or your own "
        "package.module:function.",
        choices=("random", "vertices", "fir", "geojson"),
        paths=True,
    )
    min_area: float = setting(
        100000.0, "Smallest area of a random one.", unit="m^2", above=0, kinds=RANDOM
    )
    max_area: float = setting(
        200000.0, "Largest area of a random one.", unit="m^2", above=0, kinds=RANDOM
    )
    pool: int = setting(
        1, "Number of random regions, drawn once per seed.", low=1, high=10_000, kinds=RANDOM
    )
    vertices: list = setting([], "Polygon corners, [x, y] each.", unit="m", kinds=("vertices",))
    path: str = setting(
        "",
        "File, such as park.geojson, .kml, .gpkg, .shp, .plan (fir: damian:fir.csv).",
        kinds=FILES,
    )
    id: str = setting("", "Airspace ID of the region in the FIR table.", kinds=("fir",))
    index: list[int] | None = setting(
        None, "Index of the feature in the file, from 0, or a list to unite.", low=0, kinds=GEOJSON
    )
    where: list[str] | None = setting(
        None, "Property of the feature, ``property:value``, or a list to unite.", kinds=GEOJSON
    )
    zones: Any = setting(
        [],
        "No-fly zones: a list of the corners of each (places, as those of a source), a map, or the "
        "number of random ones.",
    )
    zone_area: float = setting(2500.0, "Area of a random zone.", unit="m^2", above=0)
    zone_margin: float = setting(0.0, "Distance that UAVs keep from zones.", unit="m", low=0)
    lattice_step: float = metres(30.0, "Distance between landing points of a row.")
    lattice_angle: float = setting(
        45.0, "Slant of the landing-point lattice.", unit="deg", above=0, high=90
    )
    n_landing_points: int | None = setting(
        None,
        "Number of landing points kept, those nearest to the centroid; all if not given.",
        low=1,
    )
    initial_conditions: int = setting(
        1024,
        "Number of UAV starts and source walks drawn per seed, over all regions.",
        low=1,
        high=10**6,
    )
    start_positions: list | None = setting(
        None, "One place per UAV, [x, y] in metres or {lat: 53.1, lon: -4.5}; drawn if not given."
    )
    start_together: bool = setting(False, "Whether all UAVs start on the same landing point.")
    options: Any = setting(
        None, "Settings of a region of your own, as a mapping.", kinds=("vertices",)
    )

    def __post_init__(self) -> None:
        for name in ("index", "where"):
            given = getattr(self, name)
            self.refuse(given == [], name, "chooses no feature: leave it out")
            if not isinstance(given, list | None):
                setattr(self, name, [given])
        super().__post_init__()
        checks.in_range("region.max_area", self.max_area, self.min_area, unit="m^2")
        checks.in_range("region.initial_conditions", self.initial_conditions, self.pool)
        for name in {"vertices": ["vertices"], "fir": ["path", "id"], "geojson": ["path"]}.get(
            self.kind, []
        ):
            self.refuse(
                not getattr(self, name), name, f"is missing: region.kind={self.kind} needs it"
            )
        self.refuse(
            self.options is not None and ":" not in self.kind,
            "options",
            "means nothing without a region of your own (region.kind=package.module:function)",
        )
        should = (
            "must be PROPERTY:VALUE, for example region.where=name:park, or a list of such texts"
        )
        for each in self.where or []:
            checks.require(re.search(".[:=]", each) is not None, "region.where", each, should)
        both = bool(self.index and self.where)
        self.refuse(both, "where", "and region.index both choose; give one of them")
        zones = self.zones
        drawn = checks.is_number(self.zones)
        wrong = zones % 1 or not 0 <= zones <= 100 if drawn else not isinstance(zones, list | str)
        self.refuse(
            wrong,
            "zones",
            "is not a list of zones, the path of a map, or the number of random ones, from 0 to 100",
        )
        for zone in zones if isinstance(zones, list) else []:
            good = isinstance(zone, list) and len(zone) > 2
            self.refuse(
                not good,
                "zones",
                "has a zone that is not a list of three or more corners: "
                "region.zones=[[[0,0],[50,0],[0,50]]]",
            )
            for place in zone:
                check_place("region.zones", place)
        self.refuse_unread()
        for place in self.start_positions or []:
            check_place("region.start_positions", place)


@dataclass
class MotionConfig(Settings):
    """How UAVs move."""

    section = "motion"

    kind: str = setting(
        "instant",
        "instant (at the target when the step ends, even across a no-fly zone), polynomial, or "
        "package.module:Class, a MotionModel.",
        choices=("instant", "polynomial"),
        paths=True,
    )
    degree: int = setting(
        5, "Degree of the time law of each phase.", choices=(3, 5, 7), kinds=POLYNOMIAL
    )
    max_speed: float = setting(
        5.0, "Largest speed through the air.", unit="m/s", low=1e-3, kinds=POLYNOMIAL, each=True
    )
    max_acceleration: float = setting(
        2.0, "Acceleration limit.", unit="m/s^2", low=1e-3, kinds=POLYNOMIAL, each=True
    )
    min_ground_speed: float = setting(
        1.0,
        "A flight that wind would make slower is not flown.",
        unit="m/s",
        above=0,
        kinds=POLYNOMIAL,
    )
    sensing_time: float = setting(
        0.0, "Time that a landed UAV senses before it chooses.", unit="s", low=0
    )
    min_level: float = metres(1.0, "Flight level of the first UAV.")
    max_level: float = metres(
        20.0, "Highest flight level; UAVs that fly instantly share levels if need be."
    )
    level_separation: float = metres(0.5, "Vertical distance between two flight levels.")
    abort: float = chance(
        0.0,
        "Probability that a flight ends at another legal landing point than commanded; holding "
        "included.",
        each=True,
    )
    options: Any = setting(
        None, "Settings of a motion model of your own, as a mapping.", kinds=POLYNOMIAL
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        unread = self.options is not None and ":" not in self.kind
        self.refuse(unread, "options", f"means nothing with motion.kind={self.kind}")
        checks.in_range("motion.max_level", self.max_level, self.min_level, unit="m")


@dataclass
class FailureConfig(Settings):
    """UAVs that fall silent for a while and stay where they are."""

    section = "failure"

    probability: float = chance(0.0, "Probability that a UAV fails in a simulation step.")
    duration: float = setting(
        60.0, "Mean time after which it joins again; each step is as likely.", unit="s", above=0
    )


@dataclass
class WindConfig(Settings):
    """Wind, which flights that take time feel."""

    section = "wind"

    speed: float = setting(0.0, "Mean speed of the wind.", unit="m/s", low=0, high=100)
    direction: float | None = setting(
        None,
        "Direction from which it blows, clockwise from north; drawn for each episode if not given.",
        unit="deg",
        low=-360,
        high=360,
    )
    gusts: float = setting(
        0.0, "Standard deviation of a flight's wind, east and north.", unit="m/s", low=0, high=30
    )


@dataclass
class SourceConfig(Settings):
    """The signal source that the UAVs search for."""

    section = "source"

    count: int = setting(1, "Number of sources.", low=1, high=32)
    each: list[Any] = setting(
        [],
        "What differs of each source, as {level_db: 130, motion: dynamic}; all are alike if empty.",
    )
    level_db: float = setting(
        140.0, "Sound level at 1 m, re 1e-12 W/m^2.", unit="dB", low=-300, high=300
    )
    microphone_db: float = constant(
        105.0,
        "Lowest level that is heard; only its distance from ``level_db`` counts.",
        unit="dB",
        low=0,
    )
    motion: str = setting("static", "Whether the source walks.", choices=("static", "dynamic"))
    emission: str = setting(
        "constant",
        "constant, or on and off, drawn at each stop (per_stop) or simulation step (per_step).",
        choices=("constant", "per_stop", "per_step"),
    )
    miss: float = chance(0.0, "Probability that a UAV in reach does not detect it.")
    false_alarm: float = chance(
        0.0, "Probability that a listening UAV which is out of reach reports a detection."
    )
    emission_probability: float = chance(0.5, "Probability that it is on, if not constant.")
    after_walk: str = setting(
        "loop",
        "After the last stop: go straight back and make the same round again (loop), or stay "
        "silent (stop).",
        choices=("loop", "stop"),
        kinds=DYNAMIC,
    )
    position: Any = setting(
        None, "Place or start, [x, y] in metres or {lat: 53.1, lon: -4.5}; drawn if not given."
    )
    n_hotspots: int = setting(10, "Number of hotspots of a walk.", low=1, high=1000, kinds=DYNAMIC)
    min_stops: int = setting(3, "Fewest inner points around a hotspot.", low=1, kinds=DYNAMIC)
    max_stops: int = setting(
        7, "Most inner points around a hotspot.", low=1, high=1000, kinds=DYNAMIC
    )
    local_distance: float = metres(
        50.0, "Largest distance of an inner point from its hotspot.", kinds=DYNAMIC
    )
    speed: float = setting(20.0, "Largest speed to a hotspot.", unit="m/s", above=0, kinds=DYNAMIC)
    acceleration: float = setting(
        2.5, "Acceleration to a hotspot.", unit="m/s^2", above=0, kinds=DYNAMIC
    )
    local_speed: float = setting(
        1.7, "Largest speed around a hotspot.", unit="m/s", above=0, kinds=DYNAMIC
    )
    local_acceleration: float = setting(
        1.1, "Acceleration around a hotspot.", unit="m/s^2", above=0, kinds=DYNAMIC
    )
    min_wait: float = setting(60.0, "Shortest wait at a stop.", unit="s", low=0, kinds=DYNAMIC)
    max_wait: float = setting(360.0, "Longest wait at a stop.", unit="s", low=0, kinds=DYNAMIC)

    @property
    def variant(self) -> str:
        return self.motion

    @property
    def all(self) -> list["SourceConfig"]:
        """The settings of each source, K."""
        return [replace(self, count=1, each=[], **each) for each in self.each or [{}] * self.count]

    @property
    def emits(self) -> float:
        """Probability that the source emits in a step, if nothing else is known of it."""
        return 1.0 if self.emission == "constant" else self.emission_probability

    def __post_init__(self) -> None:
        super().__post_init__()
        wrong = self.each and len(self.each) != self.count
        self.refuse(
            wrong, "each", f"is not one mapping for each of the source.count={self.count} sources"
        )
        for each in self.each:
            wrong = not isinstance(each, Mapping) or not {*each} <= {*rules(SourceConfig)} - {
                "count",
                "each",
            }
            self.refuse(
                wrong, "each", "has something else than settings of a source: {level_db: 130}"
            )
        heard = self.microphone_db < self.level_db
        least = f"microphone_db={self.microphone_db:g} dB"
        self.refuse(not heard, "level_db", f"is not above {least}: not heard even at 1 m")
        static = self.motion != "dynamic"
        problem = "needs source.motion=dynamic: a static source does not walk"
        self.refuse(static and self.after_walk != "loop", "after_walk", problem)
        self.refuse(static and self.emission == "per_stop", "emission", problem)
        if self.position is not None:
            check_place("source.position", self.position)
        checks.in_range("source.max_stops", self.max_stops, self.min_stops, 1000)
        checks.in_range("source.max_wait", self.max_wait, self.min_wait, unit="s")


@dataclass
class RequestConfig(Settings):
    """Requests that appear at random places, to be served by landing near them."""

    section = "requests"

    rate: float = setting(
        0.0,
        "Mean number that appears in a minute (a Poisson process).",
        unit="1/min",
        low=0,
        high=6000,
    )
    most: int = setting(6, "Number that can be open at once; another one is lost.", low=1, high=64)
    range: float | None = metres(
        None,
        "UAVs on the ground hear of those within it; the server knows all at once if not given.",
    )

    @property
    def slots(self) -> int:
        """Number of requests that a world holds; 0 if none appears."""
        return self.most if self.rate > 0 else 0

    @property
    def known_at_once(self) -> bool:
        """Whether requests appear that the server itself knows of at once."""
        return self.slots > 0 and self.range is None


@dataclass
class BatteryConfig(Settings):
    """Batteries of the UAVs, and the places where they charge."""

    section = "battery"

    enabled: bool = setting(False, "Whether flights drain the battery.", kinds=CHARGING)
    engine_power_kw: float = setting(
        10.0,
        "Power at the reference speed, and in takeoff and landing.",
        unit="kW",
        above=0,
        kinds=CHARGING,
        each=True,
    )
    reference_speed: float = setting(
        20.0,
        "Cruise speed at which the engine takes its full power.",
        unit="m/s",
        above=0,
        kinds=CHARGING,
    )
    capacity_kwh: float = setting(
        9.0, "Energy of a full battery.", unit="kWh", low=1e-6, kinds=CHARGING, each=True
    )
    efficiency: float = setting(
        12.0, "Factor that divides the consumption.", above=0, kinds=CHARGING
    )
    charging_power_kw: float = setting(
        4.0, "Power of a charging UAV.", unit="kW", above=0, kinds=CHARGING, each=True
    )
    resolution: float = setting(
        5.0, "Observed levels are multiples of this.", unit="%", above=0, high=100, kinds=CHARGING
    )
    charging_points: list | None = setting(
        None,
        "Places as source.position near which UAVs charge; anywhere if not given.",
        kinds=CHARGING,
    )

    @property
    def variant(self) -> str:
        return "charging" if self.enabled else "none"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse(
            self.charging_points == [],
            "charging_points",
            "is not a list of places; leave it out to charge anywhere",
        )
        for place in self.charging_points or []:
            check_place("battery.charging_points", place)
        self.refuse(
            self.charging_points and not self.enabled,
            "charging_points",
            "needs battery.enabled=true: the batteries stay full",
        )


@dataclass
class ActionConfig(Settings):
    """The (distance, heading) actions of the UAVs (paper, section 4.2)."""

    section = "actions"

    kind: str = setting(
        "discrete",
        "discrete (every distance with every heading), or continuous (up to the largest distance).",
        choices=("discrete", "continuous"),
    )
    distances: list[float] = setting(
        [0.0, 50.0, 100.0, 150.0, 200.0], "Distances; 0 holds.", unit="m", low=0
    )
    headings: list[float] = setting(
        [-135.0, -90.0, -45.0, 0.0, 45.0, 90.0, 135.0, 180.0],
        "Headings of discrete actions, clockwise from north.",
        unit="deg",
        low=-360,
        high=360,
    )
    mask: bool = setting(True, "Mask actions without effect: outside, battery too low, in flight.")
    command: str = setting(
        "relative",
        "What a late action says: a way from wherever the UAV is by then (relative), or the place "
        "to which it led from where the UAV chose it (absolute).",
        choices=("relative", "absolute"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("distances", "headings"):
            self.refuse(not getattr(self, name), name, "is empty")
            checks.distinct(f"actions.{name}", getattr(self, name))
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
    failure: FailureConfig = setting(FailureConfig)
    wind: WindConfig = setting(WindConfig)
    source: SourceConfig = setting(SourceConfig)
    requests: RequestConfig = setting(RequestConfig)
    battery: BatteryConfig = setting(BatteryConfig)
    actions: ActionConfig = setting(ActionConfig)
    randomise: dict[str, Any] = setting(
        {},
        "Settings that are drawn for each world and episode, such as {wind.speed: [0, 6]}: from a "
        "range, or from a list of more than two values; [6] is always 6.",
    )
    sensors: list[Any] = setting(
        [],
        "Sensors of your own: package.module:name, or "
        "{sensor: package.module:name, parameter: ...}.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        starts = self.region.start_positions
        wrong = starts is not None and len(starts) != self.agents
        self.refuse(
            wrong, "region.start_positions", f"is not one place for each of the {self.agents} UAVs"
        )
        for section in (self.motion, self.battery):
            for name, rule in rules(type(section)).items():
                values = getattr(section, name)
                wrong = rule.each and isinstance(values, list) and len(values) != self.agents
                self.refuse(
                    wrong,
                    f"{section.section}.{name}",
                    f"is not one value for each of the {self.agents} UAVs",
                )
        self._check_randomise()
        self.refuse(
            self.is_windy and self.motion.kind == "instant",
            "wind",
            "needs motion=polynomial: instant flights feel no wind",
        )
        continuous = self.actions.kind == "continuous"
        self.refuse(
            self.may_abort and continuous,
            "motion.abort",
            "needs discrete actions, whose mask says where a flight may end",
        )

    @property
    def tells_truth(self) -> bool:
        """Whether messages also tell who truly was in reach of a source."""
        return False

    @property
    def tells_events(self) -> bool:
        """Whether messages tell what was heard and served at each stop."""
        return False

    @property
    def tells_commands(self) -> bool:
        """Whether messages tell which absolute command was executed last."""
        return False

    @property
    def announced(self) -> int:
        """Number of commands under way of which messages tell."""
        return 0

    @property
    def pending(self) -> int:
        """Number of its own latest commands that a UAV observes."""
        return 0

    @property
    def seeks_source(self) -> bool:
        """Whether anything is won by finding a source."""
        return True

    @property
    def is_windy(self) -> bool:
        """Whether there may be wind."""
        drawn = {"wind.speed", "wind.gusts"} & {*self.randomise}
        return bool(self.wind.speed or self.wind.gusts or drawn)

    @property
    def may_abort(self) -> bool:
        """Whether a flight may end elsewhere than commanded."""
        return self.motion.abort not in (0, [0] * self.agents) or "motion.abort" in self.randomise

    def _check_randomise(self) -> None:
        """Refuse what cannot be drawn; each value must be one that the setting may have."""
        for key, values in self.randomise.items():
            own = f"randomise.{key}"
            checks.require(
                key in RANDOMISED, own, values, f"cannot be drawn, only {', '.join(RANDOMISED)}"
            )
            good = isinstance(values, list) and 1 <= len(values) <= 8
            checks.require(good, own, values, "is not a range or a list of at most 8 values")
            section, _, name = key.partition(".")
            given = getattr(getattr(self, section), name)
            checks.require(
                not isinstance(given, list),
                own,
                values,
                f"draws one value for all UAVs, but {key}={given} has one for each: leave one of "
                "them out",
            )
            apart = section == "source" and any(name in each for each in self.source.each)
            checks.require(
                not apart,
                own,
                values,
                f"draws one value for all sources, but source.each tells {name}: leave one of them "
                "out",
            )
            for value in values:
                replace(getattr(self, section), **{name: value})
