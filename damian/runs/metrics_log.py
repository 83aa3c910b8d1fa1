"""Numbers of a training, written row by row: ``metrics.csv``, TensorBoard events, loggers of one's own."""

import csv
import io
import math
import os
import socket
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensorboard.compat.proto.event_pb2 import Event, SessionLog  # type: ignore[attr-defined]
from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[attr-defined]
from tensorboard.summary.writer.record_writer import RecordWriter
from torch.utils.tensorboard import summary

from damian.common.atomic_files import write_atomically, writing
from damian.common.csv_table import csv_table
from damian.common.errors import InputError, naming_errors
from damian.runs.loggers import BINS, Logger

METRICS = "metrics.csv"
_FIRST_COLUMN = "frames"
EVENTS = "events.out.tfevents."
"""Beginning of the names of TensorBoard's files."""


class MetricsLog:
    """Writes named numbers to ``metrics.csv``, TensorBoard and other loggers; a resumed run appends to them.

    All rows have the same columns: a number that a row lacks is nan, as where a run of an older damian, which
    logged fewer of them, is resumed.

    Args:
        folder: the run folder.
        tensorboard: whether to write TensorBoard events.
        to_csv: whether to write ``metrics.csv``.
        frames: environment steps, over all worlds, at the checkpoint from which the run resumes; rows of
            later steps are dropped.
        loggers: further loggers, which get every number.
        settings: all settings by dotted key; hyperparameters for TensorBoard and the other loggers.

    Raises:
        InputError: the rows of the run cannot be read.
        RunError: a file cannot be written.
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
        self._loggers, self._settings = loggers, settings or {}
        self._path = folder / METRICS if to_csv else None
        self.rows = [row for row in read_metrics(folder) if row["frames"] <= frames]
        if self._path and self.rows:
            write_atomically(self._path, _table(self.rows))
        elif self._path:
            with writing(self._path):
                self._path.unlink(missing_ok=True)
        self._events = EventFile(folder, frames) if tensorboard else None
        for logger, log_hparams in self._methods("log_hparams"):
            with naming_errors(f"logger {type(logger).__name__}"):
                log_hparams(self._settings)

    def add(self, frames: int, numbers: dict[str, float]) -> None:
        """Log numbers by name, after so many environment steps over all worlds.

        Raises:
            RunError: a file cannot be written.
        """
        for name, number in numbers.items():
            for logger in self._loggers:
                with naming_errors(f"logger {type(logger).__name__}"):
                    logger.log_scalar(name, number, frames)
        if self._events:
            if self._settings:  # TensorBoard's table of runs needs the names of the numbers
                self._events.add_hparams(self._settings, numbers)
                self._settings = {}
            self._events.add(frames, numbers)
        known = dict.fromkeys(self.rows[0], math.nan) if self.rows else {}
        row = {**known, _FIRST_COLUMN: float(frames), **numbers}
        if self.rows and len(row) > len(known):
            columns = dict.fromkeys(row, math.nan)
            self.rows[:] = [columns | older for older in self.rows]
            if self._path:
                write_atomically(self._path, _table(self.rows))
        self.rows.append(row)
        if self._path:
            with writing(self._path), self._path.open("a", newline="") as file:
                head = [row] if file.tell() == 0 else []
                file.write(csv_table([*head, row.values()]))

    def add_histogram(self, frames: int, name: str, values: NDArray[np.floating]) -> None:
        """Log a distribution of values [K], after so many environment steps over all worlds."""
        if self._events:
            self._events.add_histogram(frames, name, values)
        for logger, log_histogram in self._methods("log_histogram"):
            with naming_errors(f"logger {type(logger).__name__}"):
                log_histogram(name, values, frames)

    def add_film(self, frames: int, path: Path) -> None:
        """Show a film, a GIF, in TensorBoard, after so many environment steps."""
        if self._events:
            self._events.add_film(frames, "evaluation", path.read_bytes())

    def sync(self) -> None:
        """Make the rows last, even if the machine stops; a checkpoint comes after its rows."""
        if self._path and self._path.exists():
            with writing(self._path), self._path.open("rb") as file:
                os.fsync(file.fileno())

    def close(self) -> None:
        """Close all files, and all loggers that can be closed."""
        if self._events:
            self._events.close()
        for logger, close in self._methods("close"):
            with naming_errors(f"logger {type(logger).__name__}"):
                close()

    def _methods(self, name: str) -> Iterator[tuple[Logger, Any]]:
        """The loggers that have a method of this name, with the method."""
        return ((logger, getattr(logger, name)) for logger in self._loggers if hasattr(logger, name))


class EventFile:
    """A file of TensorBoard events, written at once: without a thread, an error can stop the run.

    Args:
        folder: the run folder.
        frames: environment steps from which the run resumes: TensorBoard hides later ones of older files.

    Raises:
        RunError: the file cannot be written.
    """

    def __init__(self, folder: Path, frames: int = 0) -> None:
        self._path = folder / f"{EVENTS}{time.time_ns()}.{socket.gethostname()}.{os.getpid()}"
        with writing(self._path):
            self._file = self._path.open("wb")
        self._records = RecordWriter(self._file)
        self._write(Event(file_version="brain.Event:2"))
        if frames:
            self._write(Event(step=frames + 1, session_log=SessionLog(status=SessionLog.START)))

    def add(self, frames: int, numbers: Mapping[str, float]) -> None:
        """Write numbers by name, after so many environment steps."""
        values = [Summary.Value(tag=name, simple_value=number) for name, number in numbers.items()]
        self._write(Event(step=frames, summary=Summary(value=values)))

    def add_film(self, frames: int, name: str, gif: bytes) -> None:
        """Write a film under a name, after so many environment steps; it is among TensorBoard's images."""
        image = Summary.Image(colorspace=3, encoded_image_string=gif)
        summary = Summary(value=[Summary.Value(tag=name, image=image)])
        self._write(Event(step=frames, summary=summary))

    def add_histogram(self, frames: int, name: str, values: NDArray[np.floating]) -> None:
        """Write a distribution of values [K] under a name, after so many environment steps."""
        self._write(Event(step=frames, summary=summary.histogram(name, values, bins=BINS)))

    def add_hparams(self, settings: Mapping[str, Any], names: Collection[str]) -> None:
        """Write settings by dotted key, and the names of the numbers by which runs are compared."""
        plain = {
            key: each if isinstance(each, bool | int | float) else str(each) for key, each in settings.items()
        }
        for each in summary.hparams(plain, dict.fromkeys(names, 0.0)):
            self._write(Event(summary=each))

    def close(self) -> None:
        with writing(self._path):
            self._file.close()

    def _write(self, event: Event) -> None:
        event.wall_time = time.time()
        with writing(self._path):
            self._records.write(event.SerializeToString())
            self._file.flush()


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """Read the rows of a run's ``metrics.csv``; an empty list if the file does not exist.

    A last line without an end is not read: a killed run leaves it behind.

    Raises:
        InputError: the file has no column ``frames``, or a row that is not all numbers.
    """
    path = folder / METRICS
    if not path.exists():
        return []
    try:
        text = path.read_bytes().decode()
    except (OSError, UnicodeDecodeError) as error:
        problem = "it is not text" if isinstance(error, ValueError) else error.strerror
        raise InputError(f"{path}: it cannot be read: {problem}") from None
    reader = csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1], newline=""))
    try:
        if not _FIRST_COLUMN.startswith(text[: len(_FIRST_COLUMN)]):
            raise InputError(f"{path}, line 1: no column frames")
        return [{name: float(number) for name, number in row.items()} for row in reader]
    except InputError:
        raise
    except (TypeError, ValueError, csv.Error) as error:
        line = f"{path}, line {reader.line_num}"
        raise InputError(f"{line}: not a row of numbers ({error})") from None


def _table(rows: Sequence[Mapping[str, float]]) -> str:
    """Rows with the same columns, and the line of their names, as a CSV file."""
    return csv_table([rows[0], *(row.values() for row in rows)])
