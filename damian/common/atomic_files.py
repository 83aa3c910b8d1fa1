"""Writes files so that each is there completely or not at all, whenever the process or the machine stops."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from damian.common.errors import RunError

UNFINISHED = ".part"
"""End of the name of a file that is being written."""


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file atomically: if writing fails, the existing file is unchanged."""
    unfinished = path.with_name(path.name + UNFINISHED)
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
    for path in folder.glob(f"*{UNFINISHED}"):
        with writing(path):
            path.unlink()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an error of the file system that is raised inside into one line that names the path."""
    try:
        yield
    except OSError as error:
        problem = error.strerror or str(error)
        raise RunError(f"{path}: it cannot be written: {problem}; what was stored before is intact") from None
