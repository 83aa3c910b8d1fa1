"""What the service tells UAVs and what they say of it, as pydantic models; and what is known of a fleet."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import pandas as pd
from pydantic import BaseModel, BeforeValidator, Field

from damian.common.errors import InputError
from damian.field.rows import Found, Row, Rows, UavId, column_of, validated


class Acknowledgement(Row):
    """What a UAV does with an answer."""

    id: UavId
    answer: Annotated[str, Field(max_length=64)]
    """ID of the answer."""
    status: Annotated[
        Literal["accepted", "refused", "taken off", "landed", "aborted"],
        BeforeValidator(lambda value: column_of(value) if isinstance(value, str) else value),
    ]


REASONS = ("silent", "battery", "held", "returning", "home", "aborted", "lost", "conflict")
"""Why a UAV is not told what the policy chooses: its newest report is too old; its battery is below the
reserve, would be after the flight, or was never reported; a person holds it or sends it home; it is there; it
has aborted a flight, or its flight is long over, without a report since; another UAV is in its way."""


class Advice(BaseModel):
    """What a UAV was told last."""

    answer: str | None = None
    """ID of the answer, for its acknowledgement."""
    ID: str
    state: Literal["fly", "hold", "return", "bound", "none"]
    """``fly``, ``hold`` or ``return`` for an answer that waits for its acceptance (without acknowledgements:
    of this step), ``bound`` for one that the UAV follows, and ``none`` if there is none."""
    reason: str | None = None
    """Why the policy was not followed, one of ``REASONS``."""
    lat: float | None = None
    lon: float | None = None
    x: float | None = None
    y: float | None = None
    altitude: float | None = None
    """Flight level above the takeoff point [m]; None if it holds."""
    speed: float | None = None
    """Mean speed of the cruise, by which it arrives as expected [m/s]."""
    heading: float | None = None
    """Clockwise from north [deg]; None if it holds."""
    distance: float | None = None
    """Length of the flight [m]."""
    duration: float | None = None
    """Expected duration of the flight [s]."""
    arrival: float | str | None = None
    """When it is expected to land, as of ``written``."""
    until: float | str | None = None
    """By when it must be accepted, and of one that is followed, until when the landing point is booked."""
    step: int | None = None
    """The step in which it chose."""
    age: float
    """Age of its newest report [s]."""


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
    command: Literal["", "hold", "return"] = ""
    """What a person has told the UAV to do."""
    order: str | None = None
    """How far its latest answer has come, such as ``accepted``."""


class FleetStatus(BaseModel):
    """What is known of a fleet."""

    fleet: str
    start: float | str | None
    """When its first step began, as of ``written``; None if it has not begun."""
    step: int
    dt: float
    """Length of a step [s]."""
    uavs: list[UavStatus]


def acknowledgements_of(found: Found) -> list[Acknowledgement]:
    """Rows as acknowledgements."""
    if not found:
        raise InputError("there are no rows")
    return [validated(Acknowledgement, row, where) for where, row in found]


def ignored(rows: Rows) -> list[str]:
    """Names of the columns that are not understood."""
    return sorted({name for _, report in rows for name in report.model_extra or ()})


def as_rows(answers: Sequence[BaseModel]) -> list[dict[str, Any]]:
    """Answers as rows of JSON; only the columns of places that were not given are left out."""
    return [answer.model_dump(exclude_unset=True) for answer in answers]


def as_csv(answers: Sequence[BaseModel]) -> str:
    """A CSV table of answers with the same columns; what is not known is ``NA``."""
    rows = as_rows(answers)
    table = pd.DataFrame(rows, columns=list(rows[0]) if rows else ["ID"], dtype=object)
    return table.to_csv(index=False, na_rep="NA", lineterminator="\n")
