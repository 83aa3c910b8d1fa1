"""Which times a fleet can count: the clocks of UAVs must be set, and no fleet lasts for ever."""

import math

from damian.advice.reports import Report
from damian.common.checks import SECONDS
from damian.common.errors import InputError

FUTURE = 1.0
"""How far the clock of a UAV may be ahead of that of the server [s]."""
FIRST = 3600.0
"""How old a report may be when it comes in, while its fleet has not begun [s]: the fleet would begin then."""
LIFE = SECONDS
"""How long a fleet lasts [s]."""
_ROUNDING = 1e-3
"""Share of a step by which times may be rounded."""


def step_at(time: float, start: float, dt: float) -> int:
    """The step of ``dt`` seconds since ``start`` [s] in which a time [s] lies."""
    return math.floor((time - start) / dt + _ROUNDING)


def check_ahead(report: Report, received: float) -> None:
    """Check that a report is not of the future.

    Args:
        report: the report.
        received: when it came in [s].

    Raises:
        InputError: the clock of the UAV is ahead by more than ``FUTURE``.
    """
    for name, time in (("time", report.time), ("source time", report.detected)):
        if time is not None and time > received + FUTURE:
            ahead = f"{time:.13g} s is {time - received:.1f} s after it came in"
            raise InputError(f"{name}: {ahead}: set the clock of the UAV")


def check_first(report: Report, now: float) -> None:
    """Check that a report, with which a fleet may begin, has just been generated.

    A clock that was never set counts from 1970 or from when it was switched on. The fleet would begin then,
    and would be over at once.

    Args:
        report: the report, which comes in now.
        now: the time [s].

    Raises:
        InputError: it is older than ``FIRST``.
    """
    if report.time < now - FIRST:
        late = f"{report.time:.13g} s is {now - report.time:.1f} s before it came in"
        most = f"more than the {FIRST:g} s of a first report"
        raise InputError(f"time: {late}, {most}: set the clock of the UAV")


def check_life(start: float | None, now: float) -> None:
    """Check that the steps of a fleet can still be counted.

    Args:
        start: when it began [s]; None if it has not.
        now: the time [s].

    Raises:
        InputError: it began more than ``LIFE`` ago.
    """
    if start is not None and now - start > LIFE:
        raise InputError(f"time: the fleet began more than {LIFE:g} s ago: end it, and begin a new one")
