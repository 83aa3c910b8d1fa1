"""Settings of what a run writes."""

from dataclasses import dataclass
from typing import Any, ClassVar

from damian.common.fields import Settings, setting


@dataclass
class WandbConfig(Settings):
    """What ``logger=wandb`` is told."""

    section: ClassVar[str] = "logger.wandb"

    project: str = setting("damian", "Project of Weights & Biases.")
    offline: bool = setting(
        False, "Keep everything in the run folder, for ``wandb sync``; so does WANDB_MODE=offline."
    )


@dataclass
class LoggerConfig(Settings):
    """Which files of metrics the training writes into the run folder."""

    section: ClassVar[str] = "logger"

    tensorboard: bool = setting(True, "Write TensorBoard events.")
    csv: bool = setting(True, "Write ``metrics.csv``.")
    wandb: WandbConfig = setting(WandbConfig)
    custom: list[Any] = setting(
        [], "Loggers of your own: package.module:Name, or {logger: package.module:Name, parameter: ...}."
    )
