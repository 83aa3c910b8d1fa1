"""The journal of a fleet: every report and every advice, one JSON object on each line.

A line is handed to the operating system before its request is answered, so that nothing that was acknowledged
is lost if the process is killed at any time. The first line says which fleet it is.
"""

import os
import re
import secrets
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Annotated, BinaryIO, Literal

from pydantic import BaseModel, Field, model_validator

from damian.common.atomic_files import writing
from damian.common.errors import InputError
from damian.common.text_files import named
from damian.field.rows import Number, Report, Time, UavId, parsed_json, validated
from damian_fleet.answers import Acknowledgement, Advice

SUFFIX = ".jsonl"
BLOCK, MAX_LINE = 1 << 16, 1_000_000
"""Bytes that are read at a time from the end of a journal; of a line, about as many as a request has."""


class About(BaseModel):
    """Which policy advises by which settings."""

    policy: str | None = None
    checkpoint: str | None = None
    overrides: list[str] = []


class Head(BaseModel):
    """The first line of a journal."""

    journal: Literal["damian-advice"] = "damian-advice"
    version: Literal[3] = 3
    fleet: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
    uavs: Annotated[list[UavId], Field(min_length=1, max_length=100)]
    about: About
    ground: str = ""
    """Stands for the landing points."""
    rules: dict[str, bool | float] = {}
    """Settings of ``FieldRules``."""
    mark: str = Field(default_factory=lambda: secrets.token_hex(3))
    """Begins the IDs of the answers, so that those of an earlier fleet of this name are told apart."""

    @model_validator(mode="after")
    def _distinct(self) -> "Head":
        if len({*self.uavs}) < len(self.uavs):
            raise ValueError(f"uavs: {', '.join(self.uavs)}: a UAV appears twice")
        return self


class Received(BaseModel):
    """A line about reports that came in together."""

    received: Time
    reports: list[Report]

    @model_validator(mode="after")
    def _stamp(self) -> "Received":
        for report in self.reports:
            report.stamp(self.received)
        return self


class Advised(BaseModel):
    """A line about UAVs that have chosen and were told so."""

    asked: Time
    told: dict[str, int | tuple[Number, Number] | tuple[Literal["hold", "return"], str]]
    """Their actions, by ID; for those that could not be left to the policy, what they do instead, and why."""
    advice: list[Advice] = []
    """What they were told."""


class Acknowledged(BaseModel):
    """A line about what UAVs do with their answers."""

    received: Time
    acknowledged: list[Acknowledgement]
    outdated: list[int] = []
    """Which of them accept what was not safe any more."""


class Command(BaseModel):
    """What a person tells UAVs to do, all of them if ``uavs`` is not given."""

    command: Literal["hold", "resume", "return"]
    uavs: list[UavId] | None = None


class Commanded(Command):
    received: Time


class Change(BaseModel):
    """UAVs that join with their first reports, and UAVs that leave now."""

    join: list[UavId] = []
    leave: list[UavId] = []


class Members(Change):
    received: Time


Line = Received | Advised | Acknowledged | Commanded | Members
KINDS: dict[str, type[Line]] = {
    "reports": Received,
    "told": Advised,
    "acknowledged": Acknowledged,
    "command": Commanded,
    "join": Members,
}
"""Kinds of lines by the entry that only they have."""


class Journal:
    """A journal to append to; an unfinished last line, which a killed process leaves, is removed.

    Its file is open only while a line is written, so that thousands of fleets need no file handles.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            self.end = path.stat().st_size if path.exists() else 0
            """Where the whole lines end [bytes]."""
            if self.end:
                with path.open("rb") as file:
                    whole = 0
                    while self.end and not (whole := _before(file, self.end).rfind(b"\n") + 1):
                        self.end = max(self.end - BLOCK, 0)
                    self.end = max(self.end - BLOCK, 0) + whole if self.end else 0
                os.truncate(path, self.end)

    def append(self, line: Head | Line) -> None:
        """Write a line, or nothing of it if that fails (``RunError``)."""
        text = line.model_dump_json(by_alias=True, exclude_none=True).encode() + b"\n"
        with writing(self.path):
            file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
            try:
                os.ftruncate(file, self.end)  # what is left of a line that could not be written
                if os.write(file, text) != len(text):
                    raise OSError(None, "the disk is full")
            finally:
                os.close(file)
            self.end += len(text)

    def last_time(self) -> float:
        """When the last line was written [s since 1970]; 0 if only the first one is there."""
        with writing(self.path), self.path.open("rb") as file:
            text = b""
            for most in (BLOCK, 2 * MAX_LINE):
                *_, before, text, _ = [b"", b"", *_before(file, self.end, most).split(b"\n")]
                if before:  # the line is whole
                    break
        found = re.search(rb'"(?:received|asked)":([0-9.e+]+)', text)
        return float(found[1]) if found else 0.0


def _before(file: BinaryIO, end: int, most: int = BLOCK) -> bytes:
    """What stands in a file before a place, up to ``most`` bytes."""
    first = max(end - most, 0)
    file.seek(first)
    return file.read(end - first)


def read_head(path: Path) -> Head:
    """The first line of a journal."""
    with named(path):
        return validated(Head, parsed_json(_texts(path, 1)[0]), "line 1")


def read_lines(path: Path, start: int = 0) -> Iterator[tuple[int, Line]]:
    """The lines after the first one, with their numbers; an unfinished one at the end is left out.

    With ``start`` [bytes], only those from there on; their numbers count from there.
    """
    with named(path):
        texts = _texts(path, start=start)
    for number, text in enumerate(texts if start else texts[1:], 1 if start else 2):
        with named(f"{path}: line {number}"):
            found = parsed_json(text)
            kind = next((kind for name, kind in KINDS.items() if name in found), Members)
            line = validated(kind, found)
        yield number, line


def _texts(path: Path, most: int = -1, start: int = 0) -> list[bytes]:
    """The whole lines of a file from a place on, or the first ``most`` ones."""
    try:
        with path.open("rb") as file:
            file.seek(start)
            *lines, _ = (file.read() if most < 0 else b"".join(islice(file, most))).split(b"\n")
    except OSError as error:
        raise InputError(f"it cannot be read: {error.strerror}") from None
    if not lines and not start:
        raise InputError("it is empty")
    return lines
