"""Reads input files as text and tables, and puts the file, the place and a hint into one-line
errors."""

import csv
import difflib
import io
import os
import reprlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from damian.common import checks
from damian.common.errors import InputError

MAX_LINE = 1000
"""Characters of an error; the middle of a longer one is left out."""


def data_file(path: str, key: str) -> str:
    """The file of a path; one that begins with ``damian:`` is among the package's own.

    Raises:
        InputError: the package has no policy, or no file, of this name; ``key`` is the setting of
            the path.
    """
    shipped = path.removeprefix("damian:")
    if shipped == path:
        return path
    folder = Path(str(files("damian") / "data"))
    name = shipped.partition("/")[0]
    alike = [each.name for each in sorted(folder.iterdir()) if each.suffix == Path(name).suffix]
    checks.one_of(key, f"damian:{name}", [f"damian:{each}" for each in alike])
    return str(folder / shipped)


def read_text(file: Path) -> str:
    """Read a whole UTF-8 file as text, with or without a byte order mark."""
    if not file.is_file():  # reading a pipe would wait for ever
        raise InputError("is not a file" if file.exists() else "no such file")
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"byte {error.start} is not UTF-8 text") from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}") from None
    if not text.strip():
        raise InputError("is empty")
    return text


class Row(NamedTuple):
    """A row of a table: its line number in the file, and its cells, stripped, by column name."""

    line: int
    cells: dict[str, str]


def parse_table(text: str, columns: Iterable[str]) -> list[Row]:
    """Parse a CSV table with a header, which must have these columns; empty rows are left out."""
    reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    try:
        header = [name.strip() for name in reader.fieldnames or ()]
        lines = [(reader.line_num, [*row.values()]) for row in reader]
    except csv.Error as error:
        raise InputError(f"line {reader.line_num}: {error}; give comma-separated values") from None
    if missing := [column for column in columns if column not in header]:
        raise InputError(f"line 1: no column {', '.join(missing)}; {near(missing[0], header)}")
    for number, cells in lines:
        if len(cells) != len(header) or None in cells:
            raise InputError(f"line {number}: it has not {len(header)} values, one for each column")
    rows = [(number, [cell.strip() for cell in cells]) for number, cells in lines]
    return [
        Row(number, dict(zip(header, cells, strict=True))) for number, cells in rows if any(cells)
    ]


@contextmanager
def named(path: str | os.PathLike[str]) -> Iterator[None]:
    """Put the file's name before every ``InputError`` raised inside, and make it one printable
    line."""
    try:
        yield
    except InputError as error:
        raise InputError(one_line(f"{path}: {error}")) from None


def one_line(text: str) -> str:
    """Remove line breaks, escape what a terminal would not print, and leave out the middle of a
    long text."""
    line = " ".join(text.split())
    if len(line) > MAX_LINE:
        line = f"{line[: MAX_LINE // 2]} ... {line[-MAX_LINE // 3 :]}"
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in line)


show = reprlib.repr
"""Shortens a value to an abbreviated Python literal."""


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
