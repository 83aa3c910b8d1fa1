"""Numbers of a training, written row by row: ``metrics.csv``, TensorBoard events, the user's own loggers."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from damian.common.atomic_files import writing
from damian.common.errors import InputError, naming_errors
from damian.common.tables import read_csv, write_csv
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
        stored = read_metrics(folder)
        stored = stored[stored[_FIRST_COLUMN] <= frames]
        self.rows: list[dict[Any, Any]] = stored.to_dict("records")
        self._columns = [*stored.columns] if self.rows else []
        if self._path:
            write_csv(self._path, pd.DataFrame(self.rows))
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
            write_csv(self._path, pd.DataFrame(self.rows))
        elif self._path:
            line = pd.DataFrame([row], columns=self._columns)
            with writing(self._path):
                line.to_csv(self._path, mode="a", header=False, index=False, na_rep="nan")

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


def read_metrics(folder: Path) -> pd.DataFrame:
    """The rows of a run's ``metrics.csv``, if there is one, without an unfinished last line."""
    path = folder / METRICS
    table = read_csv(path) if path.exists() else pd.DataFrame()
    if len(table) and _FIRST_COLUMN not in table:
        raise InputError(f"{path}: it has no column {_FIRST_COLUMN}")
    return table if len(table) else pd.DataFrame({_FIRST_COLUMN: []}, dtype=float)
