"""Rows of tables as pydantic models: reports that come in and advice that goes out, as CSV and JSON.

Columns of a report may be written in any case, and with ``_`` for a space. ``NA``, an empty cell and null
mean that the value is not known.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails, from_json

from damian.common.errors import InputError
from damian.common.text_files import parse_table, read_text, show

DEGREES, METRES = ("lat", "lon"), ("x", "y")
"""Columns of a place: latitude and longitude [deg], or over a region without a place on Earth x and y [m]."""
Place = tuple[float, float]
"""A place in the columns that its row has."""

UNKNOWN = ("", "na", "nan", "none", "null")
"""Cells that mean that a value is not known."""
LATEST = 4e9
"""Latest time that is understood [s since 1970]."""
CALENDAR = 1e8
"""From this time on [s], times count from 1970 and are written as dates."""
MAX_UAVS = 100
"""Most UAVs of a fleet."""
MAX_ROWS = 10_000
"""Most rows of a request or a file in the folder."""


# Types of values.


def _no_flag(value: Any) -> Any:
    if isinstance(value, bool):  # which Python would take for 1 or 0
        raise ValueError("it is not a number")
    return value


def _seconds(value: Any) -> Any:
    """Seconds of ISO 8601, which is UTC if it names no zone; another value as it is."""
    if not isinstance(value, str):
        return _no_flag(value)
    try:  # digits alone are seconds, though ISO 8601 would read a date from eight of them
        return float(value)
    except ValueError:
        pass
    try:
        time = datetime.fromisoformat(value.strip())
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        raise ValueError("it is neither seconds nor a time such as 2026-05-01T12:00:00Z") from None


def _distinct(uavs: list[str]) -> list[str]:
    if len({*uavs}) < len(uavs):
        raise ValueError("it names a UAV twice")
    return uavs


def _printable(uav: str) -> str:
    if not uav.isprintable():
        raise ValueError("it has characters that cannot be printed")
    return uav


def _text_split_at(separator: str | None) -> BeforeValidator:
    return BeforeValidator(lambda value: value.split(separator) if isinstance(value, str) else value)


Number: TypeAlias = Annotated[float, Field(allow_inf_nan=False), BeforeValidator(_no_flag)]
Time: TypeAlias = Annotated[float, Field(ge=0, le=LATEST), BeforeValidator(_seconds)]
"""A time [s], as a number or as ISO 8601."""
Count: TypeAlias = Annotated[int, Field(ge=0, le=2**31), BeforeValidator(_no_flag)]
# Tables of numbers in which a cell is empty have 1.0 for 1.
Flag: TypeAlias = Annotated[
    bool, BeforeValidator(lambda v: v.removesuffix(".0") if isinstance(v, str) else v)
]
Latitude: TypeAlias = Annotated[Number, Field(ge=-90, le=90, description="latitude [deg]")]
Longitude: TypeAlias = Annotated[Number, Field(ge=-180, le=180, description="longitude [deg]")]
Coordinate: TypeAlias = Annotated[Number, Field(ge=-2e7, le=2e7, description="east or north [m]")]
Pair: TypeAlias = Annotated[tuple[Coordinate, Coordinate], _text_split_at(None)]
UavId: TypeAlias = Annotated[str, Field(min_length=1, max_length=64), AfterValidator(_printable)]
Uavs: TypeAlias = Annotated[list[UavId], Field(min_length=1, max_length=MAX_UAVS), AfterValidator(_distinct)]
"""IDs of the UAVs of a fleet."""

_TEXT = ConfigDict(str_strip_whitespace=True, coerce_numbers_to_str=True)


# What comes in.


class FleetRequest(BaseModel):
    """The UAVs of a new fleet."""

    model_config = _TEXT

    uavs: Uavs


class Report(BaseModel):
    """What a UAV reports; None where it does not say.

    The names of the fields, with a space for ``_``, are the columns of tables; journals keep the same ones.
    """

    model_config = _TEXT | ConfigDict(
        extra="forbid", alias_generator=lambda name: name.replace("_", " "), use_attribute_docstrings=True
    )

    id: UavId
    received: Time = Field(math.nan, alias="receive time", exclude=True)
    """When it came in [s]; a column of files only."""
    aoi: Annotated[Number, Field(ge=0, le=LATEST)] = Field(0.0, exclude=True)
    """Age of the observation when it came in [s], if there is no time."""
    time: Time = math.nan
    """When the observation was generated [s]."""
    lat: Latitude | None = None
    lon: Longitude | None = None
    x: Coordinate | None = None
    y: Coordinate | None = None
    source_spotted: Flag = False
    """Whether the UAV spots the source."""
    source_time: Time | None = None
    """When it detected the source last [s]; its place is where it was then."""
    source_lat: Latitude | None = None
    source_lon: Longitude | None = None
    source_x: Coordinate | None = None
    source_y: Coordinate | None = None
    track: Annotated[Number, Field(ge=-360, le=360)] | None = None
    """Heading of its latest flight, clockwise from north [deg]."""
    takeoff_landing_time: Time | None = None
    """When it took off or landed last [s]."""
    battery: Annotated[Number, Field(ge=0, le=100)] | None = None
    """Battery level [%]."""
    fla: Annotated[Number, Field(ge=-500, le=1e5)] | None = None
    """Flight altitude [m]: above 0 in flight."""
    target_lat: Latitude | None = None
    """Landing point to which it flies."""
    target_lon: Longitude | None = None
    target_x: Coordinate | None = None
    target_y: Coordinate | None = None
    previous: Annotated[tuple[Pair, ...], Field(max_length=16), _text_split_at(";")] | None = None
    """Landing points where it was before, newest first: [[53.1, -4.5]], or 53.1 -4.5; 53.2 -4.5."""
    motions: Count | None = None
    """Decisions (holding included) since it last detected the source before."""
    readings: Annotated[tuple[Number, ...], Field(max_length=1000), _text_split_at(";")] | None = None
    """Readings of sensors of your own."""
    sequence: Count | None = None
    """Number of the report, which grows by one."""

    @property
    def in_degrees(self) -> bool:
        """Whether its places are latitude and longitude."""
        return self.lat is not None

    @property
    def flies(self) -> bool:
        """Whether the UAV is in the air."""
        return self.fla is not None and self.fla > 0

    @property
    def place(self) -> Place:
        """Where the UAV is."""
        place = self._place("")
        assert place is not None  # by ``_places_are_complete``
        return place

    @property
    def source_place(self) -> Place | None:
        """Where the UAV was when it detected the source last."""
        return self._place("source_")

    @property
    def target(self) -> Place | None:
        """The landing point to which it flies."""
        return self._place("target_")

    def _place(self, prefix: str) -> Place | None:
        first, second = (getattr(self, prefix + name) for name in (DEGREES if self.in_degrees else METRES))
        return None if first is None else (first, second)

    def stamp(self, now: float, file: bool = False) -> None:
        """Set the times that the report leaves open.

        Args:
            now: when it came in [s].
            file: it is from a file, whose ``receive time`` counts.

        Raises:
            InputError: it says when it came in, and is not from a file.
        """
        said = self.model_fields_set
        if "received" in said and not file:
            reads = "only damian advise reports=FILE and damian advise fit=FILE read it"
            raise InputError(f"receive time: {reads}; the service looks at its own clock")
        has_time = "time" in said
        if "received" not in said:
            self.received = self.time + self.aoi if file and has_time else now
        if not has_time:
            self.time = self.received - self.aoi

    @model_validator(mode="before")
    @classmethod
    def _columns(cls, row: Any) -> Any:
        """What a row says, by its columns; unknown values are left out."""
        if not isinstance(row, Mapping):
            raise ValueError(f"{show(row)} is not an object with the columns of a report")
        named: dict[str, Any] = {}
        for name, value in row.items():
            column = _column(str(name))
            if column in named:
                raise ValueError(f"the column {show(column)} appears twice")
            named[column] = value
        return {column: value for column, value in named.items() if not _is_unknown(value)}

    @model_validator(mode="after")
    def _places_are_complete(self) -> "Report":
        said, degrees = self.model_fields_set, self.lat is not None or self.lon is not None
        pairs, others = _PAIRS[degrees], _PAIRS[not degrees]
        for (first, second), other in zip(pairs, others, strict=True):
            if (first in said) != (second in said):
                raise ValueError(f"{_column(second if first in said else first)}: it is missing")
            if not said.isdisjoint(other):
                own = ", ".join(pairs[0])
                raise ValueError(f"{_column(', '.join(other))}: give all places of a row in {own}")
        if pairs[0][0] not in said:
            raise ValueError("lat, lon: they are missing: where the UAV is [deg], or x, y [m]")
        if pairs[1][0] in said and self.source_time is None and not self.source_spotted:
            raise ValueError("source time: it is missing: when the source was detected at this place [s]")
        return self


_PAIRS = {
    columns == DEGREES: [
        (f"{prefix}{columns[0]}", f"{prefix}{columns[1]}") for prefix in ("", "source_", "target_")
    ]
    for columns in (DEGREES, METRES)
}
"""Fields of the places of a report, in degrees (True) and in metres."""


@lru_cache(1000)
def _column(name: str) -> str:
    return name.strip().lower().replace("_", " ").replace("-", " ")


Rows = list[tuple[str, Report]]
"""Reports, each with its place in the text (``line 2``)."""


def read_file(path: Path) -> Rows:
    """Reports of a file: ``.json``, ``.jsonl`` (an object on each line), or else CSV, by its name.

    Raises:
        InputError: it cannot be read, or a row is wrong.
    """
    text, kind = read_text(path), path.suffix.lower()
    return read_json(text, kind == ".jsonl") if kind in (".json", ".jsonl") else read_csv(text)


def read_csv(text: str) -> Rows:
    """Reports of a CSV table.

    Raises:
        InputError: it is no table, or a row is wrong.
    """
    return _rows([(f"line {row.line}", row.cells) for row in parse_table(text, [])])


def read_json(text: str | bytes, lines: bool = False) -> Rows:
    """Reports of JSON: an object, a list of objects, or an object on each line.

    Args:
        text: the JSON.
        lines: it has an object on each line.

    Raises:
        InputError: it is something else, or a row is wrong.
    """
    if lines:
        parts = [(f"line {n}", line) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
        return _rows([(where, parsed_json(line, where)) for where, line in parts])
    found = parsed_json(text, "JSON")
    rows = found if isinstance(found, list) else [found]
    return _rows([(f"row {n}", row) for n, row in enumerate(rows, 1)])


def _rows(found: Sequence[tuple[str, Any]]) -> Rows:
    if not 0 < len(found) <= MAX_ROWS:
        raise InputError(f"there are {len(found)} rows, not 1 to {MAX_ROWS}")
    return [(where, validated(Report, row, where)) for where, row in found]


def _is_unknown(value: Any) -> bool:
    return value is None or (isinstance(value, str) and value.strip().lower() in UNKNOWN)


def parsed_json(text: str | bytes, where: str) -> Any:
    """Parse JSON, without NaN and Infinity.

    Raises:
        InputError: it is none.
    """
    try:
        return from_json(text, allow_inf_nan=False)
    except ValueError as error:
        raise InputError(f"{where}: it is not JSON: {str(error)[:200]}") from None


Model = TypeVar("Model", bound=BaseModel)


def validated(model: type[Model], value: Any, where: str = "") -> Model:
    """A value as a model.

    Raises:
        InputError: it is none; the line names the place, the field, the value and what the field means.
    """
    try:
        return model.model_validate(value)
    except ValidationError as error:
        problem = _described(model, error.errors(include_url=False)[0])
        raise InputError(f"{where}: {problem}" if where else problem) from None


def _described(model: type[BaseModel], error: ErrorDetails) -> str:
    """An error of pydantic on one line."""
    cause, path = error.get("ctx", {}).get("error"), [str(part) for part in error["loc"]]
    problem = str(cause) if isinstance(cause, ValueError) else error["msg"]
    if not path:
        return problem
    if error["type"] == "missing":
        return f"{'.'.join(path)}: it is missing"
    meanings = {field.alias or name: field.description for name, field in model.model_fields.items()}
    if error["type"] == "extra_forbidden":
        return f"{show(path[0])} is no column; they are {', '.join(meanings)}"
    meaning = f" ({meaning.rstrip('.')})" if (meaning := meanings.get(path[0])) else ""
    return f"{'.'.join(path)[:100]}: {show(error['input'])}: {problem}{meaning}"


# What goes out.


class Advice(BaseModel):
    """What a UAV was told last."""

    ID: str
    state: Literal["fly", "hold", "bound", "none"]
    """``fly`` or ``hold`` for a UAV that has chosen in this step, ``bound`` for one that was told so before,
    and ``none`` for one that has not been told anything."""
    lat: float | None = None
    lon: float | None = None
    x: float | None = None
    y: float | None = None
    heading: float | None = None
    """Clockwise from north [deg]; None if it holds."""
    distance: float | None = None
    """Length of the flight [m]."""
    duration: float | None = None
    """Expected duration of the flight [s]."""
    arrival: float | str | None = None
    """When it is expected to land, as of ``written``."""
    step: int | None = None
    """The step in which it chose."""
    age: float
    """Age of its newest report [s]."""

    def place(self) -> Place | None:
        """The landing point."""
        first, second = (self.x, self.y) if self.lat is None else (self.lat, self.lon)
        return None if first is None or second is None else (first, second)


class UavStatus(BaseModel):
    """How the reports of a UAV come in."""

    ID: str
    age: float | None
    """Age of the newest report [s]; None if there is none."""
    lat: float | None = None
    lon: float | None = None
    x: float | None = None
    y: float | None = None
    reports: int
    late: int
    """Those that were older than one that was there."""
    duplicates: int


class FleetStatus(BaseModel):
    """What is known of a fleet."""

    fleet: str
    start: float | str | None
    """When its first step began, as of ``written``; None if it has not begun."""
    step: int
    dt: float
    """Length of a step [s]."""
    uavs: list[UavStatus]


def as_rows(answers: Sequence[BaseModel]) -> list[dict[str, Any]]:
    """Answers as rows of JSON; only the columns of places that were not given are left out."""
    return [answer.model_dump(exclude_unset=True) for answer in answers]


def as_csv(answers: Sequence[BaseModel]) -> str:
    """A CSV table of answers with the same columns; what is not known is ``NA``."""
    text, rows = io.StringIO(), as_rows(answers)
    writer = csv.DictWriter(text, list(rows[0]) if rows else ["ID"], lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _cell(value: Any) -> Any:
    """A cell of a table; spreadsheets would run a text that begins as a formula does."""
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@")):
        return f"'{value}"
    return "NA" if value is None else value


def written(time: float) -> float | str:
    """A time: as a date (ISO 8601, UTC), or in seconds if it does not count from 1970."""
    if time < CALENDAR:
        return round(time, 3)
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
