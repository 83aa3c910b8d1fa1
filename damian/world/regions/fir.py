"""Eurocontrol FIR tables (CSV). Everything wrong in one is one `InputError` that says where."""

import csv
import io
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from damian.common.errors import InputError
from damian.common.text_files import listed, named, near, read_text, show
from damian.world.regions.region import Region, local_region

_ID, _SEQUENCE = "Airspace ID", "Sequence Number"
_LOWEST, _HIGHEST = "Min Flight Level", "Max Flight Level"
_LATITUDE, _LONGITUDE = "Latitude", "Longitude"
_COLUMNS = (_ID, _LOWEST, _HIGHEST, _SEQUENCE, _LATITUDE, _LONGITUDE)
_BOUNDS = {
    _LATITUDE: (-90.0, 90.0, "deg"),
    _LONGITUDE: (-180.0, 180.0, "deg"),
    _LOWEST: (0.0, 1000.0, "FL"),
    _HIGHEST: (0.0, 1000.0, "FL"),
    _SEQUENCE: (0.0, 1e6, ""),
}


class _Row(NamedTuple):
    """One line of a FIR table."""

    line: int
    cells: dict[str, str]


def read_fir(path: str | os.PathLike[str], airspace_id: str) -> Region:
    """Read one airspace of a FIR table.

    Columns: ``Airspace ID, Min Flight Level, Max Flight Level, Sequence Number, Latitude,
    Longitude``, any others beside them; rows in any order, their sequence numbers 0, 1, 2, ... go
    round the polygon. Only the rows of the chosen airspace are checked.

    Raises:
        InputError: the file, its table, or the chosen airspace is wrong.
    """
    with named(path):
        table = _read_table(read_text(Path(path)))
        rows = [row for row in table if row.cells[_ID] == airspace_id]
        if not rows:
            known = {row.cells[_ID] for row in table}
            raise InputError(f"no {_ID} {show(airspace_id)}; {near(airspace_id, known)}")
        rows, levels = _in_sequence(rows), _levels(rows)
        corners = [[_number(row, column) for column in (_LONGITUDE, _LATITUDE)] for row in rows]
        return local_region([[np.array(corners)]], airspace_id, levels, airspace_id)


def _read_table(text: str) -> list[_Row]:
    """Every line with its cells by column, stripped."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except csv.Error as error:
        raise InputError(f"line {reader.line_num}: {error}; give comma-separated values") from None
    (first, header), *lines = [row for row in lines if any(row[1])] or [(1, [])]
    wrong = [column for column in _COLUMNS if header.count(column) != 1]
    if wrong:
        found = listed(map(show, header))
        raise InputError(
            f"line {first}: column {', '.join(wrong)} missing or doubled; the columns are {found}"
        )
    for number, cells in lines:
        if len(cells) != len(header):
            raise InputError(f"line {number}: {len(cells)} values for {len(header)} columns")
    return [_Row(number, dict(zip(header, cells, strict=True))) for number, cells in lines]


def _in_sequence(rows: list[_Row]) -> list[_Row]:
    """Rows ordered by their sequence numbers, which must be 0, 1, 2, ..."""
    keyed = sorted((_number(row, _SEQUENCE), row) for row in rows)
    for expected, (number, row) in enumerate(keyed):
        if number == expected:
            continue
        problem = f"line {row.line}: {_SEQUENCE} {row.cells[_SEQUENCE]}"
        if expected and number == keyed[expected - 1][0]:
            raise InputError(f"{problem} is on line {keyed[expected - 1][1].line} too")
        raise InputError(f"{problem} where {expected} is next; number the points 0, 1, 2, ...")
    return [row for _, row in keyed]


def _levels(rows: list[_Row]) -> tuple[float, float]:
    """The lowest and highest flight level, the same in all rows."""
    first = min(rows)
    low, high = (_common(rows, first, column) for column in (_LOWEST, _HIGHEST))
    if low > high:
        raise InputError(f"line {first.line}: {_LOWEST} {low:g} FL is above {_HIGHEST} {high:g} FL")
    return low, high


def _common(rows: list[_Row], first: _Row, column: str) -> float:
    """The number that a column has in every row."""
    level = _number(first, column)
    for row in rows:
        value = _number(row, column)
        if value != level:
            raise InputError(
                f"line {row.line}: {column} {value:g} FL is not the {level:g} FL of line "
                f"{first.line}; an airspace has one"
            )
    return level


def _number(row: _Row, column: str) -> float:
    """A cell as a number within its column's bounds."""
    text, (low, high, unit) = row.cells[column], _BOUNDS[column]
    try:
        # Python would read 1_0 as ten.
        value = float("_" if "_" in text else text)
    except ValueError:
        raise InputError(f"line {row.line}: {column} {show(text)} is not a number") from None
    if not low <= value <= high:
        written = f"{text[:40]} {unit}".strip()
        raise InputError(f"line {row.line}: {column} {written} is not between {low:g} and {high:g} {unit}")
    return value
