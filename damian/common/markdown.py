"""Markdown tables."""

from collections.abc import Iterable, Sequence


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]], left: int = 1) -> str:
    """Format a table whose first ``left`` columns are aligned to the left, and all others to the right."""
    alignment = [":--"] * left + ["--:"] * (len(header) - left)
    lines = [header, alignment, *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)
