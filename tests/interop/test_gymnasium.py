"""One UAV for users of Gymnasium: their own checker, and what the worlds really did."""

from itertools import product

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import damian.interop
from damian import compose_scenario, keys
from damian.common.errors import InputError
from damian.envs.pipeline import make_env
from damian.interop import UavGymEnv, UavVectorEnv

DELAYS = ["delay=none", "delay=paper", "delay.act=2", "delay.rew=1", "delay.history=3"]
KINDS = [
    pytest.param(task, actions, motion, delay, id=f"{task}-{actions}-{motion}-{delay}")
    for (task, actions, motion), delay in zip(
        product(damian.interop.TASKS, ("discrete", "continuous"), ("instant", "polynomial")),
        4 * DELAYS,
        strict=True,
    )
]
"""Every task, kind of action and motion; over them the delays take turns."""


@pytest.mark.sample(3)
@pytest.mark.parametrize(("task", "actions", "motion", "delay"), KINDS[::3])  # every value of each
def test_gymnasiums_checker_finds_nothing(task, actions, motion, delay):
    overrides = [f"actions={actions}", f"motion={motion}", delay]
    env = gymnasium.make(f"damian/{task.capitalize()}-v0", overrides=overrides)
    check_env(env.unwrapped, skip_render_check=True)


def test_the_environment_does_what_the_torchrl_environment_does():
    scenario = compose_scenario("scenario=tracking", "agents=1", "delay=paper", "episode.max_steps=12")
    env = UavGymEnv(scenario, seed=3)
    reference = make_env(scenario, 1, seed=3)
    reference.seed_worlds(torch.tensor([7]))
    now = reference.reset()
    observation, info = env.reset(seed=7)
    ended = False
    while not ended:
        assert np.array_equal(observation, now[keys.OBSERVATION][0, 0].numpy())
        assert np.array_equal(info["action_mask"], now[keys.ACTION_MASK][0, 0].numpy())
        action = env.action_space.sample(info["action_mask"])
        now[keys.ACTION] = torch.tensor([[action]])
        now = reference.step(now)["next"]
        observation, reward, terminated, truncated, info = env.step(action)
        assert reward == now[keys.REWARD].item()
        assert (terminated, truncated) == (now["terminated"].item(), now["truncated"].item())
        ended = terminated or truncated
    assert truncated
    assert not terminated


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_every_world_of_the_vector_environment_equals_a_single_one(actions):
    options = {"overrides": [f"actions={actions}", "delay=paper", "episode.max_steps=5"]}
    vector = gymnasium.make_vec("damian/Spotting-v0", num_envs=3, **options)
    singles = [gymnasium.make("damian/Spotting-v0", **options) for _ in range(3)]
    observations, infos = vector.reset(seed=11)
    for world, env in enumerate(singles):
        observation, info = env.reset(seed=11 + world)
        assert np.array_equal(observations[world], observation)
    vector.action_space.seed(0)
    for _ in range(12):
        chosen = vector.action_space.sample()
        observations, rewards, terminated, truncated, infos = vector.step(chosen)
        for world, env in enumerate(singles):
            observation, reward, *ends, info = env.step(chosen[world])
            assert [rewards[world], terminated[world], truncated[world]] == [reward, *ends]
            if any(ends):
                assert np.array_equal(infos["final_obs"][world], observation)
                assert infos["final_info"]["is_success"][world] == info["is_success"]
                observation, info = env.reset()
            assert np.array_equal(observations[world], observation)
            assert infos["ready"][world] == info["ready"]


def test_a_picture_shows_what_a_film_of_the_episode_shows():
    env = gymnasium.make("damian/Spotting-v0", render_mode="rgb_array", overrides=["delay.obs=2"])
    env.reset(seed=0)
    first = env.render()
    env.step(env.action_space.sample())
    assert first.shape == (640, 720, 3)
    assert first.dtype == np.uint8
    assert not np.array_equal(first, env.render())
    env.reset(seed=0)
    assert np.array_equal(first, env.render())


def test_what_a_user_can_get_wrong_is_said_in_one_line():
    with pytest.raises(InputError, match=r"agents: 2 is not 1.*UavParallelEnv"):
        gymnasium.make("damian/Spotting-v0", overrides=["agents=2"])
    with pytest.raises(InputError, match="scenari"):
        compose_scenario("scenari=tracking")
    with pytest.raises(InputError, match="render_mode: human is not one of rgb_array"):
        UavGymEnv(compose_scenario("agents=1"), render_mode="human")
    vector = UavVectorEnv(compose_scenario("agents=1"), 2)
    with pytest.raises(InputError, match="seed"):
        vector.reset(seed=[1, 2])
    vector.reset()
    with pytest.raises(InputError, match="actions"):
        vector.step([0])
