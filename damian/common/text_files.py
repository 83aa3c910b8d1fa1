"""Reads input files as text, and helps to put the file, the place and a hint into one-line errors."""

import difflib
import os
import reprlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from damian.common.errors import InputError

MAX_BYTES = 50_000_000
"""Size limit [bytes]; larger files are refused without reading them."""


def read_text(file: Path) -> str:
    """Read a whole UTF-8 file as text, with or without a byte order mark.

    Raises:
        InputError: the file is missing, unreadable, too large, empty or not UTF-8.
    """
    try:
        if not file.exists():
            raise InputError("no such file")
        if not file.is_file():
            raise InputError("is not a file")
        size = file.stat().st_size
        if size > MAX_BYTES:
            raise InputError(f"{size} bytes are more than the {MAX_BYTES} that are read")
        text = file.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"byte {error.start} is not UTF-8 text") from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}") from None
    if not text.strip():
        raise InputError("is empty")
    return text


@contextmanager
def named(path: str | os.PathLike[str]) -> Iterator[None]:
    """Put the file's name before every ``InputError`` raised inside, and make it one printable line."""
    try:
        yield
    except InputError as error:
        raise InputError(one_line(f"{path}: {error}")) from None


def one_line(text: str) -> str:
    """Remove line breaks, and escape lone surrogates, which JSON may hold and which cannot be printed."""
    return " ".join(text.encode(errors="backslashreplace").decode().split())


def show(value: Any) -> str:
    """Shorten a value to an abbreviated Python literal."""
    return reprlib.repr(value)


def listed(items: Iterable[str]) -> str:
    """Join the first eight items, and say how many more there are."""
    items = list(items)
    more = [f"and {len(items) - 8} more"] if len(items) > 8 else []
    return ", ".join(items[:8] + more) or "none"


def near(written: str, known: Iterable[str]) -> str:
    """Suggest the known names closest to an unknown one, or list all of them if none is close."""
    lowered = {name.lower(): name for name in sorted(known)}
    close = difflib.get_close_matches(written.lower(), lowered, n=5)
    if close:
        return f"did you mean {listed(show(lowered[name]) for name in close)}?"
    return f"the file has {listed(map(show, lowered.values()))}"
