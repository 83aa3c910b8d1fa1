"""Reads the journal of a fleet: what its UAVs reported, one JSON object on each line.

A service writes it, such as that of ``examples/fleet``; the first line says which fleet it is.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AliasChoices, BaseModel, Field, model_validator

from damian.common.text_files import named, read_text
from damian_fleet.reports import Report, Time, UavId, parsed_json, validated


class Head(BaseModel):
    """The first line of a journal."""

    journal: Literal["damian-advice"] = "damian-advice"
    version: Literal[3] = 3
    fleet: str
    uavs: Annotated[list[UavId], Field(min_length=1)]
    about: dict[str, Any]
    """Which policy advises."""


class Line(BaseModel):
    """Any other line, as far as it tells who belongs to the fleet, and what was reported."""

    time: Time = Field(validation_alias=AliasChoices("received", "asked"))
    """When it was written [s]."""
    reports: list[Report] = []
    """Reports that came in then."""
    join: list[UavId] = []
    """UAVs that join with their first reports."""
    leave: list[UavId] = []
    """UAVs that leave."""

    @model_validator(mode="after")
    def _stamp(self) -> "Line":
        for report in self.reports:
            report.stamp(self.time)
        return self


def read_journal(path: Path) -> tuple[Head, list[tuple[str, Line]]]:
    """The first line of a journal, and the others with their places, but for an unfinished last
    one."""
    with named(path):
        first, *others = read_text(path).rpartition("\n")[0].split("\n")
        head = validated(Head, parsed_json(first), "line 1")
        return head, [
            (f"{path}: line {n}", validated(Line, parsed_json(text), f"line {n}"))
            for n, text in enumerate(others, 2)
        ]
