"""Files of a run folder: metrics, learning curve, table of results."""

import csv
import math
import signal
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

import matplotlib
from torch.utils.tensorboard import SummaryWriter

from damian.common.errors import InputError, naming_errors
from damian.common.markdown import markdown_table
from damian.evaluation.loggers import Logger
from damian.evaluation.metrics import Evaluation

matplotlib.use("Agg")

METRICS = "metrics.csv"
FIGURE = "learning_curve.png"
CHECKPOINT = "checkpoint"
CONFIG = "config.yaml"
RESULTS = "result.csv"
TABLE = "result.md"


class MetricsLog:
    """Writes named numbers to ``metrics.csv``, TensorBoard and other loggers; a resumed run appends to them.

    Args:
        folder: the run folder.
        tensorboard: whether to write TensorBoard events.
        to_csv: whether to write ``metrics.csv``.
        frames: environment steps, over all worlds, at the checkpoint from which the run resumes; rows of
            later steps are dropped.
        loggers: further loggers, which get every number.
    """

    def __init__(
        self,
        folder: Path,
        tensorboard: bool,
        to_csv: bool,
        frames: int = 0,
        loggers: Sequence[Logger] = (),
    ) -> None:
        self._loggers = loggers
        self._path = folder / METRICS if to_csv else None
        purge = frames + 1 if frames else None
        self._writer = SummaryWriter(str(folder), purge_step=purge) if tensorboard else None
        self.rows = [row for row in read_metrics(folder) if row["frames"] <= frames]
        if self._path:
            self._path.unlink(missing_ok=True)
            for row in self.rows:
                self._append(row)

    def add(self, frames: int, numbers: dict[str, float]) -> None:
        """Log numbers by name, after so many environment steps over all worlds."""
        for name, number in numbers.items():
            for logger in self._loggers:
                with naming_errors(f"logger {type(logger).__name__}"):
                    logger.log_scalar(name, number, frames)
            if self._writer:
                self._writer.add_scalar(name, number, frames)
        row = {"frames": float(frames), **numbers}
        self.rows.append(row)
        self._append(row)

    def close(self) -> None:
        """Write the pending TensorBoard events, and close all loggers that can be closed."""
        for logger in filter(None, [self._writer, *self._loggers]):
            with naming_errors(f"logger {type(logger).__name__}"):
                getattr(logger, "close", lambda: None)()

    def _append(self, row: dict[str, float]) -> None:
        if not self._path:
            return
        new = not self._path.exists()
        with self._path.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if new:
                writer.writeheader()
            writer.writerow(row)


class Interrupt:
    """Context in which the first Ctrl-C only sets ``asked``; a second one interrupts the run at once."""

    def __enter__(self) -> "Interrupt":
        self.asked = False
        self._before = signal.signal(signal.SIGINT, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _ask(self, *_: object) -> None:
        self.asked = True
        signal.signal(signal.SIGINT, self._before)


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """Read the rows of a run's ``metrics.csv``; an empty list if the file does not exist.

    Raises:
        InputError: the file has no column ``frames``, or a row that is not all numbers.
    """
    path = folder / METRICS
    if not path.exists():
        return []
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        if "frames" not in (reader.fieldnames or []):
            raise InputError(f"{path}, line 1: no column frames")
        try:
            return [{name: float(number) for name, number in row.items()} for row in reader]
        except (TypeError, ValueError) as error:
            line = f"{path}, line {reader.line_num}"
            raise InputError(f"{line}: not a row of numbers ({error})") from None


def plot_learning_curve(rows: list[dict[str, float]], random: Evaluation, path: Path, title: str) -> None:
    """Draw return and success rate over environment steps, with the random policy as a dashed line."""
    from matplotlib import pyplot as plt  # noqa: PLC0415 (slow to import, needed once)
    from matplotlib.ticker import EngFormatter  # noqa: PLC0415

    panels = [("episode_return", "return", random.episode_return)]
    if any(row["success_rate"] > 0 for row in rows):
        panels.append(("success_rate", "success rate", random.success_rate))
    figure, axes = plt.subplots(1, len(panels), figsize=(5 * len(panels), 3.4), squeeze=False)
    for axis, (name, label, level) in zip(axes[0], panels, strict=True):
        points = [(row["frames"], row[name]) for row in rows if not math.isnan(row[name])]
        mark = "o" if len(points) == 1 else ""  # a line of one point would be invisible
        axis.plot(*zip(*points, strict=True), color="tab:blue", marker=mark, label="while training")
        axis.axhline(level, color="tab:gray", linestyle="--", label="random policy")
        axis.set_xlabel("environment steps, all worlds")
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0][0].legend(loc="best", fontsize="small")
    figure.suptitle(title, fontsize="medium")
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def save_results(
    rows: dict[str, Evaluation], folder: Path, can_succeed: bool, late: bool, note: str = ""
) -> str:
    """Write evaluations by policy to ``result.csv`` and, as a Markdown table, to ``result.md``.

    Args:
        rows: evaluations by name of the policy.
        folder: the run folder.
        can_succeed: as for ``results_table``.
        late: as for ``results_table``.
        note: a line under the table.

    Returns:
        the table, with the note.
    """
    table = results_table(rows, can_succeed, late) + (f"\n\n{note}" if note else "")
    (folder / TABLE).write_text(table + "\n")
    # A run with a ``result.csv`` counts as finished, so that the file must appear complete or not at all.
    unfinished = folder / f"{RESULTS}.part"
    with unfinished.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["policy", *(field.name for field in fields(Evaluation))])
        writer.writeheader()
        writer.writerows({"policy": name, **asdict(row)} for name, row in rows.items())
    unfinished.replace(folder / RESULTS)
    return table


def results_table(rows: dict[str, Evaluation], can_succeed: bool, late: bool = False) -> str:
    """Evaluations of several policies as a Markdown table.

    Args:
        rows: evaluations by name of the policy.
        can_succeed: whether the task can succeed; if so, success rate and steps are shown.
        late: whether messages are delayed; if so, true measures are shown beside those that the server
            perceived, with the age of information and the shares of late and lost messages.
    """
    success = {"success rate": "success_rate", "steps": "steps"} if can_succeed else {}
    columns = success | {"return": "episode_return"}
    if late:
        columns |= {f"true {title}": f"true_{field}" for title, field in success.items()}
        columns |= {"true return": "true_return", "age": "age", "late": "late", "lost": "lost"}
    columns |= {"episodes": "episodes"}
    lines = (
        [name, *(_number(getattr(row, field)) for field in columns.values())] for name, row in rows.items()
    )
    return markdown_table(["policy", *columns], lines)


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.2f}"
