"""The journal of a fleet: every report and every advice, one JSON object on each line.

A line is handed to the operating system before its request is answered, so that nothing that was acknowledged
is lost if the process is killed at any time. The first line says which fleet it is.

A further kind of request that changes a fleet, such as an acknowledgement, needs a model of its line here (in
``KINDS``), and a place in ``replay`` (``session.py``), which does again what the line says.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field, model_validator

from damian.advice.rows import Advice, Number, Report, Time, Uavs, parsed_json, validated
from damian.common.atomic_files import writing
from damian.common.errors import InputError
from damian.common.text_files import named

SUFFIX = ".jsonl"
FleetName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]


class About(BaseModel):
    """Which policy advises by which settings."""

    policy: str | None = None
    checkpoint: str | None = None
    overrides: list[str] = []


class Head(BaseModel):
    """The first line of a journal."""

    journal: Literal["damian-advice"] = "damian-advice"
    version: Literal[1] = 1
    fleet: FleetName
    uavs: Uavs
    about: About


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
    told: dict[str, int | tuple[Number, Number]]
    """Their actions, by ID."""
    advice: list[Advice] = []
    """What they were told."""


Line = Received | Advised
KINDS: dict[str, type[Line]] = {"reports": Received, "told": Advised}
"""The lines after the first one, by a key that no other kind has."""


class Journal:
    """A journal that can be appended to.

    Args:
        path: its file; an unfinished line at its end, which a killed process leaves, is removed.
        durable: make every line last even if the machine stops, which takes milliseconds.

    Raises:
        RunError: the file cannot be written.
    """

    def __init__(self, path: Path, durable: bool = False) -> None:
        self.path, self._durable = path, durable
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
            size = path.stat().st_size
            self._end = path.read_bytes().rfind(b"\n") + 1
            self._torn = self._end < size
            self._cut()

    def append(self, line: Head | Line) -> None:
        """Write a line.

        Raises:
            RunError: it cannot be written, such as on a full disk; nothing of it is left.
        """
        text = line.model_dump_json(by_alias=True, exclude_none=True).encode() + b"\n"
        with writing(self.path):
            self._cut()
            self._torn = True
            try:
                if os.write(self._file, text) != len(text):
                    raise OSError(None, "the disk is full")
                if self._durable:
                    os.fsync(self._file)
            except OSError:
                self._cut()
                raise
            self._end, self._torn = self._end + len(text), False

    def _cut(self) -> None:
        """Remove what is left of a line that could not be written."""
        if self._torn:
            os.ftruncate(self._file, self._end)
            self._torn = False

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)


def read_head(path: Path) -> Head:
    """The first line of a journal.

    Raises:
        InputError: it is no journal of this version, or the line is damaged.
    """
    with named(path):
        first, *_ = _texts(path)
        return validated(Head, parsed_json(first, "line 1"), "line 1: it does not begin a journal")


def read_lines(path: Path) -> Iterator[tuple[int, Line]]:
    """The lines after the first one, with their numbers; an unfinished one at the end is left out.

    Raises:
        InputError: the file cannot be read, or a line is damaged.
    """
    with named(path):
        for number, text in enumerate(_texts(path)[1:], 2):
            where = f"line {number}"
            found = parsed_json(text, where)
            kind = next((KINDS[key] for key in KINDS if isinstance(found, dict) and key in found), None)
            if kind is None:
                raise InputError(f"{where}: it is damaged: it has none of {', '.join(KINDS)}")
            yield number, validated(kind, found, f"{where}: it is damaged")


def _texts(path: Path) -> list[bytes]:
    try:
        *lines, _ = path.read_bytes().split(b"\n")
    except OSError as error:
        raise InputError(f"it cannot be read: {error.strerror}") from None
    if not lines:
        raise InputError("it is empty")
    return lines
