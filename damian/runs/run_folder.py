"""Files of a run folder: their names, its lock, and the table of results."""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from filelock import FileLock, Timeout
from scipy.special import stdtrit
from torch import Tensor

from damian.common import checks
from damian.common.atomic_files import not_linked, write_atomically, writing
from damian.common.errors import InputError
from damian.common.tables import markdown_table, read_csv, write_csv
from damian.runs.measures import BUILT_IN, declared
from damian.runs.metrics import Evaluation

CHECKPOINT = "checkpoint.pt"
BEST = "best.pt"
REPLAY = "replay"
CONFIG = "config.yaml"
RESULTS = "result.csv"
TABLE = "result.md"
EXPORT = "export"
FAILED = "failed.json"
"""Words and error of a run of a sweep that was refused or could not go on."""
TRAINED = "trained"
UNTRAINED = "untrained"
SCRIPT = "script"
RANDOM = "random"
PLANNER = "planner"
DETERMINISTIC = ", deterministic"
"""Ending of the name of a policy whose most likely actions are taken, not drawn from its
distribution."""


def check_no_links(folder: Path) -> None:
    """Refuse a folder in which a link stands where a run reads, writes or deletes, before it does
    so."""
    for each in (folder, folder / REPLAY, folder / EXPORT):
        for path in each.iterdir() if each.is_dir() else ():
            not_linked(path)


LATE = """perceived: as far as the server knew; all else as it truly was; age: mean age of the messages at the
server [steps]; late and lost: shares of the messages."""
"""Lines under a table of evaluations in which messages are delayed."""


def save_results(
    rows: dict[str, Evaluation], folder: Path, can_succeed: bool, late: bool, note: str
) -> str:
    """Write evaluations by policy to ``result.csv`` and, as the returned table, to
    ``result.md``."""
    below = "\n".join(filter(None, [differences(rows), note, LATE if late else ""]))
    table = results_table(rows, can_succeed, late) + (f"\n\n{below}" if below else "")
    write_atomically(folder / TABLE, table + "\n")
    cells = pd.DataFrame([{"policy": name, **each} for name, each in rows.items()])
    write_csv(folder / RESULTS, cells)  # last: with it, a run counts as finished
    return table


class Interval(NamedTuple):
    """The mean of independent values, and its 95 % interval (Student's)."""

    mean: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Tensor) -> "Interval":
        """From values [n]; a single one has no interval, nan."""
        mean = values.mean().item()
        student = float(stdtrit(len(values) - 1, 0.975)) if len(values) > 1 else math.nan
        half = student * values.std(correction=min(1, len(values) - 1)).item()
        half /= math.sqrt(len(values))
        return cls(mean, mean - half, mean + half)

    def __str__(self) -> str:
        interval = "" if math.isnan(self.low) else f" [{self.low:.2f}, {self.high:.2f}]"
        return f"{self.mean:.2f}{interval}"


def differences(rows: Mapping[str, Evaluation]) -> str:
    """A sentence for each policy on its returns beside those of the script, in the same
    episodes."""
    others = {name: row for name, row in rows.items() if name not in (SCRIPT, RANDOM)}
    if SCRIPT not in rows:
        return ""
    if len(rows[SCRIPT].returns) == 1:
        return (
            "one episode has no interval: for the difference to the script set eval_episodes=200\n"
        )
    sentences = []
    for name, evaluation in others.items():
        gain = evaluation.returns - rows[SCRIPT].returns
        more, less = Interval.of(gain), Interval.of(-gain)
        if more.low > 0:
            sentences.append(f"{name}: better than the script by {more}.")
        elif less.low > 0:
            sentences.append(f"{name}: the script is better by {less}.")
        else:
            sentences.append(f"{name}: no difference to the script can be seen, {more}.")
    return "\n".join([*sentences, ""])


def read_results(path: Path) -> pd.DataFrame:
    """Evaluations as a run or a comparison has written them, one in a row.

    A metric that did not exist when the table was written has an empty column.
    """
    table = read_csv(path, text=("task", "delay", "method", "regime", "policy"))
    return table.reindex(columns=list(dict.fromkeys((*table, *BUILT_IN)))) if len(table) else table


def measured_in(table: pd.DataFrame, score: str) -> list[str]:
    """Metrics of a table of evaluations, the columns behind the number of episodes, first the
    score."""
    names = [*map(str, table)]
    metrics = names[names.index("episodes") + 1 :]
    checks.require(score in metrics, "score", score, f"is not stored, only {', '.join(metrics)}")
    return [score, *(name for name in metrics if name != score)]


def results_table(rows: dict[str, Evaluation], can_succeed: bool, late: bool) -> str:
    """Evaluations of policies as a Markdown table; NAME``, deterministic`` gives columns of NAME's
    line."""
    hidden = {*["success"] * (not can_succeed), *["late"] * (not late)}
    names = [name for name in next(iter(rows.values())) if name != "episodes"]
    measures = [n for n in names if "run" in declared(n).tables and declared(n).where not in hidden]
    likely = any(name.endswith(DETERMINISTIC) for name in rows)
    likely = [name for name in measures if likely and declared(name).where != "late"]
    lines = []
    for name, evaluation in rows.items():
        if not name.endswith(DETERMINISTIC):
            other = rows.get(name + DETERMINISTIC)
            numbers = [f"{evaluation[measure]:.2f}" for measure in measures]
            numbers[measures.index("return")] = str(Interval.of(evaluation.returns))
            numbers += [f"{other[measure]:.2f}" if other else "" for measure in likely]
            lines.append([name, *numbers])
    shown = [f"{name} [95 %]" if name == "return" else name for name in measures]
    head = ["policy", *shown, *(f"{measure}, deterministic" for measure in likely)]
    return markdown_table([title.replace("_", " ") for title in head], lines)


LOCK = ".lock"
"""The file that is locked; a process that was killed leaves it in the folder, where it does no
harm."""


@contextmanager
def locked(folder: Path, key: str = "hydra.run.dir") -> Iterator[None]:
    """Lock a folder for what is done inside; the lock ends with the process, however that ends."""
    check_no_links(folder)
    lock = FileLock(folder / LOCK, blocking=False, thread_local=False)
    with writing(folder):
        try:
            lock.acquire()
        except Timeout:
            problem = "is in use by another run: wait for its end, or choose another folder"
            raise InputError(f"{key}: {folder} {problem}") from None
    try:
        yield
    finally:
        # While the lock is held: who opened this file before sees that it is gone, and makes a new
        # one.
        with suppress(OSError):  # Windows cannot delete an open file
            (folder / LOCK).unlink()
        lock.release()
