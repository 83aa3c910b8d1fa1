"""The journal of a fleet: every report and every advice, one JSON object on each line.

A line is handed to the operating system before its request is answered, so that nothing that was acknowledged
is lost if the process is killed at any time. The first line says which fleet it is.
"""

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from damian.advice.reports import LATEST, Report, read_rows
from damian.advice.tables import checked_rows, no_constant
from damian.common.atomic_files import writing
from damian.common.errors import InputError
from damian.common.text_files import named, one_line, show

FORMAT, VERSION = "damian-advice", 1
SUFFIX = ".jsonl"


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

    def append(self, entry: dict[str, Any]) -> None:
        """Write a line.

        Raises:
            RunError: it cannot be written, such as on a full disk; nothing of it is left.
        """
        line = json.dumps(entry, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        with writing(self.path):
            self._cut()
            self._torn = True
            try:
                if os.write(self._file, line) != len(line):
                    raise OSError(None, "the disk is full")
                if self._durable:
                    os.fsync(self._file)
            except OSError:
                self._cut()
                raise
            self._end, self._torn = self._end + len(line), False

    def _cut(self) -> None:
        """Remove what is left of a line that could not be written."""
        if self._torn:
            os.ftruncate(self._file, self._end)
            self._torn = False

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)


def entries(path: Path) -> Iterator[dict[str, Any]]:
    """The lines of a journal, its head first; an unfinished line at its end is left out.

    Raises:
        InputError: it is no journal of this version, or a line is damaged.
    """
    with named(path):
        try:
            text = path.read_bytes()
        except OSError as error:
            raise InputError(f"it cannot be read: {error.strerror}") from None
        *lines, _ = text.split(b"\n")
        for number, line in enumerate(lines, 1):
            entry = _parsed(line, number)
            if number == 1 and (entry.get("journal"), entry.get("version")) != (FORMAT, VERSION):
                raise InputError(f"line 1: it is no journal of damian advise of version {VERSION}")
            if number == 1 and not isinstance(entry.get("fleet"), str):
                raise InputError("line 1: it is damaged: the name of the fleet is missing")
            yield entry
        if not lines:
            raise InputError("it is empty")


def _parsed(line: bytes, number: int) -> dict[str, Any]:
    try:
        entry = json.loads(line, parse_constant=no_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"line {number}: it is damaged: {one_line(str(error))[:200]}") from None
    if not isinstance(entry, dict):
        raise InputError(f"line {number}: it is no object")
    for name in ("received", "asked"):
        value = entry.get(name)
        if isinstance(value, int | float) and not _is_time(value):
            raise InputError(f"line {number}: it is damaged: {name}: {show(value)} is not a time [s]")
    return entry


def _is_time(value: Any) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(value) <= LATEST  # which NaN is not


def reports_of(entry: Mapping[str, Any]) -> tuple[float, list[Report]]:
    """When the reports of a line came in [s], and the reports.

    Raises:
        InputError: the line is damaged.
    """
    received, found = entry.get("received"), entry.get("reports")
    if not _is_time(received) or not isinstance(found, list):
        raise InputError("it is damaged: no reports, or no time at which they came in")
    rows = checked_rows([(f"row {n}", row) for n, row in enumerate(found, 1)])
    return cast(float, received), read_rows(rows, cast(float, received), file=False)


def head(name: str, uavs: list[str], about: dict[str, Any]) -> dict[str, Any]:
    """The first line of a journal."""
    return {"journal": FORMAT, "version": VERSION, "fleet": name, "uavs": uavs, "about": about}
