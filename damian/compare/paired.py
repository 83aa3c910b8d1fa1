"""Means of groups of runs over their seeds, and paired differences to the first value of a
setting."""

from collections.abc import Sequence

import pandas as pd

from damian.common.tables import markdown_table
from damian.compare.comparison import improvement, means_over_seeds, shown, sign_of
from damian.compare.statistics import FEWEST
from damian.runs.measures import declared
from damian.runs.run_folder import measured_in

NOTE = (
    f"n: runs, one for each seed; [95 % interval over runs, none below {FEWEST}]; perceived: as "
    "far as the server knew"
)
DIFFERENCE = (
    "; difference: of the {score} to that of {first}, paired by seed; P > first: probability that "
    "a run of the line beats one of the first"
)


def means(rows: pd.DataFrame, groups: Sequence[str], score: str = "return") -> pd.DataFrame:
    """A line for each policy of each group: means over seeds, and differences to the first
    value."""
    succeeds = (rows["success_rate"] > 0).any()
    lines = []
    known = {name: declared(name) for name in measured_in(rows, score)}
    measures = [name for name, each in known.items() if name == score or "sweep" in each.tables]
    measures = [
        name for name in measures if name == score or succeeds or known[name].where != "success"
    ]
    by_names = dict(iter(rows.groupby([*groups, "policy"], sort=False)))
    first = rows[groups[0]].iloc[0] if groups else None
    for names, runs in by_names.items():
        line = {**dict(zip([*groups, "policy"], names, strict=True)), "n": len(runs)}
        line |= means_over_seeds(runs[measures])
        others = by_names.get((first, *names[1:]), runs)
        if others is not runs:
            line |= difference(runs, others, score)
        lines.append(line)
    return pd.DataFrame(lines)


def difference(runs: pd.DataFrame, others: pd.DataFrame, score: str) -> dict[str, float]:
    """The mean difference of a score by seed, and the probability of improvement, with their
    intervals."""
    pairs = runs[["seed", score]].merge(others[["seed", score]], on="seed")
    if pairs.empty:
        return {}
    new = pairs[f"{score}_x"]
    old = pairs[f"{score}_y"]
    sign = sign_of(score)
    found = means_over_seeds(pd.DataFrame({"difference": new - old}))
    return found | improvement(sign * new.to_numpy(), sign * old.to_numpy())


def as_table(lines: pd.DataFrame, groups: Sequence[str], score: str = "return") -> str:
    """Lines of means as a Markdown table, with a note on its columns."""
    head = [*groups, "policy", "n"]
    known = [name.removesuffix("_low") for name in map(str, lines) if name.endswith("_low")]
    measures = [name for name in known if name not in ("difference", "improvement")]
    columns = {name: name for name in measures}
    note = NOTE
    if "difference" in lines:
        columns |= {"difference": "difference", "improvement": "P > first"}
        note += DIFFERENCE.format(score=score, first=f"{groups[0]}={lines[groups[0]].iloc[0]}")
    cells = [
        [*(line[name] for name in head), *(shown(line, name) for name in columns)]
        for line in lines.to_dict("records")
    ]
    return markdown_table([*head, *columns.values()], cells, left=len(groups) + 1) + f"\n\n{note}"
