"""Tables in files: CSV, read and written, and Markdown."""

import io
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError


def read_csv(path: Path, text: Sequence[str] = ()) -> pd.DataFrame:
    """Read a table of numbers, in which the columns ``text`` are words; those named ``seed`` are
    whole.

    A last line without an end, which a killed process was writing, is left out.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    kinds: Any = defaultdict(lambda: float, dict.fromkeys(text, str), seed=int)
    try:
        content = path.read_text(encoding="utf-8")
        lines = content[: content.rfind("\n") + 1]
        if not lines.strip():
            return pd.DataFrame()
        return pd.read_csv(io.StringIO(lines), dtype=kinds, keep_default_na=False, na_values="nan")
    except OSError as error:
        raise InputError(f"{path}: it cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(
            f"{path}: it is not a table of numbers ({' '.join(str(error).split())})"
        ) from None


def write_csv(path: Path, table: pd.DataFrame, unknown: str = "nan") -> None:
    """Write a table; a number that is not known is written as ``unknown``."""
    write_atomically(path, table.to_csv(index=False, na_rep=unknown) if len(table.columns) else "")


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]], left: int = 1) -> str:
    """A table whose first ``left`` columns are aligned to the left, and all others to the right."""
    alignment = [":--"] * left + ["--:"] * (len(header) - left)
    lines = [header, alignment, *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)
