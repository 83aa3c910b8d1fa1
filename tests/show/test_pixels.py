"""Filming while an environment runs, through TorchRL's own recorder."""

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs
from torchrl.record import VideoRecorder

from damian.baselines.random import random_policy
from damian.common.errors import InputError
from damian.envs.pipeline import make_env
from damian.envs.scenario import DelayConfig, ScenarioConfig
from damian.show.episode import record
from damian.show.film import Film
from damian.show.pixels import FilmPixels

EXTRAS = ["message", "state", "reward_terms"]


class Kept:
    """A logger that keeps the videos."""

    def __init__(self) -> None:
        self.videos: dict[str, torch.Tensor] = {}

    def log_video(self, name: str, video: torch.Tensor, **_: object) -> None:
        self.videos[name] = video


def test_torchrls_recorder_films_what_a_film_of_the_episode_shows():
    scenario = ScenarioConfig(delay=DelayConfig(obs=2))
    env, logger = make_env(scenario, 1, seed=0, extras=EXTRAS), Kept()
    env.append_transform(FilmPixels(env.uav_env))
    env.append_transform(VideoRecorder(logger, tag="flight", skip=1, make_grid=False))
    rollout = env.rollout(3, random_policy(env))
    env.transform.dump()
    video = logger.videos["flight"]
    assert video.shape[-4:] == (4, 3, 700, 720)
    film = Film(record(rollout, env.uav_env, {})[0])
    last = np.moveaxis(video.reshape(-1, 3, 700, 720)[-1].numpy(), 0, -1)
    assert np.array_equal(last, film.frame(3))
    again = env.rollout(2, random_policy(env))
    film = Film(record(again, env.uav_env, {})[0])
    assert np.array_equal(again["next", "pixels"][0, -1].numpy(), film.frame(2))


def test_the_pixels_are_in_the_specs():
    env = make_env(ScenarioConfig(), 1, seed=0, extras=EXTRAS)
    env.append_transform(FilmPixels(env.uav_env, view="3d"))
    check_env_specs(env)


@pytest.mark.parametrize(
    ("n_worlds", "extras", "view", "message"),
    [
        (2, EXTRAS, "2d", "number of worlds: 2 is not 1"),
        (1, ["message"], "2d", "lack state"),
        (1, EXTRAS, "4d", "view: 4d is not one of 2d, 3d"),
    ],
)
def test_what_cannot_be_filmed_is_refused(n_worlds, extras, view, message):
    env = make_env(ScenarioConfig(), n_worlds, extras=extras)
    with pytest.raises(InputError, match=message):
        FilmPixels(env.uav_env, view)
