"""Weights & Biases and MLflow, through TorchRL's loggers: ``logger=wandb`` and ``logger=mlflow``."""

import secrets
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torchrl.record.loggers as torchrl_loggers

from damian.common.atomic_files import writing
from damian.common.errors import InputError
from damian.runs.loggers import BINS

ID = "wandb_id.txt"
"""File in a run folder with the id of its W&B run, which a resumed run continues."""


class TorchrlLogger:
    """Passes what a training logs on to a logger of TorchRL's.

    Args:
        logger: one of ``torchrl.record.loggers``.
        finish: ends the run of its library.
        histograms: whether that library takes histograms.
    """

    def __init__(self, logger: Any, finish: Callable[[], Any], histograms: bool) -> None:
        self.logger, self.close, self._histograms = logger, finish, histograms

    def log_scalar(self, name: str, value: float, step: int) -> None:
        self.logger.log_scalar(name, value, step=step)

    def log_hparams(self, settings: Mapping[str, Any]) -> None:
        self.logger.log_hparams(dict(settings))

    def log_histogram(self, name: str, values: Sequence[float], step: int) -> None:
        if self._histograms:
            self.logger.log_histogram(name, values, step=step, bins=BINS)


def wandb(folder: Path, *, project: str = "damian", offline: bool = False) -> TorchrlLogger:
    """A run of Weights & Biases, named as the run folder; a resumed training continues it.

    Args:
        folder: the run folder, which gets ``wandb/``.
        project: the run's project.
        offline: keep everything in the folder, for ``wandb sync``; so does the variable WANDB_MODE=offline.

    Raises:
        InputError: wandb is not installed.
    """
    library, stored = _installed("wandb"), folder / ID
    with writing(stored):
        if not stored.exists():
            stored.write_text(secrets.token_hex(8))
    logger = torchrl_loggers.WandbLogger(
        folder.name, offline, str(folder), stored.read_text().strip(), project, log_env_packages=False
    )
    return TorchrlLogger(logger, library.finish, histograms=True)


def mlflow(
    folder: Path, *, tracking_uri: str = "sqlite:///mlflow.db", experiment: str = "damian"
) -> TorchrlLogger:
    """A run of MLflow, named as the run folder; MLflow takes no histograms.

    Args:
        folder: the run folder.
        tracking_uri: MLflow's store or server.
        experiment: the run's experiment.

    Raises:
        InputError: mlflow is not installed.
    """
    library = _installed("mlflow")
    logger = torchrl_loggers.MLFlowLogger(experiment, tracking_uri)
    library.set_tag("mlflow.runName", folder.name)
    return TorchrlLogger(logger, library.end_run, histograms=False)


def _installed(package: str) -> Any:
    """A package that not everyone needs.

    Raises:
        InputError: it is not installed.
    """
    try:
        return __import__(package)
    except ImportError:
        raise InputError(f"logger: {package} is not installed; pip install {package}") from None
