"""Tables as text: CSV and Markdown."""

import csv
import io
from collections.abc import Iterable, Sequence


def csv_table(rows: Iterable[Iterable[object]]) -> str:
    """Rows of cells as the text of a CSV file."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(rows)
    return text.getvalue()


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]], left: int = 1) -> str:
    """A table whose first ``left`` columns are aligned to the left, and all others to the right."""
    alignment = [":--"] * left + ["--:"] * (len(header) - left)
    lines = [header, alignment, *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)
