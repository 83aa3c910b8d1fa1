"""Numbers of a training: row by row in ``metrics.csv``, and given to loggers such as
TensorBoard."""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol
from uuid import NAMESPACE_URL, uuid5

import pandas as pd
from torch.utils.tensorboard import SummaryWriter

from damian.common import checks
from damian.common.atomic_files import not_linked
from damian.common.errors import InputError, naming_errors
from damian.common.registry import Registry, check_parameters
from damian.common.tables import read_csv, write_csv
from damian.runs.config import LoggerConfig


class Logger(Protocol):
    """Receives numbers, as TorchRL's loggers do.

    If it has them, ``log_hparams(settings)`` is called at first, with every setting by its dotted
    key, ``flush()`` before a checkpoint, and ``close()`` at the end.
    """

    def log_scalar(self, name: str, value: float, step: int) -> None:
        """Log a number, nan if it is not known yet, by a name such as ``train/perceived_return``.

        ``step`` counts environment steps over all worlds.
        """
        ...


LOGGERS = Registry[Callable[..., Logger]](
    "logger",
    lambda found: callable(found) and (not isinstance(found, type) or hasattr(found, "log_scalar")),
    "is not a function (folder) -> logger, nor a class with a method log_scalar",
)
"""Loggers by name or ``package.module:Name``: functions or classes that get the run folder."""


def make_loggers(config: LoggerConfig, folder: Path, frames: int) -> list[Logger]:
    """Make the loggers of settings.

    Args:
        config: the settings.
        folder: the run folder.
        frames: environment steps that a resumed run has made; TensorBoard drops what it logged of
            later ones.
    """
    loggers: list[Logger] = [TensorBoard(folder, frames)] if config.tensorboard else []
    for path, make, parameters in map(read_logger, config.custom):
        with naming_errors(f"logger.custom: {path}"):
            logger = make(folder, **parameters)
            checks.require(
                hasattr(logger, "log_scalar"),
                path,
                type(logger).__name__,
                "is not a logger: it has no method log_scalar(name, value, step)",
            )
        loggers.append(logger)
    return loggers


class TensorBoard(SummaryWriter):
    """Writes TensorBoard events into the run folder; the files that a resumed run adds belong to
    the same."""

    def __init__(self, folder: Path, frames: int) -> None:
        super().__init__(str(folder), purge_step=frames + 1 if frames else None)

    def log_scalar(self, name: str, value: float, step: int) -> None:
        self.add_scalar(name, value, step)


def read_logger(written: Any) -> tuple[str, Callable[..., Logger], dict[str, Any]]:
    """Path, class and parameters of ``package.module:Name`` or
    ``{logger: package.module:Name, ...}``."""
    key = "logger.custom"
    entry = written if isinstance(written, Mapping) else {"logger": written}
    path, make, parameters = LOGGERS.read(entry, key, "logger")
    check_parameters(make, parameters, path, key)
    return path, make, parameters


@LOGGERS.register("wandb")
def wandb(folder: Path, *, project: str = "damian", offline: bool = False) -> Logger:
    """A run of Weights & Biases, named as the run folder; a resumed training continues it."""
    from torchrl.record.loggers import WandbLogger  # noqa: PLC0415 (takes seconds to import)

    not_linked(folder / "wandb")
    number = uuid5(NAMESPACE_URL, str(folder.resolve())).hex
    logger = WandbLogger(folder.name, offline, str(folder), number, project, log_env_packages=False)
    logger.close = import_module("wandb").finish
    return logger


METRICS = "metrics.csv"
_FIRST_COLUMN = "frames"


class MetricsLog:
    """Gives named numbers to loggers, and writes them to ``metrics.csv`` with each checkpoint and
    at the end.

    A number that a row lacks is nan; rows after ``frames``, where a run resumes, are dropped.
    """

    def __init__(
        self,
        folder: Path,
        to_csv: bool = True,
        frames: int = 0,
        loggers: Sequence[Logger] = (),
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        self._loggers = loggers
        self._path = folder / METRICS if to_csv else None
        stored = read_metrics(folder)
        self.rows: list[dict] = stored[stored[_FIRST_COLUMN] <= frames].to_dict("records")
        self._call("log_hparams", settings or {})

    def show(self, frames: int, numbers: Mapping[str, float]) -> None:
        """Give numbers to the loggers alone, by names in groups such as ``train/kl``."""
        for name, number in numbers.items():
            self._call("log_scalar", name if "/" in name else f"train/{name}", number, frames)

    def add(self, frames: int, numbers: Mapping[str, float]) -> None:
        """Log numbers by name, after so many environment steps over all worlds."""
        self.show(frames, numbers)
        self.rows.append({_FIRST_COLUMN: float(frames), **numbers})

    def sync(self) -> None:
        """Make the rows last, even if the machine stops; a checkpoint comes after its rows."""
        self._call("flush")
        if self._path:
            write_csv(self._path, pd.DataFrame(self.rows))

    def close(self) -> None:
        """Write what has come since, and close all loggers that can be closed."""
        self.sync()
        self._call("close")

    def _call(self, method: str, *arguments: Any) -> None:
        """Call a method of each logger that has it."""
        for logger in self._loggers:
            if hasattr(logger, method):
                with naming_errors(f"logger {type(logger).__name__}"):
                    getattr(logger, method)(*arguments)


def read_metrics(folder: Path) -> pd.DataFrame:
    """The rows of a run's ``metrics.csv``, if there is one."""
    path = folder / METRICS
    table = read_csv(path) if path.exists() else pd.DataFrame()
    if len(table) and _FIRST_COLUMN not in table:
        raise InputError(f"{path}: it has no column {_FIRST_COLUMN}")
    return table if len(table) else pd.DataFrame({_FIRST_COLUMN: []}, dtype=float)
