"""Settings of what a run writes."""

from dataclasses import dataclass
from typing import Any

from damian.common.fields import Settings, setting


@dataclass
class LoggerConfig(Settings):
    """Which files of metrics the training writes into the run folder."""

    section = "logger"

    tensorboard: bool = setting(True, "Write TensorBoard events.")
    csv: bool = setting(True, "Write ``metrics.csv``.")
    custom: list[Any] = setting(
        [],
        "Further loggers: wandb or package.module:Name, or "
        "{logger: wandb, project: ..., offline: true}.",
    )
