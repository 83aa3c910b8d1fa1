"""CSV tables."""

import csv
import io
from collections.abc import Iterable


def csv_table(rows: Iterable[Iterable[object]]) -> str:
    """Rows of cells as the text of a CSV file."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(rows)
    return text.getvalue()
