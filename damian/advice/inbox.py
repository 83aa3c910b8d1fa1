"""A folder as a source of reports: every table that is put into it is read once, and answered there."""

import json
from pathlib import Path

from damian.advice.answers import Answer
from damian.advice.desk import Desk
from damian.advice.fleet import Waiting
from damian.advice.tables import as_csv, read_file
from damian.common.atomic_files import write_atomically, writing
from damian.common.errors import InputError, RunError

TABLES = (".csv", ".json", ".jsonl")
ANSWERS = ("advice.csv", "advice.json")
DONE, REFUSED, REASON = ".done", ".refused", ".refused.txt"
"""Added to the name of a table that was read, or refused, and to that of the file that says why."""


def read_inbox(desk: Desk, name: str, folder: Path, now: float) -> bool:
    """Read the tables that have come into a folder, in the order of their names, and answer them.

    A table must appear complete: write it under another name, such as one that begins with a dot, and rename
    it. The answer is ``advice.csv`` and ``advice.json`` in the folder. A table that is wrong changes nothing.
    Files ``NAME.done``, ``NAME.refused`` and ``NAME.refused.txt`` are of the newest table of that name; the
    time is put into the names of those of an earlier one.

    Args:
        desk: the fleets.
        name: of the fleet.
        folder: the folder.
        now: the time [s].

    Returns:
        Whether there was any table.

    Raises:
        RunError: the folder cannot be read any more, or an answer cannot be written.
    """
    try:
        paths = sorted(path for path in folder.iterdir() if _is_table(path))
    except OSError as error:
        raise RunError(f"folder: {folder}: it cannot be read: {error.strerror}") from None
    taken = [_read(desk, name, path, now) for path in paths]
    if any(taken):
        try:
            answer = desk.advise(name, now)
        except Waiting:
            return True
        write_answer(folder, answer)
    return bool(paths)


def write_answer(folder: Path, answer: list[Answer]) -> str:
    """Write the advice of a fleet into a folder, as ``ANSWERS``; returns its table.

    Raises:
        RunError: it cannot be written.
    """
    write_atomically(folder / "advice.json", json.dumps(answer, indent=1))
    write_atomically(folder / "advice.csv", table := as_csv(answer))
    return table


def _is_table(path: Path) -> bool:
    hidden = path.name.startswith(".") or path.name in ANSWERS
    return not hidden and path.suffix.lower() in TABLES and path.is_file()


def _read(desk: Desk, name: str, path: Path, now: float) -> bool:
    """Give a table to the desk; returns whether it was taken."""
    reason = ""
    try:
        desk.report(name, read_file(path), now)
        end = DONE
    except InputError as error:
        end = REFUSED
        reason = str(error)
    with writing(path):
        _keep_earlier(path, now)
        if reason:
            write_atomically(path.with_name(path.name + REASON), f"{reason}\n")
        path.rename(path.with_name(path.name + end))
    return end == DONE


def _keep_earlier(path: Path, now: float) -> None:
    """Give the files of an earlier table of this name other names, with the time."""
    for end in (DONE, REFUSED, REASON):
        earlier = path.with_name(path.name + end)
        if earlier.exists():
            earlier.rename(path.with_name(f"{path.name}.{now:.3f}{end}"))
