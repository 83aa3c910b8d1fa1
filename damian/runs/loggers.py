"""Loggers, which get every number that a training logs: the user's own ones, and one of TorchRL's."""

import secrets
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from damian.common import checks
from damian.common.atomic_files import write_atomically
from damian.common.errors import naming_errors
from damian.common.registry import Registry, check_parameters
from damian.runs.config import LoggerConfig


class Logger(Protocol):
    """Receives numbers, as TorchRL's loggers do.

    Further methods are called if it has them: ``log_hparams(settings)`` at the beginning, with every setting
    by its dotted key, and ``close()`` at the end.
    """

    def log_scalar(self, name: str, value: float, step: int) -> None:
        """Log a number.

        Args:
            name: such as ``train/perceived_return``, ``reward/spotted``, or one of the learner's.
            value: the number; nan if it is not known yet.
            step: environment steps so far, over all worlds.
        """
        ...


LOGGERS = Registry[Callable[..., Logger]](
    "logger",
    lambda found: callable(found) and (not isinstance(found, type) or hasattr(found, "log_scalar")),
    "is not a function (folder) -> logger, nor a class with a method log_scalar",
)
"""Loggers by name or ``package.module:Name``: functions or classes that get the run folder."""


def make_loggers(config: LoggerConfig, folder: Path) -> list[Logger]:
    """Make the loggers of ``config.custom``, which are as for ``check_loggers``, for a run folder."""
    loggers = []
    told = {"project": config.wandb.project, "offline": config.wandb.offline}
    for path, make, written in map(_read, config.custom):
        parameters = told | written if make is wandb else written
        with naming_errors(f"logger.custom: {path}"):
            logger = make(folder, **parameters)
            should = "is not a logger: it has no method log_scalar(name, value, step)"
            checks.require(hasattr(logger, "log_scalar"), path, type(logger).__name__, should)
        loggers.append(logger)
    return loggers


def check_loggers(written: Sequence[Any]) -> None:
    """Check loggers, each ``package.module:Name`` or ``{logger: package.module:Name, ...}``."""
    for each in written:
        _read(each)


def _read(written: Any) -> tuple[str, Callable[..., Logger], dict[str, Any]]:
    key, entry = "logger.custom", written if isinstance(written, Mapping) else {"logger": written}
    path, make, parameters = LOGGERS.read(entry, key, "logger")
    check_parameters(make, parameters, path, key)
    missing = make is wandb and not find_spec("wandb")
    checks.require(not missing, "logger", path, "is not installed; pip install wandb")
    return path, make, parameters


@LOGGERS.register("wandb")
def wandb(folder: Path, *, project: str = "damian", offline: bool = False) -> Logger:
    """A run of Weights & Biases, named as the run folder; a resumed training continues it."""
    library = import_module("wandb")
    from torchrl.record.loggers import WandbLogger  # noqa: PLC0415 (takes seconds to import)

    stored = folder / "wandb_id.txt"
    if not stored.exists():
        write_atomically(stored, secrets.token_hex(8))
    number = stored.read_text(encoding="utf-8")
    logger: Any = WandbLogger(folder.name, offline, str(folder), number, project, log_env_packages=False)
    logger.close = library.finish
    return logger
