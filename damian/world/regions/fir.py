"""Reads Eurocontrol FIR tables (CSV); any fault raises one `InputError` that says where in the file it is."""

import os
from pathlib import Path

import numpy as np

from damian.common.errors import InputError
from damian.common.text_files import Row, named, near, parse_table, read_text, show
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


def read_fir(path: str | os.PathLike[str], airspace_id: str) -> Region:
    """Read one airspace of a FIR table as a region in local metres.

    The table needs the columns ``Airspace ID, Min Flight Level, Max Flight Level, Sequence Number,
    Latitude, Longitude`` and may have others. Its rows may be in any order: the sequence numbers
    0, 1, 2, ... number the corners around the polygon. Only the rows of the chosen airspace are checked.

    Raises:
        InputError: the file cannot be read, its table is malformed, or the airspace is missing or invalid.
    """
    with named(path):
        table = parse_table(read_text(Path(path)), _COLUMNS)
        rows = [row for row in table if row.cells[_ID] == airspace_id]
        if not rows:
            known_ids = {row.cells[_ID] for row in table}
            raise InputError(f"no {_ID} {show(airspace_id)}; {near(airspace_id, known_ids)}")
        rows, levels = _in_sequence(rows), _levels(rows)
        corners = [[_number(row, column) for column in (_LONGITUDE, _LATITUDE)] for row in rows]
        return local_region([[np.array(corners)]], airspace_id, levels, airspace_id)


def _in_sequence(rows: list[Row]) -> list[Row]:
    """Sort the rows by their sequence numbers, which must be 0, 1, 2, ..."""
    numbered = sorted((_number(row, _SEQUENCE), row) for row in rows)
    for expected, (number, row) in enumerate(numbered):
        if number == expected:
            continue
        problem = f"line {row.line}: {_SEQUENCE} {row.cells[_SEQUENCE]}"
        if expected and number == numbered[expected - 1][0]:
            raise InputError(f"{problem} is on line {numbered[expected - 1][1].line} too")
        raise InputError(f"{problem} where {expected} is next; number the points 0, 1, 2, ...")
    return [row for _, row in numbered]


def _levels(rows: list[Row]) -> tuple[float, float]:
    """Lowest and highest flight level, each of which must be the same in all rows."""
    first = min(rows)
    low, high = (_same_in_all_rows(rows, first, column) for column in (_LOWEST, _HIGHEST))
    if low > high:
        raise InputError(f"line {first.line}: {_LOWEST} {low:g} FL is above {_HIGHEST} {high:g} FL")
    return low, high


def _same_in_all_rows(rows: list[Row], first: Row, column: str) -> float:
    level = _number(first, column)
    for row in rows:
        value = _number(row, column)
        if value != level:
            raise InputError(
                f"line {row.line}: {column} {value:g} FL is not the {level:g} FL of line "
                f"{first.line}; an airspace has one"
            )
    return level


def _number(row: Row, column: str) -> float:
    """Read a cell as a number within its column's bounds."""
    text, (low, high, unit) = row.cells[column], _BOUNDS[column]
    try:
        # float() alone would accept underscores and read 1_0 as 10.
        value = float("_" if "_" in text else text)
    except ValueError:
        raise InputError(f"line {row.line}: {column} {show(text)} is not a number") from None
    if not low <= value <= high:
        written = f"{text[:40]} {unit}".strip()
        raise InputError(f"line {row.line}: {column} {written} is not between {low:g} and {high:g} {unit}")
    return value
