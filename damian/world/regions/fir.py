"""Reads Eurocontrol FIR tables (CSV)."""

import os
from pathlib import Path

import numpy as np

from damian.common.errors import InputError
from damian.common.text_files import Row, named, near, parse_table, read_text, show
from damian.world.regions.region import Region, local_region

_ID, _SEQUENCE = "Airspace ID", "Sequence Number"
_LOWEST, _HIGHEST = "Min Flight Level", "Max Flight Level"
_LATITUDE, _LONGITUDE = "Latitude", "Longitude"
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
        table = parse_table(read_text(Path(path)), [_ID, *_BOUNDS])
        rows = [row for row in table if row.cells[_ID] == airspace_id]
        if not rows:
            known_ids = {row.cells[_ID] for row in table}
            raise InputError(f"no {_ID} {show(airspace_id)}; {near(airspace_id, known_ids)}")
        numbered = sorted((_number(row, _SEQUENCE), row) for row in rows)
        for expected, (number, row) in enumerate(numbered):
            if number != expected:
                raise InputError(
                    f"line {row.line}: {_SEQUENCE} {number:g} where {expected} is next; number the points "
                    "0, 1, 2, ..."
                )
        levels = [(_number(row, _LOWEST), _number(row, _HIGHEST)) for row in rows]
        low, high = levels[0]
        if len({*levels}) > 1 or low > high:
            raise InputError(
                f"{show(airspace_id)}: {_LOWEST} and {_HIGHEST} are {low:g} and {high:g} FL in line "
                f"{rows[0].line}; give the lowest and the highest one, the same in every line"
            )
        corners = [[_number(row, column) for column in (_LONGITUDE, _LATITUDE)] for _, row in numbered]
        return local_region([[np.array(corners)]], airspace_id, (low, high), airspace_id)


def _number(row: Row, column: str) -> float:
    """Read a cell as a number within its column's bounds."""
    text, (low, high, unit) = row.cells[column], _BOUNDS[column]
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"line {row.line}: {column} {show(text)} is not a number") from None
    if not low <= value <= high:
        raise InputError(
            f"line {row.line}: {column} {value:g} {unit} is not between {low:g} and {high:g} {unit}"
        )
    return value
