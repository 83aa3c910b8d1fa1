"""Reads Eurocontrol FIR tables (CSV)."""

import os
from pathlib import Path

import numpy as np

from damian.common.errors import InputError
from damian.common.text_files import Row, named, near, parse_table, read_text, show
from damian.world.regions.region import Region, local_region

_ID = "Airspace ID"
_SEQUENCE = "Sequence Number"
_BOUNDS = {
    "Latitude": (-90.0, 90.0, "deg"),
    "Longitude": (-360.0, 360.0, "deg"),
    "Min Flight Level": (0.0, 1000.0, "FL"),
    "Max Flight Level": (0.0, 1000.0, "FL"),
    _SEQUENCE: (0.0, 1e6, ""),
}


def read_fir(path: str | os.PathLike[str], airspace_id: str) -> Region:
    """Read one airspace of a FIR table as a region in local metres.

    The table needs the columns ``Airspace ID, Min Flight Level, Max Flight Level, Sequence Number,
    Latitude, Longitude`` and may have others. Its rows may be in any order: the sequence numbers
    0, 1, 2, ... number the corners around the polygon. Only the rows of the chosen airspace are
    checked.

    Raises:
        InputError: the file cannot be read, its table is malformed, or the airspace is missing or
            invalid.
    """
    with named(path):
        table = parse_table(read_text(Path(path)), [_ID, *_BOUNDS])
        rows = [row for row in table if row.cells[_ID] == airspace_id]
        if not rows:
            hint = near(airspace_id, {row.cells[_ID] for row in table})
            raise InputError(f"no {_ID} {show(airspace_id)}; {hint}")
        rows.sort(key=lambda row: _number(row, _SEQUENCE))
        numbers = [_number(row, _SEQUENCE) for row in rows]
        if numbers != [*range(len(rows))]:
            raise InputError(
                f"{show(airspace_id)}: {_SEQUENCE} {numbers} do not count from 0 upwards"
            )
        levels = {
            (_number(row, "Min Flight Level"), _number(row, "Max Flight Level")) for row in rows
        }
        if len(levels) > 1:
            raise InputError(
                f"{show(airspace_id)}: its rows differ in their flight levels [FL], {levels}"
            )
        corners = [[_number(row, "Longitude"), _number(row, "Latitude")] for row in rows]
        return local_region([[np.array(corners)]], airspace_id, levels.pop(), airspace_id)


def _number(row: Row, column: str) -> float:
    """Read a cell as a number within its column's bounds."""
    text, (low, high, unit) = row.cells[column], _BOUNDS[column]
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"line {row.line}: {column} {show(text)} is not a number") from None
    if not low <= value <= high:
        bounds = f"{low:g} and {high:g} {unit}"
        raise InputError(f"line {row.line}: {column} {value:g} {unit} is not between {bounds}")
    return value
