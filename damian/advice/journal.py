"""The journal of a fleet: every report and every advice, one JSON object on each line.

A line is handed to the operating system before its request is answered, so that nothing that was acknowledged
is lost if the process is killed at any time. The first line says which fleet it is.
"""

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from damian.advice.reports import LATEST, Report, read_rows
from damian.advice.tables import checked_rows
from damian.common.atomic_files import writing
from damian.common.errors import InputError
from damian.common.text_files import named, one_line

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
            kept = path.read_bytes().rfind(b"\n") + 1
            if kept < size:
                os.ftruncate(self._file, kept)

    def append(self, entry: dict[str, Any]) -> None:
        """Write a line.

        Raises:
            RunError: it cannot be written, such as on a full disk; nothing of it is left.
        """
        line = json.dumps(entry, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        with writing(self.path):
            size = os.fstat(self._file).st_size
            if os.write(self._file, line) != len(line):
                os.ftruncate(self._file, size)
                raise OSError(None, "the disk is full")
            if self._durable:
                os.fsync(self._file)

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
            yield entry
        if not lines:
            raise InputError("it is empty")


def _parsed(line: bytes, number: int) -> dict[str, Any]:
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise InputError(f"line {number}: it is damaged: {one_line(str(error))[:200]}") from None
    if not isinstance(entry, dict):
        raise InputError(f"line {number}: it is no object")
    return entry


def reports_of(entry: Mapping[str, Any]) -> tuple[float, list[Report]]:
    """When the reports of a line came in [s], and the reports.

    Raises:
        InputError: the line is damaged.
    """
    received, found = entry.get("received"), entry.get("reports")
    if not isinstance(received, int | float) or not isinstance(found, list) or abs(received) > LATEST:
        raise InputError("it is damaged: no reports, or no time at which they came in")
    rows = checked_rows([(f"row {n}", row) for n, row in enumerate(found, 1)])
    return received, read_rows(rows, received, file=False)


def head(name: str, uavs: list[str], about: dict[str, Any]) -> dict[str, Any]:
    """The first line of a journal."""
    return {"journal": FORMAT, "version": VERSION, "fleet": name, "uavs": uavs, "about": about}
