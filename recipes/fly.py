"""Fly episodes and keep each as file, film, figure or page: what is true, and what the server believes.

    damian fly checkpoint=runs/first
    damian fly scenario=delaybench/tracking delay=paper aware=belief policy=script
    damian fly checkpoint=runs/first eval_episodes=200 keep=extremes "formats=[mp4]" "views=[2d,3d]"
    damian fly journal=journals/north.jsonl "formats=[html,geojson]"
    damian fly "replay=[runs/undelayed/episode_0.json,runs/late/episode_0.json]"

Every override of damian train may be given, except resume; those of the run that checkpoint names apply too.
The run folder gets config.yaml, and for each episode that is kept episode_N.json (docs/episodes.md explains
it), the film episode_N.gif (and episode_N_3d.gif), and episode_N.png: a map, the positions over time, and the
age of information; with keep=extremes they are called best, median and worst. "formats=[html]" makes
episode_N.html, which plays the episode. With a journal of damian advise nothing is flown: the episode is the
flight that it tells. Nor is it with ``replay``, which makes one page, replay.html, that plays stored episodes
side by side: the same seed flown with and without a delay shows what the delay does.
"""

from dataclasses import dataclass, field, fields
from functools import partial
from itertools import product
from pathlib import Path
from typing import ClassVar

import hydra
import numpy as np
from matplotlib.animation import FFMpegWriter
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from damian.baselines.greedy import greedy_policy
from damian.baselines.random import random_policy
from damian.common import checks
from damian.common.errors import InputError
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.envs.uav_env import EXTRAS
from damian.learners.recurrent import add_recurrent_state
from damian.show.belief_figure import plot_beliefs
from damian.show.episode import Episode, record
from damian.show.film import VIEWS, check_gif, save_film
from damian.show.geojson import origin_of, save_geojson
from damian.show.replay_page import MOST, save_page

from .evaluate import stored_actor
from .shared.flown_policy import FlownPolicyConfig
from .shared.inheritance import key_of, without
from .shared.known_settings import CONF
from .shared.launch import checked, composed_with, launch, perform, prepare, reported
from .shared.settings import TrainConfig, store_schema
from .shared.stored_runs import save_config

KEPT = ("all", "extremes")
FORMATS = ("gif", "mp4", "png", "html", "geojson")
FILMS = FORMATS[:2]


@dataclass
class FlyConfig(FlownPolicyConfig):
    """All settings of ``damian fly``: those of ``damian train``, and what to fly and to keep."""

    policies: ClassVar[tuple[str, ...]] = ("sampled", "deterministic", "script", "random")

    eval_episodes: int = 1
    """Episodes to fly."""
    policy: str | None = None
    """The policy of ``checkpoint``: ``sampled`` actions, or its most likely ones (``deterministic``); the
    ``script``; or ``random``. If it is not given: ``sampled`` with a checkpoint, ``script`` without."""
    keep: str = "all"
    """Which episodes to keep: ``all``, or the ``extremes``: the best, the median and the worst by return."""
    formats: list[str] = field(default_factory=lambda: ["gif", "png"])
    """What to make of each: films as ``gif`` or ``mp4`` (which needs ffmpeg), the figure ``png``, ``html``, a
    page that plays it in any browser, and ``geojson`` for map tools, over a real region."""
    views: list[str] = field(default_factory=lambda: ["2d"])
    """Views of the films: ``2d``, from above, and ``3d``, with the space above the region."""
    journal: str | None = None
    """Journal of ``damian advise`` whose flight to show, instead of flying; its settings apply too."""
    span: list[float] | None = None
    """First and last time of the journal to show, since every UAV had reported [s]; all if not given."""

    replay: list[str] = field(default_factory=list)
    """Files of stored episodes to play side by side in one page, instead of flying."""

    def __post_init__(self) -> None:
        super().__post_init__()
        sources = [name for name in ("journal", "replay") if getattr(self, name)]
        checks.require(len(sources) < 2, "replay", self.replay, "does not go with journal: leave one out")
        for source in sources:
            for key, default in (
                ("checkpoint", None),
                ("policy", None),
                ("eval_episodes", 1),
                ("keep", "all"),
            ):
                given = getattr(self, key)
                checks.require(
                    given == default, key, given, f"means nothing with {source}, which flies nothing"
                )
        if self.replay:
            checks.in_range("replay", len(self.replay), 1, MOST, "episodes")
        if self.span is not None:
            good = len(self.span) == 2 and 0 <= self.span[0] < self.span[1] and self.journal is not None
            checks.require(good, "span", self.span, "is not [FIRST, LAST], two times of a journal [s]")
        checks.one_of("keep", self.keep, KEPT)
        for each in self.formats:
            checks.one_of("formats", each, FORMATS)
        for each in self.views:
            checks.one_of("views", each, VIEWS)
        films = [kind for kind in self.formats if kind in FILMS]
        should = f"names no view for the films that formats={films} asks for: choose 2d or 3d"
        checks.require(bool(self.views) or not films, "views", [], should)
        films = "mp4" not in self.formats or FFMpegWriter.isAvailable()
        checks.require(films, "formats", "mp4", "needs the program ffmpeg, which is not there; choose gif")


store_schema("fly_schema", FlyConfig)


def fly(config: FlyConfig) -> list[Episode]:
    """Fly ``eval_episodes`` episodes, or take the one that the journal tells."""
    if config.journal is not None:
        return [episode_of_journal(config)]
    env = make_env(config.eval_scenario, config.eval_episodes, config.eval_seed, config.device, EXTRAS)
    likely = config.flown == "deterministic"
    policy = make_policy(config, env)
    with set_exploration_type(ExplorationType.DETERMINISTIC if likely else ExplorationType.RANDOM):
        rollout = env.rollout(config.horizon, policy, break_when_any_done=False)
    about = {"policy": config.flown, "checkpoint": config.checkpoint, "seed": config.seed}
    return record(rollout, env.uav_env, {**about, "overrides": list(config.overrides)})


def with_settings_of_journal(config: FlyConfig) -> FlyConfig:
    """The settings by which the fleet of the journal was advised, unless others are given now.

    Raises:
        InputError: it is no journal.
    """
    from damian.advice.journal import read_head  # noqa: PLC0415 (needs pydantic, which only advice does)

    from .advise import AdviseConfig  # noqa: PLC0415

    told = read_head(Path(str(config.journal))).about.overrides
    of_advice = {each.name for each in fields(AdviseConfig)} - {each.name for each in fields(TrainConfig)}
    replaced = [*map(key_of, config.overrides), *of_advice, "checkpoint", "eval_episodes"]
    overrides = [*without(told, replaced), *config.overrides]
    settings: FlyConfig = checked(composed_with("fly", overrides), "fly")
    settings.overrides = overrides
    return settings


def episode_of_journal(config: FlyConfig) -> Episode:
    """The flight that the journal tells.

    Raises:
        InputError: the journal is damaged, its fleet never began, or nothing of it lies in the span.
    """
    from damian.advice.fleet import Fleet  # noqa: PLC0415 (needs pydantic, which only advice does)
    from damian.advice.journal import read_head  # noqa: PLC0415
    from damian.advice.node import Node, for_uavs  # noqa: PLC0415
    from damian.advice.playback import episode_of  # noqa: PLC0415

    path = Path(str(config.journal))
    head = read_head(path)
    node = Node(for_uavs(config.eval_scenario, len(head.uavs)), config.seed, reward_terms=True)
    fleet = Fleet(node, head.uavs, greedy_policy(node.env))
    span = None if config.span is None else (config.span[0], config.span[1])
    about = {"policy": head.about.policy, "checkpoint": head.about.checkpoint}
    about |= {"overrides": list(config.overrides), "fleet": head.fleet}
    return episode_of(path, fleet, about, span, partial(tqdm, unit=" lines", delay=1))


def make_policy(config: FlyConfig, env: DelayedEnv) -> TensorDictModuleBase:
    """The policy that flies.

    Raises:
        InputError: the checkpoint cannot be loaded, or the script does not suit the environment.
    """
    if not config.learnt:
        return greedy_policy(env) if config.flown == "script" else random_policy(env)
    actor = stored_actor(config, env)
    add_recurrent_state(env, actor)
    return actor


def kept(episodes: list[Episode], which: str) -> dict[str, Episode]:
    """The episodes to keep, by the names of their files; ``which`` is one of ``KEPT``."""
    if which == "all":
        return {f"episode_{number}": episode for number, episode in enumerate(episodes)}
    order = np.argsort([episode.perceived_return for episode in episodes], kind="stable")
    chosen = {"worst": order[0], "median": order[len(order) // 2], "best": order[-1]}
    return {name: episodes[number] for name, number in chosen.items()}


def show(config: FlyConfig, folder: Path) -> None:
    """Fly episodes and fill the run folder.

    Raises:
        InputError: GeoJSON is asked for, and the region has no place on Earth; or an episode is too long for
            a GIF.
    """
    episodes = kept(fly(config), config.keep)
    if "geojson" in config.formats:
        origin_of(next(iter(episodes.values())))
    if "gif" in config.formats:
        check_gif(max(episodes.values(), key=lambda episode: episode.n_steps))
    save_config(config, folder)
    for name, episode in tqdm(episodes.items(), unit=" episodes"):
        episode.save(folder / f"{name}.json")
        if "png" in config.formats:
            plot_beliefs(episode, folder / f"{name}.png")
        if "html" in config.formats:
            save_page([episode], folder / f"{name}.html")
        if "geojson" in config.formats:
            save_geojson(episode, folder / f"{name}.geojson")
        for kind, view in product([kind for kind in config.formats if kind in FILMS], config.views):
            save_film(episode, folder / f"{name}{'_3d' * (view == '3d')}.{kind}", view)
    for name, episode in episodes.items():
        print(summary(name, episode))


def replay(config: FlyConfig, folder: Path) -> None:
    """Make a page that plays stored episodes side by side, in any browser and without a network.

    Raises:
        InputError: a file is no episode, or has what a page cannot show.
    """
    episodes = [Episode.load(Path(file)) for file in config.replay]
    page = folder / "replay.html"
    try:
        save_page(episodes, page)
    except ValueError as error:  # a number that JSON cannot hold
        raise InputError(f"replay: {error}") from error
    print(f"page: {page} ({page.stat().st_size / 1e6:.2g} MB)")


def summary(name: str, episode: Episode) -> str:
    """One line about an episode."""
    n_sent = max(int(episode.sent.sum()), 1)
    age = episode.age[min(episode.n_steps, 1) :]  # of the steps, without the reset
    return (
        f"{name}: {episode.n_steps} steps, return {episode.perceived_return:.2f}"
        f"{', success' if episode.success else ''}; mean age {age.mean():.2f} s, "
        f"messages late {episode.late.sum() / n_sent:.1%}, lost {episode.lost.sum() / n_sent:.1%}"
    )


@hydra.main(version_base=None, config_path=CONF, config_name="fly")
@reported
def main(composed: DictConfig) -> None:
    if composed.resume is not None:
        raise InputError("resume: nothing is trained; give the run folder as checkpoint")
    config, folder = prepare(composed)
    if composed.journal is not None:
        config = with_settings_of_journal(config)  # type: ignore[arg-type]
    perform(config, folder, replay if composed.replay else show)  # type: ignore[arg-type]


def run() -> None:
    """Run the program with the words of the command line."""
    launch(main, "fly")


if __name__ == "__main__":
    run()
