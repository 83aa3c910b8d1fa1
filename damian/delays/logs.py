"""Reads from a table, or the journal of a service, when each report came in, and tells how late it
was."""

import math
from collections.abc import Mapping
from datetime import UTC, datetime
from json import loads
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from damian.common.errors import InputError
from damian.common.text_files import named, parse_table, read_text, show
from damian.delays.law_fit import LOST_STEPS, NO_MESSAGE, Integers
from damian.delays.laws import LOST

JOURNAL = ".jsonl"
"""End of the name of a journal: a head on its first line, and reports with when they came in on
others."""
UNKNOWN = ("", "na", "nan", "none", "null")
"""Cells that mean that a value is not known."""
LATEST = 4e9
"""Latest time that is understood [s since 1970]."""
LONGEST_GAP = 1000
"""Most messages that are taken as lost between two that came in: longer gaps are pauses."""


def column_of(name: str) -> str:
    """A name of a column in small letters, with spaces between words."""
    return name.strip().lower().replace("_", " ").replace("-", " ")


def seconds_of(text: str) -> float:
    """Seconds, also of ISO 8601, which is UTC if it names no zone; ``ValueError`` if it is
    neither."""
    try:  # digits alone are seconds, though ISO 8601 would read a date from eight of them
        return float(text)
    except ValueError:
        time = datetime.fromisoformat(text.strip())
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def read_log(path: Path) -> pd.DataFrame:
    """The log in a journal, or in a CSV table with receive times, as of
    ``damian.delays.clocks``."""
    with named(path):
        text = read_text(path)
        if path.suffix == JOURNAL:
            rows = _journal_rows(text)
        else:
            rows = [(f"line {row.line}", row.cells, None) for row in parse_table(text, [])]
        log = []
        for where, report, came in rows:
            with named(where):
                log.append({"where": where, **_row(report, came)})
        if len(log) < 2:
            raise InputError(f"{len(log)} reports are too few to tell how late they are")
    return pd.DataFrame(log)


def _journal_rows(text: str) -> list[tuple[str, Any, Any]]:
    """Reports of a journal, but for an unfinished last line, with their places and when they came
    in."""
    rows = []
    lines = text.rpartition("\n")[0].split("\n")
    for n, line in enumerate(lines, 1):
        with named(where := f"line {n}"):
            try:
                said = loads(line)
            except ValueError as error:
                raise InputError(f"it is not JSON: {error}") from None
            if not isinstance(said, dict):
                raise InputError("it is not a line of a journal")
        rows += [(where, report, said.get("received")) for report in said.get("reports", ())]
    return rows


def _row(said: Any, came: Any) -> dict[str, Any]:
    """What a report tells a log; ``came`` is when it came in, if its journal tells that."""
    if not isinstance(said, Mapping):
        raise InputError("it is not a report")
    cells = {column_of(str(name)): str(cell).strip() for name, cell in said.items()}
    if came is not None:
        cells = {"aoi": "0", **cells, "receive time": str(came)}
    cells = {name: cell for name, cell in cells.items() if cell.lower() not in UNKNOWN}
    names = "time", "receive time", "aoi", "sequence" if "sequence" in cells else "number"
    time, received, age, number = (_number(cells, name) for name in names)
    if math.isnan(time):
        time = received - age
    if math.isnan(received):
        received = time + age
    if "id" not in cells or math.isnan(received - time):
        raise InputError("it needs ID, and two of time, receive time and AoI")
    return {"uav": cells["id"], "time": time, "received": received, "sequence": number}


def _number(cells: Mapping[str, str], name: str) -> float:
    """A time [s], or the number of a report; nan if it does not say it."""
    try:
        number = seconds_of(cells.get(name, "nan"))
    except ValueError:
        raise InputError(
            f"{name}: {show(cells[name])} is neither a number nor a date of ISO 8601"
        ) from None
    if name in cells and not 0 <= number <= LATEST:
        raise InputError(
            f"{name}: {cells[name]}: give seconds since 1970, no milliseconds or microseconds"
        )
    return number


def delays_of(messages: pd.DataFrame) -> pd.DataFrame:
    """A row for each message, in the order of ``in_order``, whose columns these are.

    Columns: ``uav`` (ID), ``time`` when it was generated [s], ``received`` when it came in first
    [s], and its ``delay`` [s], 0 if clocks differ a little, so that it came in before its time; the
    last two are nan for a message that never came in, whose time is estimated: one whose number is
    missing. Where a UAV does not number its reports, no loss can be seen.
    """
    parts = []
    for uav, own in messages.drop_duplicates(["uav", "run", "time", "sequence"]).groupby("uav"):
        gaps = own.groupby("run").sequence.diff().sub(1).fillna(0)
        rows = np.arange(len(own)) + gaps.where(gaps <= LONGEST_GAP, 0).cumsum().to_numpy(int)
        every = own.set_index(rows)[["time", "received"]].reindex(range(rows[-1] + 1))
        part = every.assign(uav=uav, time=every.time.interpolate(limit_direction="both"))
        parts.append(part.sort_values("time", kind="stable") if own.sequence.isna().all() else part)
    delays = pd.concat(parts, ignore_index=True)
    return delays.assign(delay=(delays.received - delays.time).clip(lower=0))


def trace_rows(delays: pd.DataFrame) -> list[str]:
    """The column ``delay`` of a trace, a row for each message: times, which a simulation rounds
    up."""
    return [LOST if math.isnan(delay) else f"{delay:.6f}s" for delay in delays.delay]


def steps_of(delays: pd.DataFrame, dt: float) -> Integers:
    """Delays of the messages of each UAV in whole steps of ``dt`` seconds, for ``fit_laws``,
    [U, T]."""
    steps = np.ceil(delays.delay.round(6) / dt - 1e-9).fillna(LOST_STEPS)
    table = pd.DataFrame({"uav": delays.uav, "n": delays.groupby("uav").cumcount(), "steps": steps})
    return table.pivot(index="uav", columns="n", values="steps").fillna(NO_MESSAGE).to_numpy(int)
