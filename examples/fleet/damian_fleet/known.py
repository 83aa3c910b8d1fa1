"""What the server node knows of a UAV: its reports in the order in which they were generated, as
messages.

Places in reports count as the landing points nearest to them.
"""

import bisect
import json
import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import zip_longest
from typing import Any

import numpy as np
import shapely
import torch
from torch import Tensor

from damian.common.errors import InputError
from damian.delays.clocks import AGREE
from damian.world.airspace import Airspace
from damian.world.battery import observed
from damian.world.config import BatteryConfig
from damian.world.messages import Messages
from damian.world.regions.geodesy import to_latlon, to_local
from damian_fleet.reports import DEGREES, METRES, Place, Report


class Ground:
    """Landing points of a region, as answers and reports, up to ``reach`` [m] beside them, name
    places."""

    def __init__(self, airspace: Airspace, reach: float) -> None:
        self.region = airspace.regions[0]
        self.reach = reach
        self.columns = METRES if self.region.origin is None else DEGREES
        self.points = airspace.exact_points[0, : int(airspace.n_points[0])].numpy()
        self.landing_point = lru_cache(10_000)(
            self._landing_point
        )  # each place is looked up several times
        """Number of the landing point nearest to a place; ``InputError`` if it is farther than
        ``reach``."""

    def local(self, place: Place) -> tuple[float, float]:
        """A place, east and north of the origin of the region [m]."""
        first, second = place
        if self.region.origin is None:
            return first - self.region.offset[0], second - self.region.offset[1]
        x, y = to_local(first, second, self.region.origin)
        return float(x), float(y)

    def _landing_point(self, place: Place) -> int:
        away = np.hypot(*(self.points - self.local(place)).T)
        if away.min() > self.reach:
            where = (
                f"{', '.join(self.columns)}: {place[0]:.10g}, {place[1]:.10g} is {away.min():.0f} "
                "m away"
            )
            raise InputError(f"{where} from the landing points of {self.region.name}")
        return int(away.argmin())

    def place(self, point: int) -> Place:
        """Where a landing point is, in ``columns``, to a millimetre."""
        east, north = self.points[point].tolist()
        if self.region.origin is None:
            return round(east + self.region.offset[0], 3), round(north + self.region.offset[1], 3)
        latitude, longitude = to_latlon(east, north, self.region.origin)
        return round(float(latitude), 8), round(float(longitude), 8)

    def on_earth(self, geometry: Any) -> dict[str, Any]:
        """A geometry of local metres as GeoJSON (RFC 7946), with holes clockwise; across the
        antimeridian, longitudes go beyond 180."""
        origin = self.region.origin
        if origin is None:
            raise InputError(f"geofence: {self.region.name} has no place on Earth")

        def degrees(metres: Any) -> Any:
            latitude, longitude = to_latlon(metres[:, 0], metres[:, 1], origin)
            longitude = origin[1] + (longitude - origin[1] + 180) % 360 - 180
            return np.column_stack([longitude, latitude]).round(7)  # a centimetre

        placed = shapely.transform(geometry, degrees)
        return json.loads(shapely.to_geojson(shapely.orient_polygons(placed)))

    def way(self, origin: int, goal: int) -> tuple[float, float]:
        """Distance between two landing points [m] and heading, clockwise from north [deg]; two
        decimals."""
        east, north = (self.points[goal] - self.points[origin]).tolist()
        heading = math.degrees(math.atan2(east, north)) % 360
        return round(math.hypot(east, north), 2), round(heading, 2)


@dataclass
class FilledReport:
    """A report with all that it leaves open filled in from the ones generated before it."""

    report: Report
    step: int
    """Step in which it was generated."""
    origin: int | None = None
    """Landing point from which a UAV in flight took off, if that is known otherwise."""
    point: int = 0
    """Landing point where the UAV is; in flight, where it took off."""
    target: int = 0
    """Landing point to which it flies."""
    track: float = 0.0
    """Heading of its latest flight [rad]."""
    battery: float = 100.0
    """Battery level [%]."""
    battery_known: bool = False
    """Whether the UAV has ever reported one."""
    spotted: bool = False
    """Whether it spots the source; a UAV in flight does not."""
    detected: int | None = None
    """Step of its latest detection; None if there was none."""
    detected_at: int | None = None
    """Landing point of that detection."""
    motions: int = 0
    """Decisions since its latest detection before."""
    stops: tuple[tuple[int, int], ...] = ()
    """Its latest landing points, newest first, each with the step of the landing, or -1 if it is
    unknown."""
    readings: tuple[float, ...] = ()
    """Readings of sensors of your own."""

    @property
    def order(self) -> tuple[float, int]:
        """When it was generated; of reports of one instant, their numbers tell, and else which came
        first."""
        return self.report.time, self.report.sequence or 0


class UavLog:
    """The reports of one UAV."""

    def __init__(self, ground: Ground, n_stops: int, n_readings: int, dt: float) -> None:
        self.ground = ground
        self.n_stops = n_stops
        self.n_readings = n_readings
        self.dt = dt
        self.reports: list[FilledReport] = []
        self.identities: set[Hashable] = set()
        """Those of all reports that have come in."""

    @property
    def newest(self) -> FilledReport | None:
        """The report that was generated last."""
        return self.reports[-1] if self.reports else None

    def check(self, report: Report) -> None:
        """Require complete places near landing points, the readings of all sensors, and no clock
        set back."""
        report.check_places()
        if report.columns != self.ground.columns:
            own = ", ".join(self.ground.columns)
            raise InputError(
                f"places in {self.ground.region.name} are {own}: give those of {report.id} so"
            )
        own_places = (report.place(prefix) for prefix in ("", "source_", "target_"))
        for place in (*own_places, *(report.previous or ())):
            if place is not None:
                self.ground.landing_point(place)
        given = report.readings
        n = self.n_readings
        if given is not None and len(given) != n:
            raise InputError(f"readings: {len(given)} numbers are not {n}, as in the training")
        self._check_clock(report)

    def _check_clock(self, report: Report) -> None:
        """Refuse the time of a new report that was generated earlier than the one numbered before
        it."""
        own = report.sequence
        if own is None or self.has(report):
            return
        numbered = [(each.report.sequence, each.report.time) for each in self.reports]
        below = [
            (number, -time) for number, time in numbered if number is not None and number < own
        ]
        number, time = max(below, default=(0, math.inf))
        if report.time < -time - AGREE:
            back = (
                f"{report.time:.13g} s is {-time - report.time:.1f} s before that of number "
                f"{number}"
            )
            raise InputError(f"time: {back}: the clock of {report.id} was set back")

    def has(self, report: Report) -> bool:
        """Has this report come in before."""
        return report.identity in self.identities

    def add(
        self, report: Report, step: int, detected: int | None, origin: int | None = None
    ) -> FilledReport:
        """Add a report, in its place by the time when it was generated; arguments as of
        ``FilledReport``."""
        filled = FilledReport(report, step, origin, detected=detected)
        self.identities.add(report.identity)
        at = bisect.bisect_right(self.reports, filled.order, key=lambda each: each.order)
        self.reports.insert(at, filled)
        for i in range(at, len(self.reports)):
            self._fill(self.reports[i], self.reports[i - 1] if i else None)
        return filled

    def _fill(self, filled: FilledReport, before: FilledReport | None) -> None:
        """Fill in what a report leaves open."""
        report = filled.report
        near = self.ground.landing_point
        here = report.place()
        target = report.place("target_")
        assert here is not None  # every report has it
        took_off = before.point if before and filled.origin is None else filled.origin
        filled.point = filled.target = (
            took_off if report.flies and took_off is not None else near(here)
        )
        if target is not None:
            filled.target = near(target)
        known = before or FilledReport(report, filled.step, readings=(0.0,) * self.n_readings)
        filled.track = known.track
        if report.track is not None:
            filled.track = math.radians(report.track) % (2 * math.pi)
        filled.battery = known.battery if report.battery is None else report.battery
        filled.battery_known = known.battery_known or report.battery is not None
        filled.readings = known.readings if report.readings is None else report.readings
        filled.spotted = report.source_spotted and not report.flies
        place = report.place("source_")
        if filled.spotted:
            filled.detected = filled.step
            filled.detected_at = filled.point
        elif report.source_time is None:
            filled.detected = known.detected
            filled.detected_at = known.detected_at
        elif place is not None:
            filled.detected_at = near(place)
        else:
            filled.detected_at = filled.point if known.detected_at is None else known.detected_at
        filled.motions = 0 if before is None else 1 if before.spotted else before.motions + 1
        if report.motions is not None:
            filled.motions = report.motions
        filled.stops = self._stops(filled, before)

    def _stops(
        self, filled: FilledReport, before: FilledReport | None
    ) -> tuple[tuple[int, int], ...]:
        """The latest stops of a UAV, as far as a report and the one before it tell."""
        report = filled.report
        stops = list(before.stops) if before else []
        if not stops or stops[0][0] != filled.point:
            stops = [(filled.point, filled.step), *stops]
        if report.previous is not None:
            points = [filled.point, *map(self.ground.landing_point, report.previous)]
            same = [point == stop for point, (stop, _) in zip(points, stops, strict=False)]
            steps = [step if known else -1 for known, (_, step) in zip(same, stops, strict=False)]
            stops = [*zip_longest(points, steps, fillvalue=-1)]
        if report.landed is not None:
            ago = (round((report.time - time) / self.dt) for time in report.landed[: len(stops)])
            landed = [filled.step - n_steps for n_steps in ago]
            stops[: len(landed)] = [
                (point, step) for (point, _), step in zip(stops, landed, strict=False)
            ]
        return tuple([*stops, *[(stops[-1][0], -1)] * self.n_stops][: self.n_stops])


def messages_of(
    reports: Sequence[FilledReport], config: BatteryConfig, points: Tensor, dt: float
) -> Messages:
    """Messages [n] as the simulation would send them; ``config`` is of the batteries, landing points
    are [L, 2], and steps ``dt`` long [s]."""
    steps = torch.tensor([each.step for each in reports])
    detected = torch.tensor([-1 if each.detected is None else each.detected for each in reports])
    battery = torch.tensor([each.battery for each in reports])
    at = points[[each.detected_at or 0 for each in reports]]
    stops = torch.tensor([each.stops for each in reports])  # [n, S, 2]
    is_empty = config.enabled and observed(battery, config) <= 0
    return Messages(
        time=steps * dt,
        position=points[[each.point for each in reports]],
        target=points[[each.target for each in reports]],
        track=torch.tensor([each.track for each in reports]),
        battery=battery,
        spotted=torch.tensor([each.spotted for each in reports]),
        empty=torch.zeros_like(steps, dtype=torch.bool) | is_empty,
        motions=torch.tensor([each.motions for each in reports]),
        detected_time=torch.where(detected >= 0, detected * dt, -1.0).unsqueeze(-1),
        detected_position=torch.where((detected >= 0).unsqueeze(-1), at, 0.0).unsqueeze(-2),
        true_time=at.new_zeros(len(at), 0),
        true_position=at.new_zeros(len(at), 0, 2),
        requests=at.new_zeros(len(at), 0, 3),
        served=at.new_zeros(len(at), 0),
        serves=at.new_zeros(len(at), 0),
        executed=at.new_zeros(len(at), 0),
        announced=at.new_zeros(len(at), 0, 4),
        pending=at.new_zeros(len(at), 0, 5),
        trail=stops[..., 0],
        landed=torch.where(stops[..., 1] >= 0, stops[..., 1] * dt, -1.0),
        events=at.new_zeros(*stops.shape[:-1], 0),
        readings=torch.tensor([each.readings for each in reports]).view(len(reports), -1),
    )
