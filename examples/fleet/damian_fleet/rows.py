"""What UAVs and persons say to the service, and what it answers, as pydantic models."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from damian.delays.logs import column_of
from damian_fleet.reports import Latitude, Longitude, Row, UavId

MOST_UAVS = 100
"""Most UAVs of a fleet."""
MOST_ROWS = 500
"""Most rows of a request: so many take some tenths of a second, for which others wait."""
BridgeId = Annotated[str, Field(max_length=64)]
"""Tells a bridge from all others; empty for a client that is none."""
_plain = BeforeValidator(lambda value: column_of(value) if isinstance(value, str) else value)


class Acknowledgement(Row):
    """What a UAV does with the answer of this ID."""

    id: UavId
    answer: Annotated[str, Field(max_length=64)]
    status: Annotated[Literal["accepted", "refused", "taken off", "landed", "aborted"], _plain]
    bridge: BridgeId = ""


class Speaker(Row):
    """Who reports for a UAV: its bridge, and the identity of the autopilot behind that."""

    id: UavId
    bridge: BridgeId = ""
    vehicle: BridgeId = ""


class Place(BaseModel):
    """A place [deg], or over a region without a place on Earth [m]."""

    model_config = ConfigDict(allow_inf_nan=False)
    lat: Latitude | None = None
    lon: Longitude | None = None
    x: float | None = None
    y: float | None = None


class Advice(Place):
    """What a UAV was told; all but ``state`` and ``age`` stays the same for one ID ``answer``.

    ``state`` is ``fly``, ``hold`` or ``return`` for an answer that waits for acceptance, ``bound``
    for one that the UAV follows, and ``none`` if there is none; ``reason`` says why the policy was
    not followed. The place is the landing point, ``altitude`` the flight level above the takeoff
    point [m], ``speed`` that of the cruise [m/s], ``heading`` clockwise from north [deg],
    ``distance`` [m] and ``duration`` [s] those of the flight, ``until`` when it must be accepted
    by, ``age`` that of the newest report [s].
    """

    answer: str | None
    ID: str
    state: Literal["fly", "hold", "return", "bound", "none"]
    reason: str | None = None
    altitude: float | None = Field(None, gt=0, le=1000)
    speed: float | None = Field(None, gt=0)
    heading: float | None = None
    distance: float | None = None
    duration: float | None = Field(None, ge=0)
    arrival: float | str | None = None
    until: float | str | None = None
    step: int | None = None
    age: float | None = None


class UavStatus(Place):
    """Where a UAV was by its newest report, the age of that [s], its battery [%], how many reports
    came, and how many twice, what a person has told it, how far its latest answer has come, and
    what it is told now."""

    ID: str
    age: float | None
    flies: bool | None = None
    battery: float | None = None
    reports: int
    duplicates: int
    command: Literal["", "hold", "return"]
    order: str | None
    advice: Advice


class FleetStatus(BaseModel):
    """What is known of a fleet; its steps have a length of ``dt`` [s]; ``start`` is None until it
    begins."""

    start: float | str | None
    step: int
    dt: float
    uavs: list[UavStatus]


class Body(BaseModel):
    """What a request says; nothing else is understood."""

    model_config = ConfigDict(extra="forbid")


class Members(Body):
    """The UAVs of a fleet to create or find."""

    uavs: Annotated[list[UavId], Field(min_length=1, max_length=MOST_UAVS)]

    @model_validator(mode="after")
    def _distinct(self) -> "Members":
        if len({*self.uavs}) < len(self.uavs):
            raise ValueError("a UAV appears twice")
        return self


class Asking(Body):
    """The UAVs that ask for advice."""

    uavs: list[UavId]
    bridge: BridgeId = ""


class Command(Body):
    """What a person tells UAVs to do, all of them if ``uavs`` is not given."""

    command: Literal["hold", "resume", "return"]
    uavs: list[UavId] | None = None


class Change(Body):
    """UAVs that join with their first reports, and UAVs that leave now; what is so already stays
    so."""

    join: list[UavId] = []
    leave: list[UavId] = []
    bridge: BridgeId | None = None
    """The bridge that says so; None for a person."""


def said_by(row: Row) -> dict[str, Any]:
    """What a row says, as its columns; what is not understood is left out."""
    (row.model_extra or {}).clear()
    return row.model_dump(mode="json", by_alias=True, exclude_unset=True, exclude_none=True)
