"""Fly episodes and keep each as file, film, figure or page: what is true, and what the server
believes.

damian fly checkpoint=runs/first eval_episodes=200 keep=extremes "formats=[gif]"
damian fly "replay=[runs/undelayed/episode_0.json,runs/late/episode_0.json]"   (in one page, side by side)
damian fly scenario=coverage agents=100 "shown=[4,17]"    (films tell these UAVs from the others)
"""

from pathlib import Path

import numpy as np
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from damian.baselines.planner import planner_policy
from damian.baselines.random import random_policy
from damian.baselines.script import script_policy
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.envs.uav_env import EXTRAS
from damian.models.memory import add_recurrent_state
from damian.runs.run_folder import PLANNER, SCRIPT
from damian.show.episode import Episode, record
from damian.show.files import save_episode, summary
from damian.show.replay_page import save_page

from . import cli
from .config import FlyConfig
from .evaluate import stored_actor
from .shared.learning import assume
from .shared.runs import save_config, start


def fly(config: FlyConfig) -> list[Episode]:
    """Fly ``eval_episodes`` episodes."""
    env = make_env(config, config.eval_episodes, config.eval_seed, config.device, EXTRAS)
    likely = config.flown == "deterministic"
    if config.learnt:
        policy = stored_actor(config, env)
        add_recurrent_state(env, policy)
    else:
        policy = unlearnt_policy(config, env)
    assume(config, env, policy if config.learnt else None)
    with set_exploration_type(ExplorationType.DETERMINISTIC if likely else ExplorationType.RANDOM):
        rollout = env.rollout(config.horizon, policy, break_when_any_done=False)
    about = {"policy": config.flown, "checkpoint": config.checkpoint, "seed": config.seed}
    return record(rollout, env.uav_env, {**about, "overrides": list(config.overrides)})


def unlearnt_policy(config: FlyConfig, env: DelayedEnv) -> TensorDictModuleBase:
    """The script, the planner, or random actions."""
    if config.flown == PLANNER:
        planner = config.planner
        compile = config.compile is True
        return planner_policy(env, planner.horizon, planner.samples, compile=compile)
    return script_policy(env) if config.flown == SCRIPT else random_policy(env)


def kept(episodes: list[Episode], which: str) -> dict[str, Episode]:
    """The episodes to keep, by the names of their files; ``which`` is ``all`` or ``extremes``."""
    if which == "all":
        return {f"episode_{number}": episode for number, episode in enumerate(episodes)}
    order = np.argsort([episode.perceived_return for episode in episodes], kind="stable")
    chosen = {"worst": order[0], "median": order[len(order) // 2], "best": order[-1]}
    return {name: episodes[number] for name, number in chosen.items()}


def show(config: FlyConfig, folder: Path) -> None:
    """Replay or fly episodes, and fill the run folder."""
    if config.replay:
        page = folder / "replay.html"
        save_page([Episode.load(Path(file)) for file in config.replay], page)
        print(f"page: {page} ({page.stat().st_size / 1e6:.2g} MB)")
        return
    episodes = kept(fly(config), config.keep)
    save_config(config, folder)
    for name, episode in tqdm(episodes.items(), unit=" episodes"):
        save_episode(episode, folder / name, config.formats, config.shown)
    for name, episode in episodes.items():
        print(summary(name, episode))


@cli.program("fly")
def main(given: DictConfig) -> None:
    start(show, given, "fly")
