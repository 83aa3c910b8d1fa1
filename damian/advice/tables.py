"""Tables of reports as rows, whose columns are known: CSV and JSON in, CSV out.

A row is a mapping from columns to text or numbers. Names of columns may be written in any case, and with
``_`` for a space. ``NA``, an empty cell and null mean that the value is not known.
"""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from damian.common.errors import InputError
from damian.common.text_files import parse_table, read_text, show

UNKNOWN = ("", "na", "nan", "none", "null")
"""Cells that mean that a value is not known."""
MAX_ROWS = 10_000
"""Most rows of a request or a file in the folder."""

Rows = list[tuple[str, dict[str, Any]]]
"""What rows say, by columns in lower case; each with its place in the text (``line 2``)."""

COLUMNS = {
    "id": "ID of the UAV",
    "time": "when the observation was generated",
    "aoi": "age of the observation when it came in [s], if there is no time",
    "lat": "latitude [deg]",
    "lon": "longitude [deg]",
    "x": "east [m], over a region without a place on Earth",
    "y": "north [m]",
    "source spotted": "whether the UAV spots the source: 1 or 0",
    "source time": "when it detected the source last",
    "source lat": "where it was then",
    "source lon": "",
    "source x": "",
    "source y": "",
    "track": "heading of its latest flight, clockwise from north [deg]",
    "takeoff-landing time": "when it took off or landed last",
    "battery": "battery level [%]",
    "fla": "flight altitude [m]: above 0 in flight",
    "target lat": "landing point that it is bound for",
    "target lon": "",
    "target x": "",
    "target y": "",
    "previous": "landing points where it was before, newest first",
    "motions": "decisions since its latest detection",
    "readings": "readings of sensors of one's own",
    "sequence": "number of the report",
    "receive time": "when it came in; only in files",
}
"""Columns of a report, in lower case, and what they mean."""


def read_file(path: Path) -> Rows:
    """Rows of a file: JSON if its name ends with ``.json`` or ``.jsonl`` (an object on each line), else CSV.

    Raises:
        InputError: it cannot be read, or is something else.
    """
    text, kind = read_text(path), path.suffix.lower()
    return json_rows(text, kind == ".jsonl") if kind in (".json", ".jsonl") else csv_rows(text)


def csv_rows(text: str) -> Rows:
    """Rows of a CSV table, each with its place in the text (``line 2``).

    Raises:
        InputError: it is no table, or has a column that is not known.
    """
    table = parse_table(text, [])
    if not table:
        raise InputError("line 2: there is no row under the header")
    return [(f"line {row.line}", _named(row.cells, f"line {row.line}")) for row in _limited(table)]


def json_rows(text: str | bytes, lines: bool = False) -> Rows:
    """Rows of JSON, each with its place: an object, a list of objects, or an object on each line.

    Args:
        text: the JSON.
        lines: it has an object on each line.

    Raises:
        InputError: it is something else.
    """
    if lines:
        parts = text.decode(errors="replace") if isinstance(text, bytes) else text
        found = [
            (f"line {n}", parsed_json(line, f"line {n}"))
            for n, line in enumerate(parts.splitlines(), 1)
            if line.strip()
        ]
    else:
        parsed = parsed_json(text, "JSON")
        rows = parsed["rows"] if isinstance(parsed, dict) and "rows" in parsed else parsed
        rows = [rows] if isinstance(rows, dict) else rows
        if not isinstance(rows, list):
            raise InputError(f"JSON: {show(rows)} is not a row or a list of rows")
        found = [(f"row {n}", row) for n, row in enumerate(rows, 1)]
    return checked_rows(found)


def checked_rows(found: Sequence[tuple[str, Any]]) -> Rows:
    """Rows with columns that are known, without what a row leaves open.

    Args:
        found: rows of JSON, each with its place.

    Raises:
        InputError: there is none, or one is no object, or has other columns.
    """
    if not found:
        raise InputError("there is no row")
    for where, row in _limited(found):
        if not isinstance(row, dict):
            raise InputError(f"{where}: {show(row)} is not an object with the columns of a report")
    return [(where, _named(row, where)) for where, row in found]


def _named(row: Mapping[Any, Any], where: str) -> dict[str, Any]:
    """What a row says, by its columns in lower case.

    Raises:
        InputError: a column is not known, or appears twice.
    """
    named: dict[str, Any] = {}
    for name, value in row.items():
        column = _column(str(name))
        if column is None:
            known = ", ".join(COLUMNS)
            raise InputError(f"{where}: {show(name)} is no column; they are {known}")
        if column in named:
            raise InputError(f"{where}: the column {column} appears twice")
        named[column] = value
    return {column: value for column, value in named.items() if not _is_unknown(value)}


@lru_cache(1000)
def _column(name: str) -> str | None:
    """The column that a name means, if there is one."""
    plain = name.strip().lower().replace("_", " ")
    column = "takeoff-landing time" if plain == "takeoff landing time" else plain
    return column if column in COLUMNS else None


def _is_unknown(value: Any) -> bool:
    return value is None or (isinstance(value, str) and value.strip().lower() in UNKNOWN)


def parsed_json(text: str | bytes, where: str) -> Any:
    """Parse JSON.

    Raises:
        InputError: it is none.
    """
    try:
        return json.loads(text, parse_constant=no_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: it is not JSON: {str(error)[:200]}") from None


def no_constant(name: str) -> Any:
    """Refuse NaN and Infinity, which Python would read as numbers of JSON."""
    raise ValueError(f"{name} is not a number of JSON; write null for what is not known")


def _limited(rows: Sequence[Any]) -> Sequence[Any]:
    if len(rows) > MAX_ROWS:
        raise InputError(f"{len(rows)} rows are more than the {MAX_ROWS} of a request or file")
    return rows


def as_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """A CSV table of rows with the same columns; what is not known is ``NA``."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else ["ID"], lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "NA" if value is None else value for name, value in row.items()} for row in rows)
    return text.getvalue()
