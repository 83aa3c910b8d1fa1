"""Films of what a policy does while it is still learning."""

from pathlib import Path

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor

from damian.common.atomic_files import writing
from damian.envs.pipeline import make_env
from damian.envs.uav_env import EXTRAS
from damian.learners.recurrent import add_recurrent_state
from damian.settings import TrainConfig
from damian.show.episode import record
from damian.show.film import save_film

FOLDER = "films"


@torch.no_grad()
def film_policy(config: TrainConfig, actor: ProbabilisticActor, frames: int, folder: Path) -> Path:
    """Film an evaluation's first episode, flown by a policy, without any influence on the training.

    Args:
        config: settings of the training.
        actor: the policy; its actions are sampled.
        frames: environment steps that it has learnt from.
        folder: the run folder.

    Returns:
        the film, ``films/FRAMES.gif``.
    """
    path = folder / FOLDER / f"{frames:09d}.gif"
    with writing(path):
        path.parent.mkdir(exist_ok=True)
    env = make_env(config.eval_scenario, 1, config.eval_seed, config.device, EXTRAS)
    add_recurrent_state(env, actor)
    with torch.random.fork_rng(), set_exploration_type(ExplorationType.RANDOM):
        rollout = env.rollout(config.horizon, actor)
    (episode,) = record(rollout, env.uav_env, {"policy": "sampled", "frames": frames})
    save_film(episode, path)
    return path
