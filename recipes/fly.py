"""Fly episodes and keep each as file, film, figure or page: what is true, and what the server believes.

damian fly checkpoint=runs/first eval_episodes=200 keep=extremes "formats=[mp4]" "views=[2d,3d]"
damian fly "replay=[runs/undelayed/episode_0.json,runs/late/episode_0.json]"   (in one page, side by side)
damian fly journal=north.jsonl "formats=[html]"    (the flight of real UAVs)
damian fly scenario=coverage agents=100 "shown=[4,17]"    (films tell these UAVs from the others)
"""

from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.animation import FFMpegWriter
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from damian.baselines.random import random_policy
from damian.baselines.script import script_policy
from damian.common import checks
from damian.envs.pipeline import make_env
from damian.envs.uav_env import EXTRAS
from damian.models.memory import add_recurrent_state
from damian.show.episode import Episode, record
from damian.show.film import save_film, save_picture
from damian.show.geojson import origin_of, save_geojson
from damian.show.replay_page import save_page

from . import cli
from .config import FILMS, FlyConfig
from .evaluate import stored_actor
from .shared.runs import save_config, start


def fly(config: FlyConfig) -> list[Episode]:
    """Fly ``eval_episodes`` episodes, or take those that the journal tells."""
    if config.journal is not None:
        return episodes_of_journal(config)
    env = make_env(config, config.eval_episodes, config.eval_seed, config.device, EXTRAS)
    likely = config.flown == "deterministic"
    if config.learnt:
        policy: TensorDictModuleBase = stored_actor(config, env)
        add_recurrent_state(env, policy)
    else:
        policy = script_policy(env) if config.flown == "script" else random_policy(env)
    with set_exploration_type(ExplorationType.DETERMINISTIC if likely else ExplorationType.RANDOM):
        rollout = env.rollout(config.horizon, policy, break_when_any_done=False)
    about = {"policy": config.flown, "checkpoint": config.checkpoint, "seed": config.seed}
    return record(rollout, env.uav_env, {**about, "overrides": list(config.overrides)})


def episodes_of_journal(config: FlyConfig) -> list[Episode]:
    """The flight that the journal tells, an episode as long as the same UAVs fly."""
    from damian.field.node import Node, for_uavs  # noqa: PLC0415 (needs pydantic, which only reports do)
    from damian.field.playback import episodes_of  # noqa: PLC0415

    @cache
    def node_of(n_uavs: int) -> Node:
        return Node(for_uavs(config, n_uavs), config.seed, reward_terms=True)

    return episodes_of(Path(str(config.journal)), node_of, {"overrides": list(config.overrides)})


def kept(episodes: list[Episode], which: str) -> dict[str, Episode]:
    """The episodes to keep, by the names of their files; ``which`` is ``all`` or ``extremes``."""
    if which == "all":
        return {f"episode_{number}": episode for number, episode in enumerate(episodes)}
    order = np.argsort([episode.perceived_return for episode in episodes], kind="stable")
    chosen = {"worst": order[0], "median": order[len(order) // 2], "best": order[-1]}
    return {name: episodes[number] for name, number in chosen.items()}


def show(config: FlyConfig, folder: Path) -> None:
    """Replay or fly episodes, or take the flight of a journal, and fill the run folder."""
    films = "mp4" not in config.formats or FFMpegWriter.isAvailable()
    checks.require(films, "formats", "mp4", "needs the program ffmpeg, which is not there; choose gif")
    if config.replay:
        page = folder / "replay.html"
        save_page([Episode.load(Path(file)) for file in config.replay], page)
        print(f"page: {page} ({page.stat().st_size / 1e6:.2g} MB)")
        return
    episodes = kept(fly(config), config.keep)
    if "geojson" in config.formats:
        origin_of(next(iter(episodes.values())))  # refuses a region without a place on Earth
    save_config(config, folder)
    kinds = [kind for kind in config.formats if kind in FILMS]
    for name, episode in tqdm(episodes.items(), unit=" episodes"):
        episode.save(folder / f"{name}.json")
        if "png" in config.formats:
            save_picture(episode, folder / f"{name}.png", config.shown)
        if "html" in config.formats:
            save_page([episode], folder / f"{name}.html")
        if "geojson" in config.formats:
            save_geojson(episode, folder / f"{name}.geojson")
        for kind, view in product(kinds, config.views):
            save_film(episode, folder / f"{name}{'_3d' * (view == '3d')}.{kind}", view, config.shown)
    for name, episode in episodes.items():
        print(summary(name, episode))


def summary(name: str, episode: Episode) -> str:
    """One line about an episode."""
    n_sent = max(int(episode.sent.sum()), 1)
    age = episode.age[min(episode.n_steps, 1) :]  # of the steps, without the reset
    return (
        f"{name}: {episode.n_steps} steps, perceived return {episode.perceived_return:.2f}"
        f"{', success' if episode.success else ''}; mean age {age.mean():.2f} s, "
        f"messages late {episode.late.sum() / n_sent:.1%}, lost {episode.lost.sum() / n_sent:.1%}"
    )


@cli.program("fly")
def main(given: DictConfig) -> None:
    start(show, given, "fly")
