"""Writes files below a folder that a person has named: each completely or not at all, none through
a link.

The folder may be a link, or lie below one. What is in it may come from anybody, so that nothing
below it is followed to another place. Every program writes by these functions, or, where a library
writes by itself, to a path from ``not_linked``.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path

from damian.common.errors import InputError, RunError

UNFINISHED = ".part"
"""End of the name of a file that is being written."""


def not_linked(path: Path, below: Path | None = None) -> Path:
    """The path; refused if it, or a folder between it and the folder ``below``, is a link.

    Without ``below``, a person has named the folder that the path lies in.
    """
    between = takewhile(lambda folder: folder != below, path.parents) if below else ()
    for each in (path, *between):
        if each.is_symlink():
            problem = "is a link, and links in a folder that is read or written are not followed"
            raise InputError(f"{each} {problem}: put there what it leads to")
    return path


def make_folder(path: Path, below: Path | None = None) -> Path:
    """Make a folder below another, if it is not there yet."""
    with writing(path):
        not_linked(path, below).mkdir(parents=True, exist_ok=True)
    return path


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file atomically: if writing fails, the existing file is unchanged."""
    unfinished = not_linked(not_linked(path).with_name(path.name + UNFINISHED))
    with writing(path):
        try:
            with unfinished.open("wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
            unfinished.replace(path)
        except OSError:
            unfinished.unlink(missing_ok=True)
            raise
        if hasattr(os, "O_DIRECTORY"):  # Windows cannot open a folder, whose new name must last too
            descriptor = os.open(path.parent, os.O_RDONLY)
            os.fsync(descriptor)
            os.close(descriptor)


def remove_unfinished(folder: Path) -> None:
    """Remove what a killed process was writing in a folder."""
    for path in not_linked(folder).glob(f"*{UNFINISHED}"):
        with writing(path):
            path.unlink()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an error of the file system that is raised inside into one line that names the path."""
    try:
        yield
    except OSError as error:
        problem = error.strerror or str(error)
        raise RunError(
            f"{path}: it cannot be written: {problem}; what was stored before is intact"
        ) from None
