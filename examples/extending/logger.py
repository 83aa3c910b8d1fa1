"""Your own logger: a file with the share of the way to a return that you hope for.

    cd examples/extending
    damian train "logger.custom=[{logger: logger:Progress, every: 10, goal: 1.0}]"

A logger is called with the run folder, and gets every number that the training logs; its
keyword-only arguments are parameters. TorchRL's loggers fit too, through a function such as
``weights_and_biases``.
"""

from pathlib import Path

from torchrl.record.loggers import Logger


class Progress:
    """Writes every tenth mean return, as a share of the goal, to ``progress.txt``."""

    def __init__(self, folder: Path, *, every: int = 10, goal: float = 1.0) -> None:
        self.file = folder / "progress.txt"
        self.every = every
        self.goal = goal
        self.seen = 0

    def log_scalar(self, name: str, value: float, step: int) -> None:
        if name != "train/hindsight_return":
            return
        if self.seen % self.every == 0:
            with self.file.open("a", encoding="utf-8") as file:
                file.write(f"{step} steps: {value / self.goal:.0%}\n")
        self.seen += 1


def weights_and_biases(folder: Path, *, project: str = "damian", offline: bool = True) -> Logger:
    """TorchRL's logger for Weights & Biases (needs ``pip install wandb``)."""
    from torchrl.record.loggers.wandb import WandbLogger  # noqa: PLC0415 (only if it is chosen)

    return WandbLogger(exp_name=folder.name, project=project, offline=offline, save_dir=str(folder))
