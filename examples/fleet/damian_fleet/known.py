"""Reports of a UAV as the service keeps them: with counts, and stored in snapshots."""

import copyreg
import math
from typing import Any

from damian.common.counter_rng import number_of
from damian.field import known
from damian.field.known import FilledReport, Ground
from damian.field.rows import Report

KEPT, KEPT_ANYWAY = 512, 16
"""Most and fewest reports of a UAV that are kept: a late one changes what newer ones left open."""


def mark_of(ground: Ground) -> str:
    """A text that stands for landing points."""
    return str(number_of(str(ground.points.round(2).tolist())))


class UavLog(known.UavLog):
    """The latest reports of one UAV, and how they came in."""

    def __init__(self, ground: Ground, n_stops: int, n_readings: int, kept_steps: int, dt: float) -> None:
        super().__init__(ground, n_stops, n_readings, dt)
        self.kept_steps = kept_steps
        self.known_from = -math.inf
        """Time since which all reports are kept [s]."""
        self.received = self.late = self.duplicates = 0

    def add(self, report: Report, *args: Any) -> FilledReport:
        """The same; reports that nothing depends on any more are forgotten."""
        filled = super().add(report, *args)
        too_old = self.reports[-1].step - self.kept_steps
        while len(self.reports) > KEPT or (
            len(self.reports) > KEPT_ANYWAY and self.reports[0].step < too_old
        ):
            del self.reports[0]
            self.known_from = self.reports[0].report.time
        return filled

    def __getstate__(self) -> dict[str, Any]:
        """What is stored: all but the landing points."""
        return self.__dict__ | {"ground": None}


def stored_report(said: str, received: float, *others: Any) -> FilledReport:
    """A filled report from a snapshot."""
    report = Report.model_validate_json(said)
    report.received = received
    return FilledReport(report, *others)


def _reduced(filled: FilledReport) -> tuple[Any, ...]:
    said = filled.report.model_dump_json(by_alias=True, exclude_none=True)
    return stored_report, (said, filled.report.received, *list(vars(filled).values())[1:])


copyreg.pickle(FilledReport, _reduced)
