"""Reads the journal of a fleet: what its UAVs reported, one JSON object on each line.

A service writes it, such as that of ``examples/fleet``; the first line says which fleet it is.
"""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AliasChoices, BaseModel, Field, model_validator

from damian.common.text_files import named, read_text
from damian.field.rows import Place, Report, Time, UavId, parsed_json, validated

SUFFIX = ".jsonl"
"""End of the name of a journal; that of a fleet that has ended is ``.ended``."""


class About(BaseModel):
    """Which policy advises."""

    policy: str | None = None
    checkpoint: str | None = None


class Rules(BaseModel):
    """What of the rules of a fleet counts here."""

    acknowledge: bool = True
    """Whether UAVs follow an answer only once they have accepted it."""


class Head(BaseModel):
    """The first line of a journal."""

    journal: Literal["damian-advice"] = "damian-advice"
    version: Literal[3] = 3
    fleet: str
    uavs: Annotated[list[UavId], Field(min_length=1)]
    about: About
    rules: Rules = Rules()


class Told(BaseModel):
    """An answer to a UAV; it has a place if the UAV is to fly there, or to stay there as the policy chose."""

    id: UavId = Field(validation_alias="ID")
    answer: str = ""
    lat: float | None = None
    lon: float | None = None
    x: float | None = None
    y: float | None = None

    @property
    def place(self) -> Place | None:
        """The place, [deg] or [m]."""
        first, second = (self.x, self.y) if self.lat is None else (self.lat, self.lon)
        return None if first is None or second is None else (first, second)


class Acknowledged(BaseModel):
    """What a UAV does with an answer."""

    answer: str
    status: str


class Line(BaseModel):
    """Any other line, as far as it tells what was reported, and where UAVs were sent."""

    time: Time = Field(validation_alias=AliasChoices("received", "asked"))
    """When it was written [s]."""
    reports: list[Report] = []
    """Reports that came in then."""
    advice: list[Told] = []
    """What UAVs were told then."""
    acknowledged: list[Acknowledged] = []
    """What UAVs do with what they were told."""
    outdated: list[int] = []
    """Which of these accept what was not safe any more."""
    join: list[UavId] = []
    """UAVs that join with their first reports."""
    leave: list[UavId] = []
    """UAVs that leave."""

    @model_validator(mode="after")
    def _stamp(self) -> "Line":
        for report in self.reports:
            report.stamp(self.time)
        return self


def read_journal(path: Path) -> tuple[Head, list[tuple[int, Line]]]:
    """The first line of a journal, and the others with their numbers; an unfinished last one is left out."""
    with named(path):
        first, *others = read_text(path).rpartition("\n")[0].split("\n")
        head = validated(Head, parsed_json(first), "line 1")
        return head, [
            (n, validated(Line, parsed_json(text), f"line {n}")) for n, text in enumerate(others, 2)
        ]
