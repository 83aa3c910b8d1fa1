"""Writes docs/leaderboard.md and docs/leaderboard_matrix.md from the files in
docs/results/leaderboard.

python docs/leaderboard_pages.py
"""

from collections.abc import Collection, Sequence
from pathlib import Path

import pandas as pd
from leaderboard import FEWEST_SEEDS, NUMBERS, WORDS, delaybench

from damian.common.tables import markdown_table, read_csv
from damian.compare.comparison import (
    HELD_OUT_MARK,
    LATE_DATA,
    RUN,
    SIMULATOR,
    TRAINED,
    means_over_seeds,
    shown,
)
from damian.recipes.shared.sweeps import stored_results

DOCS = Path(__file__).parent
RESULTS = DOCS / "results"
LEADERBOARD = """# Leaderboard

Made from the files in `docs/results/leaderboard` by `python docs/leaderboard_pages.py`. True returns of
sampled actions, by damian's own evaluation: mean over seeds [95 % interval] (seeds).
[Join in](delaybench.md#your-method); tasks and delays are those of [delaybench](delaybench.md). A submission
needs five seeds; some of our own cells have three or four. Rows of *0.18 or before* have no fingerprint of
their task. Where these policies flew without being trained for it is
[a page of its own](leaderboard_matrix.md)."""
MATRIX = """# Flown where they were not trained

Policies of the [leaderboard](leaderboard.md) over the delay of the flight: four UAVs (`agents`), and other
delays. Mean over seeds [95 % interval] (seeds).

![Returns over the delay of the flight](results/delaybench/matrix.png)"""
FEWEST = 3
"""The leaderboard shows a mean only of this many seeds or more, since fewer give no interval."""


def leaderboard_pages() -> dict[str, str]:
    """The submissions as tables, with our runs of the same methods that are too few for a
    submission: a page for each file."""
    files = sorted((RESULTS / "leaderboard").glob("*.csv"))
    submitted = pd.concat([read_csv(file, text=WORDS) for file in files], ignore_index=True)
    stored = stored_results(RESULTS / "delaybench").rows
    ours = stored[(stored["policy"] == TRAINED) & stored["task"].isin([*delaybench().tasks])][
        [*RUN, *NUMBERS]
    ]
    ours = ours.groupby(RUN[:-1]).filter(lambda runs: FEWEST <= len(runs) < FEWEST_SEEDS)
    facts = submitted.drop(columns=[*RUN[:2], "seed", *NUMBERS]).drop_duplicates("method")
    few = ours.merge(facts[facts["authors"] == "DAMIAN"], on="method")
    rows = pd.concat([submitted, few], ignore_index=True)
    away = rows["task"].str.contains(HELD_OUT_MARK, regex=False)
    return {
        "leaderboard.md": by_task(rows[~away], delaybench().delays),
        "leaderboard_matrix.md": by_flight(rows[away]),
    }


def by_task(rows: pd.DataFrame, delays: Collection[str]) -> str:
    """The leaderboard, as Markdown: a table for each track and task."""
    parts = [LEADERBOARD]
    for regime in (LATE_DATA, SIMULATOR):
        for task in rows.loc[rows["regime"] == regime, "task"].unique():
            of_task = rows[(rows["regime"] == regime) & (rows["task"] == task)]
            parts += [f"## {task}, {regime}", _methods(of_task, [*delays])]
    return "\n\n".join(parts) + "\n"


def by_flight(rows: pd.DataFrame) -> str:
    """What policies return where they were not trained, as Markdown: a table for each method."""
    parts = [MATRIX]
    for method in rows["method"].unique():
        parts += [f"## {method}", _flights(rows[rows["method"] == method])]
    return "\n\n".join(parts) + "\n"


def _methods(rows: pd.DataFrame, delays: Sequence[str]) -> str:
    """A line for each method, the best one under the first delay first, with a column for each
    delay."""
    present = [delay for delay in delays if (rows["delay"] == delay).any()]
    means = rows.pivot_table(values="return", index="method", columns="delay")
    lines = []
    for method in means.sort_values(present, ascending=False).index:
        runs = rows[rows["method"] == method]
        cells = [_mean(runs[runs["delay"] == delay]) for delay in present]
        one = runs.iloc[0]
        steps = f"{runs['frames'].max() / 1e6:.2g}"
        size = f"{int(one['parameters']):,}"
        version = f"{one['damian']} ({str(one['commit'])[:7]})".removesuffix(" (several)")
        lines.append((method, *cells, one["authors"], steps, size, version))
    return markdown_table(
        ["method", *present, "authors", "million steps", "parameters", "damian"], lines
    )


def _flights(rows: pd.DataFrame) -> str:
    """A line for each held-out task, with a column for each delay of the training."""
    trained = [*rows["delay"].unique()]
    lines = []
    for task, runs in rows.groupby("task", sort=False):
        lines.append((task, *(_mean(runs[runs["delay"] == delay]) for delay in trained)))
    return markdown_table(["flown in", *(f"trained under {delay}" for delay in trained)], lines)


def _mean(runs: pd.DataFrame) -> str:
    """Mean return with its interval and the number of seeds."""
    if runs.empty:
        return "-"
    return f"{shown(means_over_seeds(runs[['return']]), 'return')} ({len(runs)})"


def main() -> None:
    """Write the pages."""
    for name, page in leaderboard_pages().items():
        (DOCS / name).write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
