"""Numbers of a training, written row by row: ``metrics.csv``, TensorBoard events, the user's own loggers."""

import csv
import io
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from damian.common.atomic_files import write_atomically, writing
from damian.common.errors import InputError, naming_errors
from damian.runs.loggers import Logger

METRICS = "metrics.csv"
_FIRST_COLUMN = "frames"


class MetricsLog:
    """Writes named numbers to ``metrics.csv``, TensorBoard and other loggers; a resumed run appends to them.

    A number that a row lacks is nan; rows after ``frames``, where a run resumes, are dropped.
    """

    def __init__(
        self,
        folder: Path,
        tensorboard: bool,
        to_csv: bool,
        frames: int = 0,
        loggers: Sequence[Logger] = (),
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        self._folder, self._loggers, self._settings = folder, loggers, settings or {}
        self._path = folder / METRICS if to_csv else None
        self.rows = [row for row in read_metrics(folder) if row["frames"] <= frames]
        self._columns = [*self.rows[0]] if self.rows else []
        if self._path:
            write_atomically(self._path, self._text(self.rows, head=True) if self.rows else "")
        # TensorBoard does not show what older files hold of steps from ``purge_step`` on.
        purge_step = frames + 1 if frames else None
        self._events = SummaryWriter(str(folder), purge_step=purge_step) if tensorboard else None
        self._call("log_hparams", dict(self._settings))

    def show(self, frames: int, numbers: Mapping[str, float]) -> None:
        """Give numbers to TensorBoard and the loggers alone, by names in groups such as ``train/kl``."""
        tags = {name if "/" in name else f"train/{name}": number for name, number in numbers.items()}
        for tag, number in tags.items():
            self._call("log_scalar", tag, number, frames)
            if self._events:
                self._add_settings(tags)
                self._events.add_scalar(tag, number, frames)

    def add(self, frames: int, numbers: Mapping[str, float]) -> None:
        """Log numbers by name, after so many environment steps over all worlds."""
        self.show(frames, numbers)
        row = {_FIRST_COLUMN: float(frames), **numbers}
        self.rows.append(row)
        new = [name for name in row if name not in self._columns]
        self._columns += new
        if self._path and new:  # a learner may log more once it has begun to learn
            write_atomically(self._path, self._text(self.rows, head=True))
        elif self._path:
            with writing(self._path), self._path.open("a", encoding="utf-8", newline="") as file:
                file.write(self._text([row]))

    def sync(self) -> None:
        """Make the rows last, even if the machine stops; a checkpoint comes after its rows."""
        if self._events:
            self._events.flush()
        if self._path:
            with writing(self._path), self._path.open("rb") as file:
                os.fsync(file.fileno())

    def close(self) -> None:
        """Close all files, and all loggers that can be closed."""
        if self._events:
            self._events.close()
        self._call("close")

    def _call(self, method: str, *arguments: Any) -> None:
        """Call a method of each logger that has it."""
        for logger in self._loggers:
            if hasattr(logger, method):
                with naming_errors(f"logger {type(logger).__name__}"):
                    getattr(logger, method)(*arguments)

    def _add_settings(self, numbers: Mapping[str, float]) -> None:
        """Give TensorBoard the settings, once; its table of runs needs the names of the numbers too."""
        if self._settings:
            kinds = (bool, int, float)
            plain = {key: x if isinstance(x, kinds) else str(x) for key, x in self._settings.items()}
            self._settings = {}
            # ``add_hparams`` would write them into a folder of their own.
            for summary in hparams(plain, dict.fromkeys(numbers, 0.0)):
                self._events.file_writer.add_summary(summary)  # type: ignore[union-attr]

    def _text(self, rows: Sequence[Mapping[str, float]], head: bool = False) -> str:
        """Rows as CSV, with the line of the names above them if ``head``."""
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self._columns, restval=math.nan)
        if head:
            writer.writeheader()
        writer.writerows(rows)
        return text.getvalue()


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """The rows of a run's ``metrics.csv``, if there is one, without an unfinished last line."""
    path = folder / METRICS
    if not path.exists():
        return []
    try:
        text = path.read_text(encoding="utf-8")
        reader = csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1]))
        rows = [{name: float(number) for name, number in row.items()} for row in reader]
    except OSError as error:
        raise InputError(f"{path}: it cannot be read: {error.strerror}") from None
    except (TypeError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: it is not a table of numbers ({error})") from None
    if rows and _FIRST_COLUMN not in rows[0]:
        raise InputError(f"{path}: it has no column {_FIRST_COLUMN}")
    return rows
