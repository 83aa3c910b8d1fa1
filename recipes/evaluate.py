"""Fly a trained policy: as it was trained, or with more UAVs, other delays, another region.

    python recipes/evaluate.py checkpoint=runs/2026-01-31_12-00-00 agents=10 delay=paper
    python recipes/evaluate.py -m checkpoint=runs/2026-01-31_12-00-00 delay.obs=0,2,4,8

Overrides of the training run hold where no others are given; what the actor sees must stay the same. The run
folder gets config.yaml, result.csv and result.md.
"""

from pathlib import Path

import hydra
from launch import launch, load, perform, prepare, reported, save_config
from omegaconf import DictConfig
from settings import CONF, TrainConfig
from torchrl.checkpoint import Checkpoint
from torchrl.modules import ProbabilisticActor
from train import report

from damian.delayed import make_env
from damian.errors import InputError
from damian.models import make_actor


def fly(config: TrainConfig, folder: Path) -> None:
    """Evaluate the policy of ``config.checkpoint``, and fill the folder."""
    actor = stored_actor(config)
    save_config(config, folder)
    report(config, folder, actor)


def stored_actor(config: TrainConfig) -> ProbabilisticActor:
    """The policy of ``config.checkpoint``.

    Raises:
        InputError: there is none, or one that sees or does something else.
    """
    if not config.checkpoint:
        raise InputError("checkpoint: it is missing: the run folder with the policy to fly")
    actor = make_actor(make_env(config, 1, config.seed, config.device), config.model)
    load(Checkpoint(actor=actor), Path(config.checkpoint), "checkpoint")
    return actor


@hydra.main(version_base=None, config_path=CONF, config_name="train")
@reported
def main(written: DictConfig) -> None:
    perform(*prepare(written), fly)


if __name__ == "__main__":
    launch(main)
