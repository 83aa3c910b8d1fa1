"""Rows of tables as pydantic models: reports that come in, as CSV and JSON.

Columns of a report may be written in any case, and with ``_`` for a space. ``NA``, an empty cell
and null mean that the value is not known.
"""

import math
from collections.abc import Hashable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

from pydantic import (
    AliasChoices,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)
from pydantic_core import from_json

from damian.common.errors import InputError
from damian.common.text_files import parse_table, read_text, show
from damian.delays.logs import LATEST, UNKNOWN, column_of, seconds_of

DEGREES, METRES = ("lat", "lon"), ("x", "y")
"""Columns of a place: latitude and longitude [deg], or over a region without a place on Earth x and
y [m]."""
Place = tuple[float, float]
"""A place in the columns that its row has."""

GROUND = 0.5
"""Altitude up to which a UAV whose motors do not turn stands on the ground [m]."""
CALENDAR = 1e8
"""From this time on [s], times count from 1970 and are written as dates."""


def _below(limit: float, problem: str) -> BeforeValidator:
    """Refuse numbers of another unit, which are far out of range."""

    def check(value: Any) -> Any:
        try:
            far = abs(float(value)) >= limit
        except (TypeError, ValueError):
            return value
        if far:
            raise ValueError(problem)
        return value

    return BeforeValidator(check)


def _text_split_at(separator: str | None) -> BeforeValidator:
    return BeforeValidator(
        lambda value: value.split(separator) if isinstance(value, str) else value
    )


_listed = BeforeValidator(lambda value: [value] if isinstance(value, int | float) else value)
FOREIGN = {
    "latitude": ("lat", "[deg]"),
    "longitude": ("lon", "[deg]"),
    "latitude deg": ("lat", "[deg] (ulog)"),
    "longitude deg": ("lon", "[deg] (ulog)"),
    "datetime(utc)": ("time", "in ISO 8601 or seconds since 1970 (AirData, Litchi)"),
    "time(millisecond)": (
        "time",
        "in ISO 8601 or seconds since 1970, as datetime(utc) of AirData and Litchi",
    ),
    "timestamp": ("time", "[s since 1970]; that of ulog counts microseconds since the boot"),
    "header.stamp": ("time", "[s since 1970], 1e-9 times that of MAVROS"),
    "height above takeoff(feet)": ("fla", "[m], 0.3048 times the feet (AirData)"),
    "altitude(feet)": ("fla", "[m], 0.3048 times the feet (Litchi)"),
    "altitude(m)": ("fla", "[m] (Litchi)"),
    "battery percent": ("battery", "[%] (AirData)"),
    "remainpowerpercent": ("battery", "[%] (Litchi)"),
    "remaining": ("battery", "[%], 100 times that of ulog"),
    "percentage": ("battery", "[%], 100 times that of MAVROS"),
}
"""Columns of common logs: which column says the same here, and in which unit."""
Number: TypeAlias = Annotated[float, Field(allow_inf_nan=False)]
_of_a_clock = _below(1e11, "give seconds, not milliseconds or microseconds")
_dated = BeforeValidator(lambda value: seconds_of(value) if isinstance(value, str) else value)
Time: TypeAlias = Annotated[float, Field(ge=0, le=LATEST), _dated, _of_a_clock]
"""A time [s], as a number or as ISO 8601."""
Count: TypeAlias = Annotated[int, Field(ge=0, le=2**31)]
Flag: TypeAlias = Annotated[
    bool,
    BeforeValidator(lambda value: value.removesuffix(".0") if isinstance(value, str) else value),
]
"""True or false; a table of numbers in which a cell is empty has 1.0 for 1."""
_degrees = _below(1e5, "give degrees, not degrees times 10^7, as MAVLink and ulog have them")
Latitude: TypeAlias = Annotated[Number, Field(ge=-90, le=90), _degrees]
Longitude: TypeAlias = Annotated[Number, Field(ge=-180, le=180), _degrees]
Coordinate: TypeAlias = Annotated[Number, Field(ge=-2e7, le=2e7)]
Pair: TypeAlias = Annotated[tuple[Coordinate, Coordinate], _text_split_at(None)]
UavId: TypeAlias = Annotated[str, Field(pattern=r"^\w[\w .:/-]{0,63}$")]
"""ID of a UAV; it begins with a letter, digit or ``_``, so that no spreadsheet takes it for a
formula."""


class Row(BaseModel):
    """A row of a table: the names of its fields, with a space for ``_``, are the columns.

    Other columns are kept in ``model_extra``, so that telemetry can be forwarded as it is.
    """

    model_config = ConfigDict(
        str_strip_whitespace=True,
        coerce_numbers_to_str=True,
        extra="allow",
        alias_generator=lambda name: name.replace("_", " "),
    )

    @model_validator(mode="before")
    @classmethod
    def _columns(cls, row: Any) -> Any:
        """A row by its columns, without unknown values."""
        if not isinstance(row, Mapping):
            return row
        known = {
            name: cell for name, cell in row.items() if str(cell).strip().lower() not in UNKNOWN
        }
        return {column_of(str(name)): cell for name, cell in known.items()}


class Report(Row):
    """What a UAV reports; None where it does not say. Journals keep the columns of tables."""

    id: UavId
    received: Time = Field(alias="receive time", exclude=True, default_factory=lambda: math.nan)
    """When it came in [s]; a column of files only."""
    aoi: Annotated[Number, Field(ge=0, le=LATEST)] = 0.0
    """Age of the observation when it came in [s], if there is no time."""
    time: Time = Field(default_factory=lambda: math.nan)
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
    """Flight altitude [m]: above 0.5 in flight, or above 0 while the motors turn."""
    on_ground: Flag | None = None
    """Whether the UAV stands on the ground, as its autopilot says."""
    motors: Flag | None = None
    """Whether its motors turn: whether it is armed."""
    target_lat: Latitude | None = None
    """Landing point to which it flies."""
    target_lon: Longitude | None = None
    target_x: Coordinate | None = None
    target_y: Coordinate | None = None
    previous: Annotated[tuple[Pair, ...], Field(max_length=16), _text_split_at(";")] | None = None
    """Landing points where it was before, newest first: [[53.1, -4.5]], or 53.1 -4.5; 53.2 -4.5."""
    landed: (
        Annotated[tuple[Time, ...], Field(max_length=17), _text_split_at(";"), _listed] | None
    ) = None
    """Times at which it landed, or held, where it is and at the places of ``previous`` [s]."""
    motions: Count | None = None
    """Decisions (holding included) since it last detected the source before."""
    readings: Annotated[tuple[Number, ...], Field(max_length=1000), _text_split_at(";")] | None = (
        None
    )
    """Readings of sensors of your own."""
    sequence: Count | None = Field(None, validation_alias=AliasChoices("sequence", "number"))
    """Number of the report, which grows by one."""

    @property
    def columns(self) -> tuple[str, str]:
        """The columns of its places."""
        return METRES if self.lat is None else DEGREES

    @property
    def flies(self) -> bool:
        """Whether the UAV is in the air: its autopilot knows; else motors and altitude tell."""
        if self.on_ground is not None:
            return not self.on_ground
        return self.fla is not None and self.fla > (0.0 if self.motors else GROUND)

    @property
    def identity(self) -> Hashable:
        """Two reports with equal identities are one: its number and time, or else its whole
        content."""
        if self.sequence is not None:
            return self.sequence, self.time if "time" in self.model_fields_set else None
        return self.model_dump_json(exclude_none=True)

    def place(self, prefix: str = "") -> Place | None:
        """Where the UAV is; ``source_``: where it detected the source; ``target_``: where it
        flies."""
        first, second = (getattr(self, prefix + name) for name in self.columns)
        return None if first is None else (first, second)

    def stamp(self, now: float, file: bool = False) -> None:
        """Set the times that the report leaves open; only one from a ``file`` may say when it came
        in."""
        said = self.model_fields_set
        if "received" in said and not file:
            raise InputError(
                "receive time: only a table has it; the service looks at its own clock"
            )
        if "received" not in said:
            self.received = self.time + self.aoi if file and "time" in said else now
        if "time" not in said:
            self.time = self.received - self.aoi
            said.discard("time")  # it is not what the UAV says

    def check_places(self) -> None:
        """Require pairs of coordinates, of one kind, and the UAV's own place."""
        said = self.model_fields_set
        prefixes = ("", "source_", "target_")
        others = METRES if self.columns == DEGREES else DEGREES
        pairs = [{f"{prefix}{name}" in said for name in self.columns} for prefix in prefixes]
        mixed = any(f"{prefix}{name}" in said for prefix in prefixes for name in others)
        if mixed or pairs[0] != {True} or any(len(pair) > 1 for pair in pairs):
            raise InputError(
                "places are pairs lat, lon [deg], or all of them x, y [m]; the UAV's is needed"
            )
        if True in pairs[1] and self.source_time is None and not self.source_spotted:
            raise InputError(
                "source time: it is missing: when the source was detected at this place [s]"
            )


Found = list[tuple[str, Any]]
"""Rows, each with its place in the text (``line 2``)."""
Rows = list[tuple[str, Report]]


def read_file(path: Path) -> Rows:
    """Reports of a file: JSON if its name ends with ``.json``, or else CSV."""
    text = read_text(path)
    return reports_of(rows_of_json(text) if path.suffix.lower() == ".json" else rows_of_csv(text))


def rows_of_csv(text: str) -> Found:
    """Rows of a CSV table, of any kind."""
    return [(f"line {row.line}", row.cells) for row in parse_table(text, [])]


def rows_of_json(text: str | bytes) -> Found:
    """Rows of JSON, an object or a list of objects, of any kind."""
    found = parsed_json(text)
    return [
        (f"row {n}", row) for n, row in enumerate(found if isinstance(found, list) else [found], 1)
    ]


def reports_of(found: Found) -> Rows:
    """Rows as reports."""
    if not found:
        raise InputError("there are no rows")
    reports = [(where, validated(Report, row, where)) for where, row in found]
    for where, report in reports:
        for column in report.model_extra or ():
            own, unit = FOREIGN.get(column.removeprefix("field."), ("", ""))
            if own and own not in report.model_fields_set:
                raise InputError(f"{where}: {column}: it is not a column here: give {own} {unit}")
    return reports


def parsed_json(text: str | bytes) -> Any:
    """Parse JSON, without NaN and Infinity."""
    try:
        return from_json(text, allow_inf_nan=False)
    except ValueError as error:
        raise InputError(f"it is not JSON: {error}") from None


Model = TypeVar("Model", bound=BaseModel)


def validated(model: type[Model], value: Any, where: str = "") -> Model:
    """A value as a model."""
    try:
        return model.model_validate(value)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(map(str, first["loc"]))
        shown = show(first["input"])
        parts = [where, field, shown if field and first["type"] != "missing" else "", first["msg"]]
        raise InputError(": ".join(filter(None, parts))) from None


def written(time: float) -> float | str:
    """A time: as a date (ISO 8601, UTC), or in seconds if it does not count from 1970."""
    if time < CALENDAR:
        return round(time, 3)
    return (
        datetime.fromtimestamp(time, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    )
