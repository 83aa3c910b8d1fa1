"""Reported observations: what the rows of a table say, each value checked."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from damian.advice.ground import DEGREES, METRES, Place
from damian.advice.tables import Rows
from damian.common.errors import InputError
from damian.common.text_files import show

FLAGS = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
LATEST = 4e9
"""Latest time that is understood [s since 1970]."""


@dataclass(frozen=True)
class Report:
    """What a UAV reports; None where it does not say."""

    uav: str
    """Its ID."""
    time: float
    """When the observation was generated [s]; since 1970 (UTC), or since any other instant."""
    place: Place
    """Where the UAV is: latitude and longitude [deg], or x and y [m]."""
    degrees: bool = True
    """Whether its places are degrees."""
    spotted: bool = False
    """Whether it spots the source."""
    altitude: float | None = None
    """Height above the ground [m]; the UAV flies if it is above 0."""
    detected: float | None = None
    """When it detected the source last [s]."""
    detected_at: Place | None = None
    """Where it was then."""
    target: Place | None = None
    """The landing point that it is bound for."""
    track: float | None = None
    """Heading of its latest flight, clockwise from north [deg]."""
    battery: float | None = None
    """Battery level [%]."""
    moved: float | None = None
    """When it took off or landed last [s]."""
    previous: tuple[Place, ...] | None = None
    """Landing points where it was before, newest first."""
    motions: int | None = None
    """Decisions (holding included) since it last detected the source before."""
    readings: tuple[float, ...] | None = None
    """Readings of its sensors of one's own."""
    sequence: int | None = None
    """Number of the report, which grows by one."""
    received: float | None = None
    """When the report came in [s], if it is read from a file."""

    @property
    def flies(self) -> bool:
        """Whether the UAV is in the air."""
        return self.altitude is not None and self.altitude > 0


def read_rows(rows: Rows, now: float, file: bool) -> list[Report]:
    """Check rows.

    Args:
        rows: each with its place in the text.
        now: when they came in [s].
        file: they are from a file, whose ``receive time`` counts.

    Raises:
        InputError: a value is missing or wrong; the line names its place, column, value and unit.
    """
    reports = []
    for where, row in rows:
        try:
            reports.append(_report(row, now, file))
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
    return reports


def _report(row: Mapping[str, Any], now: float, file: bool) -> Report:
    received = _time(row, "receive time") if file else None
    if not file and "receive time" in row:
        reads = "only damian advise reports=FILE and damian fit-delays read it"
        raise InputError(f"receive time: {reads}; the service looks at its own clock")
    time, age = _time(row, "time"), _number(row, "aoi", 0, LATEST, "s") or 0.0
    if file and received is None and time is not None:
        received = time + age
    place = _place(row, "")
    if place is None:
        raise InputError("lat, lon: they are missing: where the UAV is [deg], or x, y [m]")
    spotted, detected = _flag(row, "source spotted"), _time(row, "source time")
    detected_at = _place(row, "source ")
    if detected_at is not None and detected is None and not spotted:
        raise InputError("source time: it is missing: when the source was detected at this place [s]")
    if time is None:
        time = (now if received is None else received) - age
    return Report(
        uav=_id(row),
        time=time,
        place=place,
        degrees="lat" in row,
        spotted=spotted,
        altitude=_number(row, "fla", -500, 1e5, "m"),
        detected=detected,
        detected_at=detected_at,
        target=_place(row, "target "),
        track=_number(row, "track", -360, 360, "deg"),
        battery=_number(row, "battery", 0, 100, "%"),
        moved=_time(row, "takeoff-landing time"),
        previous=_places(row),
        motions=_whole(row, "motions"),
        readings=_readings(row),
        sequence=_whole(row, "sequence"),
        received=received,
    )


def _id(row: Mapping[str, Any]) -> str:
    value = row.get("id")
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise InputError(f"ID: {show(value)} is not the ID of a UAV")
    return str(value).strip()


def _number(row: Mapping[str, Any], column: str, low: float, high: float, unit: str) -> float | None:
    if column not in row:
        return None
    value = row[column]
    try:
        number = float(value) if isinstance(value, str | int | float) else math.nan
    except (ValueError, OverflowError):
        number = math.nan
    if isinstance(value, bool) or not low <= number <= high:
        problem = f"is not a number between {low:g} and {high:g} {unit}"
        raise InputError(f"{column}: {show(value)} {problem}")
    return number


def _whole(row: Mapping[str, Any], column: str) -> int | None:
    number = _number(row, column, 0, 2**31, "")
    if number is not None and number != int(number):
        raise InputError(f"{column}: {show(row[column])} is not a whole number")
    return None if number is None else int(number)


def _flag(row: Mapping[str, Any], column: str) -> bool:
    if column not in row:
        return False
    flag = FLAGS.get(str(row[column]).strip().lower().removesuffix(".0"))
    if flag is None:
        raise InputError(f"{column}: {show(row[column])} is not 1 or 0, true or false")
    return flag


def _time(row: Mapping[str, Any], column: str) -> float | None:
    """A time [s]: a number, or ISO 8601, which is UTC if it names no zone."""
    if column not in row:
        return None
    value = row[column]
    if isinstance(value, str) and not _is_number(value):
        try:
            parsed = datetime.fromisoformat(value.strip())
            value = (parsed if parsed.tzinfo else parsed.replace(tzinfo=UTC)).timestamp()
        except (ValueError, OverflowError):
            problem = "is neither seconds nor a time such as 2026-05-01T12:00:00Z"
            raise InputError(f"{column}: {show(value)} {problem}") from None
    return _number({column: value}, column, 0, LATEST, "s")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _place(row: Mapping[str, Any], prefix: str) -> Place | None:
    """The place of the columns with this prefix."""
    degrees = prefix + "lat" in row or prefix + "lon" in row
    metres = prefix + "x" in row or prefix + "y" in row
    if degrees and metres:
        raise InputError(f"{prefix}lat, {prefix}x: give either degrees or metres")
    if not degrees and not metres:
        return None
    columns, own = (DEGREES if degrees else METRES), (METRES if "x" in row or "y" in row else DEGREES)
    if columns != own:
        given, asked = (f"{prefix}{', '.join(names)}" for names in (columns, own))
        raise InputError(f"{given}: the place of the UAV is {', '.join(own)}: give {asked} too")
    return _pair([row.get(prefix + column) for column in columns], columns, prefix)


def _pair(values: Sequence[Any], columns: tuple[str, str], prefix: str) -> Place:
    limits = (90.0, 180.0, "deg") if columns == DEGREES else (2e7, 2e7, "m")
    numbers = []
    for column, value, limit in zip(columns, values, limits[:2], strict=True):
        found = {} if value is None else {prefix + column: value}
        number = _number(found, prefix + column, -limit, limit, limits[2])
        if number is None:
            raise InputError(f"{prefix}{column}: it is missing [{limits[2]}]")
        numbers.append(number)
    return numbers[0], numbers[1]


def _places(row: Mapping[str, Any]) -> tuple[Place, ...] | None:
    """Landing points of the past: a list of pairs, or ``lat lon; lat lon``."""
    if "previous" not in row:
        return None
    value, columns = row["previous"], METRES if "x" in row else DEGREES
    pairs = [part.split() for part in value.split(";")] if isinstance(value, str) else value
    if not isinstance(pairs, list) or len(pairs) > 16 or not all(_is_pair(pair) for pair in pairs):
        problem = "is not a list of at most 16 places such as [[53.1, -4.5]], or 53.1 -4.5; 53.2 -4.5"
        raise InputError(f"previous: {show(value)} {problem}")
    return tuple(_pair(pair, columns, "previous ") for pair in pairs)


def _is_pair(pair: Any) -> bool:
    return isinstance(pair, list) and len(pair) == 2


def _readings(row: Mapping[str, Any]) -> tuple[float, ...] | None:
    if "readings" not in row:
        return None
    value = row["readings"]
    parts = value.split(";") if isinstance(value, str) else value
    if not isinstance(parts, list) or len(parts) > 1000:
        raise InputError(f"readings: {show(value)} is not a list of numbers")
    numbers = [_number({"readings": part}, "readings", -1e9, 1e9, "") for part in parts]
    return tuple(number for number in numbers if number is not None)
