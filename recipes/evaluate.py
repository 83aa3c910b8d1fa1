"""Fly a trained policy: as it was trained, or with more UAVs, other delays, another region.

    python recipes/evaluate.py checkpoint=runs/2026-01-31_12-00-00 agents=10 delay=paper
    python recipes/evaluate.py -m checkpoint=runs/2026-01-31_12-00-00 delay.obs=0,2,4,8

Overrides of the training run hold where no others are given; what the actor sees must stay the same. The run
folder gets config.yaml, result.csv and result.md.
"""

from pathlib import Path

import hydra
from omegaconf import DictConfig
from shared.launch import launch, load, perform, prepare, reported, save_config
from shared.settings import CONF, TrainConfig
from torchrl.checkpoint import Checkpoint
from torchrl.modules import ProbabilisticActor
from train import make_eval_env, report

from damian.common.errors import InputError
from damian.envs.delayed_env import DelayedEnv
from damian.learners.networks import make_actor


def fly(config: TrainConfig, folder: Path) -> None:
    """Evaluate the policy of ``config.checkpoint``, and fill the folder."""
    env, actor = stored(config)
    save_config(config, folder)
    report(config, folder, env, actor)


def stored(config: TrainConfig) -> tuple[DelayedEnv, ProbabilisticActor]:
    """Where to fly, and the policy of ``config.checkpoint``.

    Raises:
        InputError: there is none, or one that sees or does something else.
    """
    if not config.checkpoint:
        raise InputError("checkpoint: it is missing: the run folder with the policy to fly")
    env = make_eval_env(config)
    actor = make_actor(env, config.model)
    load(Checkpoint(actor=actor), Path(config.checkpoint), "checkpoint")
    return env, actor


@hydra.main(version_base=None, config_path=CONF, config_name="train")
@reported
def main(composed: DictConfig) -> None:
    perform(*prepare(composed), fly)


if __name__ == "__main__":
    launch(main)
