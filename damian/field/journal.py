"""Reads the journal of a fleet: what its UAVs reported, one JSON object on each line.

A service writes it, such as that of ``examples/fleet``; the first line says which fleet it is.
"""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AliasChoices, BaseModel, Field, model_validator

from damian.common.errors import InputError
from damian.common.text_files import named
from damian.field.rows import Report, Time, UavId, parsed_json, validated

SUFFIX = ".jsonl"
"""End of the name of a journal; that of a fleet that has ended is ``.ended``."""


class About(BaseModel):
    """Which policy advises by which settings."""

    policy: str | None = None
    checkpoint: str | None = None
    overrides: list[str] = []
    """Words of the command line."""


class Head(BaseModel):
    """The first line of a journal."""

    journal: Literal["damian-advice"] = "damian-advice"
    version: Literal[3] = 3
    fleet: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
    uavs: Annotated[list[UavId], Field(min_length=1, max_length=100)]
    about: About

    @model_validator(mode="after")
    def _distinct(self) -> "Head":
        if len({*self.uavs}) < len(self.uavs):
            raise ValueError(f"uavs: {', '.join(self.uavs)}: a UAV appears twice")
        return self


class Line(BaseModel):
    """Any other line, as far as it tells what was reported; what UAVs were told is left out."""

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


def read_head(path: Path) -> Head:
    """The first line of a journal."""
    with named(path):
        return validated(Head, parsed_json(_texts(path, 1)[0]), "line 1")


def read_lines(path: Path) -> Iterator[tuple[int, Line]]:
    """The lines after the first one, with their numbers; an unfinished one at the end is left out."""
    with named(path):
        texts = _texts(path)
    for number, text in enumerate(texts[1:], 2):
        with named(f"{path}: line {number}"):
            line = validated(Line, parsed_json(text))
        yield number, line


def _texts(path: Path, most: int | None = None) -> list[bytes]:
    """The whole lines of a file, or the first ``most`` ones."""
    try:
        with path.open("rb") as file:
            *lines, _ = b"".join(islice(file, most)).split(b"\n")
    except OSError as error:
        raise InputError(f"it cannot be read: {error.strerror}") from None
    if not lines:
        raise InputError("it is empty")
    return lines
