"""What the server node knows of a UAV: its reports in the order in which they were generated, as messages."""

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from damian.advice.ground import DEGREES, Ground
from damian.advice.reports import Report
from damian.common.errors import InputError
from damian.server.server import Server
from damian.world.battery import observed
from damian.world.messages import Messages

KEPT = 512
"""Reports of a UAV that are kept: a late one changes what newer ones left open."""


@dataclass
class Known:
    """A report with all that it leaves open filled in from the ones generated before it."""

    report: Report
    step: int
    """Step in which it was generated."""
    sent: tuple[int, int] | None
    """Landing points from which and to which the UAV had last been sent by then, if it had."""
    point: int = 0
    """Landing point where the UAV is; in flight, where it took off."""
    target: int = 0
    """Landing point that it is bound for."""
    track: float = 0.0
    """Heading of its latest flight [rad]."""
    battery: float = 100.0
    """Battery level [%]."""
    spotted: bool = False
    """Whether it spots the source; a UAV in flight does not."""
    detected: int | None = None
    """Step of its latest detection; None if there was none."""
    detected_at: int | None = None
    """Landing point of that detection."""
    motions: int = 0
    """Decisions since its latest detection before."""
    trail: tuple[int, ...] = ()
    """Its latest landing points, newest first."""
    readings: tuple[float, ...] = ()
    """Readings of its sensors of one's own."""


class UavLog:
    """The reports of one UAV.

    Args:
        ground: landing points.
        window: number of its latest landing points in a message.
        n_readings: number of readings in a message.
    """

    def __init__(self, ground: Ground, window: int, n_readings: int) -> None:
        self.ground, self.window, self.n_readings = ground, window, n_readings
        self.known: list[Known] = []
        self.received = self.late = self.duplicates = 0

    @property
    def newest(self) -> Known | None:
        """The report that was generated last."""
        return self.known[-1] if self.known else None

    def check(self, report: Report) -> None:
        """Check what a report says of places and readings.

        Raises:
            InputError: a place is far from any landing point, or there is another number of readings.
        """
        if report.degrees != (self.ground.columns == DEGREES):
            own, other = ("lat, lon [deg]", "x, y [m]")[:: 1 if self.ground.columns == DEGREES else -1]
            raise InputError(f"{other}: places in {self.ground.region.name} are {own}")
        for place in (report.place, report.detected_at, report.target, *(report.previous or ())):
            if place is not None:
                self.ground.landing_point(place)
        n = self.n_readings
        if report.readings is not None and len(report.readings) != n:
            raise InputError(f"readings: {len(report.readings)} numbers are not {n}, as in the training")

    def has(self, time: float) -> bool:
        """Has a report that was generated at this time come in before."""
        at = self._place_of(time)
        return at < len(self.known) and self.known[at].report.time == time

    def _place_of(self, time: float) -> int:
        """Number of known reports that were generated before this time; mostly all."""
        if not self.known or self.known[-1].report.time < time:
            return len(self.known)
        return bisect.bisect_left(self.known, time, key=_generated)

    def add(
        self, report: Report, step: int, detected: int | None, sent: tuple[int, int] | None = None
    ) -> Known:
        """Add a report, in its place by the time when it was generated.

        Args:
            report: the report.
            step: in which it was generated.
            detected: the step of the detection that it names.
            sent: landing points from which and to which the UAV had last been sent by then.
        """
        known = Known(report, step, sent, detected=detected)
        at = self._place_of(report.time)
        self.known.insert(at, known)
        for i in range(at, len(self.known)):
            self._fill(self.known[i], self.known[i - 1] if i else None)
        del self.known[: max(len(self.known) - KEPT, 0)]
        return known

    def _fill(self, known: Known, before: Known | None) -> None:
        """Fill in what a report leaves open."""
        report, near = known.report, self.ground.landing_point
        here = near(report.place)
        known.point = known.target = here
        if report.flies and known.sent:  # it is on its way, and took off from where it was sent
            known.point, known.target = known.sent
        elif report.flies and before:
            known.point = known.target = before.point
        if report.target is not None:
            known.target = near(report.target)
        known.track = before.track if before else 0.0
        if report.track is not None:
            known.track = math.radians(report.track) % (2 * math.pi)
        known.battery = before.battery if before else 100.0
        if report.battery is not None:
            known.battery = report.battery
        known.spotted = report.spotted and not report.flies
        self._fill_detection(known, before)
        known.motions = 0 if before is None or before.spotted else before.motions
        known.motions += before is not None
        if report.motions is not None:
            known.motions = report.motions
        known.trail = self._trail(known, before)
        known.readings = before.readings if before else (0.0,) * self.n_readings
        if report.readings is not None:
            known.readings = report.readings

    def _fill_detection(self, known: Known, before: Known | None) -> None:
        report = known.report
        if known.spotted:
            known.detected, known.detected_at = known.step, known.point
        elif report.detected is not None:
            place, held = report.detected_at, before and before.detected_at
            known.detected_at = (
                self.ground.landing_point(place)
                if place is not None
                else (held if held is not None else known.point)
            )
        elif before is not None:
            known.detected, known.detected_at = before.detected, before.detected_at

    def _trail(self, known: Known, before: Known | None) -> tuple[int, ...]:
        previous: Sequence[int] = before.trail if before else ()
        if known.report.previous is not None:
            trail = [known.point, *map(self.ground.landing_point, known.report.previous)]
        elif previous and previous[0] == known.point:
            trail = [*previous]
        else:
            trail = [known.point, *previous]
        return tuple([*trail, *[trail[-1]] * self.window][: self.window])


def _generated(known: Known) -> float:
    return known.report.time


def messages_of(known: Sequence[Known], server: Server, points: Tensor, dt: float) -> Messages:
    """Messages as the simulation would send them, [n].

    Args:
        known: the reports.
        server: gives the resolution of battery levels.
        points: landing points, [L, 2] metres.
        dt: length of a step [s].
    """
    steps = torch.tensor([each.step for each in known])
    detected = torch.tensor([-1 if each.detected is None else each.detected for each in known])
    battery = torch.tensor([each.battery for each in known])
    nowhere = torch.zeros(len(known), 2)
    at = torch.tensor([each.detected_at or 0 for each in known])
    empty = torch.zeros(len(known), dtype=torch.bool)
    if server.battery.enabled:
        empty = observed(battery, server.battery) <= 0
    has_detected = detected >= 0
    return Messages(
        time=steps * dt,
        position=points[[each.point for each in known]],
        target=points[[each.target for each in known]],
        track=torch.tensor([each.track for each in known]),
        battery=battery,
        spotted=torch.tensor([each.spotted for each in known]),
        empty=empty,
        motions=torch.tensor([each.motions for each in known]),
        detected_time=torch.where(has_detected, detected * dt, -1.0),
        detected_position=torch.where(has_detected.unsqueeze(-1), points[at], nowhere),
        trail=torch.tensor([each.trail for each in known]),
        readings=torch.tensor([each.readings for each in known]).view(len(known), -1),
    )
