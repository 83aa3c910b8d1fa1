"""Evaluate a trained policy: as it was trained, or with more UAVs, other delays or another region.

    damian train hydra.run.dir=runs/first
    damian evaluate checkpoint=runs/first agents=10 delay=paper
    damian evaluate -m checkpoint=runs/first delay.obs=0,2,4,8

The overrides of the training run apply too, unless the command line gives others. The features of the actor's
observation must stay the same. The run folder gets config.yaml, result.csv and result.md: success, steps and
return of the trained policy beside the random and the greedy one.
"""

from pathlib import Path

import hydra
from omegaconf import DictConfig
from torchrl.modules import ProbabilisticActor

from damian.common.errors import InputError
from damian.envs.delayed_env import DelayedEnv
from damian.runs.training_state import load_networks

from .shared.known_settings import CONF
from .shared.launch import launch, perform, prepare, reported
from .shared.settings import TrainConfig
from .shared.stored_runs import save_config
from .train import make_eval_env, report


def fly(config: TrainConfig, folder: Path) -> None:
    """Evaluate the policy of ``config.checkpoint`` and fill the run folder."""
    env, actor = stored(config)
    save_config(config, folder)
    report(config, folder, env, actor)


def fly_untrained(config: TrainConfig, folder: Path) -> None:
    """Evaluate the networks before their first update, and fill the run folder."""
    save_config(config, folder)
    report(config, folder, make_eval_env(config))


def stored(config: TrainConfig) -> tuple[DelayedEnv, ProbabilisticActor]:
    """The evaluation environment, and the actor of ``config.checkpoint``.

    Raises:
        InputError: no checkpoint is given, or its actor has other observations, actions or layers.
    """
    checkpoint_of(config)  # a missing one is refused before an environment is made
    env = make_eval_env(config)
    return env, stored_actor(config, env)


def stored_actor(config: TrainConfig, env: DelayedEnv) -> ProbabilisticActor:
    """The actor of ``config.checkpoint``, for an environment.

    Raises:
        InputError: no checkpoint is given, or its actor has other observations, actions or layers.
    """
    actor = config.learner.make_actor(env, config.model)
    load_networks(checkpoint_of(config), "checkpoint", {"actor": actor})
    return actor


def checkpoint_of(config: TrainConfig) -> Path:
    """The run folder, or checkpoint file, with the policy to fly.

    Raises:
        InputError: no checkpoint is given.
    """
    if not config.checkpoint:
        raise InputError("checkpoint: it is missing: the run folder with the policy to fly")
    return Path(config.checkpoint)


@hydra.main(version_base=None, config_path=CONF, config_name="train")
@reported
def main(composed: DictConfig) -> None:
    perform(*prepare(composed), fly)


def run() -> None:
    """Run the program with the words of the command line."""
    launch(main)


if __name__ == "__main__":
    run()
