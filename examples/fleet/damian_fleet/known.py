"""Reports of a UAV as the service keeps them: with counts, and stored in snapshots."""

import copyreg
from typing import Any

from damian.field import known
from damian.field.known import FilledReport
from damian.field.rows import Report


class UavLog(known.UavLog):
    """The reports of one UAV, and how they came in."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.received = self.late = self.duplicates = 0

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
