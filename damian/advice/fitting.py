"""The delays of real reports, and those that never came in, as a trace that simulations can replay."""

import math
from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from damian.advice.journal import SUFFIX, Received, read_head, read_lines
from damian.advice.rows import Report, read_file
from damian.common.errors import InputError
from damian.common.text_files import named
from damian.delays.laws import LOST

REGULAR = 0.2
"""Share of a period by which the time between two reports may differ from whole periods."""
MOST = 0.8
"""Share of the times between reports that must be whole periods, for the reports to count as regular."""
LONGEST_GAP = 1000
"""Most messages that are taken as lost between two that came in: longer gaps are pauses."""


class Message(NamedTuple):
    """A message of a UAV."""

    uav: str
    """ID of the UAV."""
    time: float
    """When it was generated [s]; estimated for one that never came in."""
    received: float | None
    """When it came in first [s]; None if it never did."""


class Fit(NamedTuple):
    """Delays of messages."""

    messages: list[Message]
    """Those of one UAV after those of another, each in the order of their generation."""
    losses: str
    """How lost messages were found."""

    @property
    def delays(self) -> np.ndarray:
        """Delays of the messages that came in [s]."""
        return np.array([max(m.received - m.time, 0.0) for m in self.messages if m.received is not None])

    @property
    def n_lost(self) -> int:
        """Number of messages that never came in."""
        return sum(message.received is None for message in self.messages)


def read_log(path: Path) -> list[Report]:
    """The reports of a journal, or of a table with a column ``receive time``; each says when it came in."""
    if path.suffix == SUFFIX or path.name.endswith(".ended"):
        read_head(path)
        lines = [line for _, line in read_lines(path)]
        reports = [report for line in lines if isinstance(line, Received) for report in line.reports]
    else:
        with named(path):
            rows = read_file(path)
            for where, report in rows:
                said = report.model_fields_set
                if "time" not in said or not {"received", "aoi"} & said:
                    raise InputError(f"{where}: it needs time and receive time, or time and AoI")
                report.stamp(math.nan, file=True)
        reports = [report for _, report in rows]
    if len(reports) < 2:
        raise InputError(f"{path}: {len(reports)} reports are too few to tell how late they are")
    return reports


def fit(reports: Iterable[Report]) -> Fit:
    """Delays of reports, and which are missing between them.

    Where reports of a UAV are numbered (``sequence``), a missing number is a lost message. Where they are
    not, but most come in whole periods, a gap of several periods has lost messages in it, unless the UAV was
    in the air, where it is silent. Else no loss can be seen.
    """
    found: list[Message] = []
    kinds: set[str] = set()
    by_uav = sorted(reports, key=lambda report: (report.id, report.time, report.received))
    for uav, own in groupby(by_uav, lambda report: report.id):
        first_copies = [next(copies) for _, copies in groupby(own, lambda report: report.time)]
        gaps, kind = _gaps(first_copies)
        kinds.add(kind)
        times = [report.time for report in first_copies]
        for i, report in enumerate(first_copies):
            if i and gaps[i - 1] <= LONGEST_GAP:
                between = np.linspace(times[i - 1], times[i], gaps[i - 1] + 2)[1:-1]
                found += [Message(uav, time, None) for time in between.tolist()]
            found.append(Message(uav, report.time, report.received))
    return Fit(found, " and ".join(sorted(kinds)))


def _gaps(reports: Sequence[Report]) -> tuple[list[int], str]:
    """Number of messages that are missing between each report and the next one, and how this was found."""
    numbers = [report.sequence for report in reports]
    if len(numbers) > 1 and all(number is not None for number in numbers):
        steps = np.diff(np.array(numbers, dtype=int))
        return (steps - 1).clip(min=0).tolist(), "by their numbers"  # a UAV that starts anew counts from 0
    between = np.diff([report.time for report in reports])
    if len(between) >= 2:
        period = float(np.median(between))
        periods = between / period
        regular = np.abs(periods - periods.round()) <= REGULAR
        if (regular & (periods.round() >= 1)).mean() >= MOST:
            missing = (periods.round().astype(int) - 1).clip(min=0)
            missing[[report.flies for report in reports[:-1]]] = 0
            return missing.tolist(), f"by their period of {period:.3g} s"
    return [0] * len(between), "not to be seen (no numbers, no period)"


def trace_rows(fitted: Fit) -> list[str]:
    """The column ``delay`` of a trace, a row for each message: times, which a simulation rounds up."""
    rows = []
    for message in fitted.messages:
        delay = None if message.received is None else max(message.received - message.time, 0.0)
        rows.append(LOST if delay is None else f"{delay:.6f}s" if delay >= 1e-6 else "0")
    return rows


def summary(fitted: Fit) -> str:
    """The fitted delays and losses as text, on two lines."""
    delays, n = fitted.delays, len(fitted.messages)
    uavs = {message.uav for message in fitted.messages}
    times = [message.time for message in fitted.messages]
    median, most, nearly_all = np.quantile(delays, [0.5, 0.9, 0.99])
    return (
        f"{n} messages of {len(uavs)} UAVs over {max(times) - min(times):.0f} s; lost: {fitted.n_lost} "
        f"({fitted.n_lost / n:.1%}), {fitted.losses}\n"
        f"delay [s]: mean {delays.mean():.3f}, median {median:.3f}, 90 % {most:.3f}, 99 % {nearly_all:.3f}, "
        f"longest {delays.max():.3f}"
    )
