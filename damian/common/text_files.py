"""Reading what people wrote: a whole file as text, and errors that say where on one line."""

import difflib
import os
import reprlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from damian.common.errors import InputError

MAX_BYTES = 50_000_000
"""Larger files are refused unread."""


def read_text(file: Path) -> str:
    """A whole file as text, with or without a byte order mark."""
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
    """Put the file's name before every error, and each on one line that can be printed."""
    try:
        yield
    except InputError as error:
        raise InputError(one_line(f"{path}: {error}")) from None


def one_line(text: str) -> str:
    """Text without line breaks and without halves of characters, which JSON may hold."""
    return " ".join(text.encode(errors="backslashreplace").decode().split())


def show(value: Any) -> str:
    """A value as written in Python, cut short."""
    return reprlib.repr(value)


def listed(items: Iterable[str]) -> str:
    """The first eight items and how many more there are."""
    items = list(items)
    more = [f"and {len(items) - 8} more"] if len(items) > 8 else []
    return ", ".join(items[:8] + more) or "none"


def near(written: str, known: Iterable[str]) -> str:
    """What may have been meant."""
    lowered = {name.lower(): name for name in sorted(known)}
    close = difflib.get_close_matches(written.lower(), lowered, n=5)
    if close:
        return f"did you mean {listed(show(lowered[name]) for name in close)}?"
    return f"the file has {listed(map(show, lowered.values()))}"
