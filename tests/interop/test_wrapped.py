"""Users of Gymnasium and PettingZoo: their own checkers, and what TorchRL's environment does."""

from itertools import product

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test
from torchrl.envs import TransformedEnv
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import check_env_specs

from damian import ObservationDelay, compose_scenario, keys, make_env
from damian.common.errors import InputError
from damian.interop import TASKS, UavGymEnv, UavVectorEnv
from damian.interop.pettingzoo import UavParallelEnv

DELAYS = ["delay=none", "delay=paper", "delay.act=2", "delay.rew=1", "delay.history=3"]
KINDS = product(TASKS, ("discrete", "continuous"), ("instant", "polynomial"))
KINDS = [(*kind, delay) for kind, delay in zip(KINDS, 4 * DELAYS, strict=True)][::3]
"""Every task, kind of action, motion and delay, together in turns."""


def made(*overrides, **options):
    return UavParallelEnv(compose_scenario(*overrides), **options)


@pytest.mark.sample(4)
@pytest.mark.parametrize(("task", "actions", "motion", "delay"), KINDS)
def test_gymnasiums_checker_finds_nothing(task, actions, motion, delay):
    overrides = [f"actions={actions}", f"motion={motion}", delay]
    env = gymnasium.make(f"damian/{task.capitalize()}-v0", overrides=overrides)
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.sample(8)
@pytest.mark.parametrize(("task", "actions", "motion", "delay"), KINDS)
def test_pettingzoos_checkers_find_nothing(task, actions, motion, delay, capsys):
    overrides = [
        f"scenario={task}",
        f"actions={actions}",
        f"motion={motion}",
        delay,
        "episode.max_steps=4",
    ]
    parallel_api_test(made(*overrides), num_cycles=6)
    parallel_seed_test(lambda: made(*overrides))
    assert "Passed Parallel API test" in capsys.readouterr().out


def test_gymnasiums_environment_is_pettingzoos_of_one_uav():
    scenario = compose_scenario(
        "scenario=tracking", "agents=1", "delay=paper", "episode.max_steps=8"
    )
    env = UavGymEnv(scenario, seed=3)
    other = UavParallelEnv(scenario, seed=3)
    (observation, info), (observations, _) = env.reset(seed=7), other.reset(seed=7)
    told = [0.0, False, False]
    while not any(told[1:]):
        assert np.array_equal(observation, observations["uav_0"])
        action = env.action_space.sample(info["action_mask"])
        observation, *told, info = env.step(action)
        observations, *others, infos = other.step({"uav_0": action})
        assert told == [each["uav_0"] for each in others]
        legal = infos["uav_0"]["action_mask"]
        assert info["action_mask"].tolist() == legal.tolist()
        info["action_mask"][0] ^= 1  # an agent may write over what it is told
        assert env.action_masks().tolist() == legal.tolist()
        info["action_mask"][0] ^= 1
    assert told[1:] == [False, True]


def test_pettingzoos_environment_does_what_torchrls_does():
    scenario = compose_scenario("delay=paper", "episode.max_steps=8")
    env = UavParallelEnv(scenario, seed=3)
    reference = make_env(scenario, 1, seed=3)
    reference.seed_worlds(torch.tensor([5]))
    now = reference.reset()
    observations, infos = env.reset(seed=5)
    for _ in range(8):
        for number, agent in enumerate(env.possible_agents):
            assert np.array_equal(observations[agent], now[keys.OBSERVATION][0, number].numpy())
            assert np.array_equal(
                infos[agent]["action_mask"], now[keys.ACTION_MASK][0, number].numpy()
            )
        assert np.array_equal(env.state(), now[keys.GLOBAL_OBSERVATION][0].flatten().numpy())
        chosen = {
            name: env.action_space(name).sample(infos[name]["action_mask"]) for name in env.agents
        }
        now[keys.ACTION] = torch.tensor([[*chosen.values()]])
        now = reference.step(now)["next"]
        observations, rewards, terminated, truncated, infos = env.step(chosen)
        assert [*rewards.values()] == now[keys.REWARD].flatten().tolist()
        assert {*terminated.values()} == {now["terminated"].item()}
        assert {*truncated.values()} == {now["truncated"].item()}
        if now["done"].item():
            break
    assert now["done"].item()
    assert env.agents == []
    assert env.step({}) == ({}, {}, {}, {}, {})


@pytest.mark.sample(2)
@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_every_world_of_the_vector_environment_equals_a_single_one(actions):
    options = {"overrides": [f"actions={actions}", "delay=paper", "episode.max_steps=5"]}
    vector = gymnasium.make_vec("damian/Spotting-v0", num_envs=2, **options)
    singles = [gymnasium.make("damian/Spotting-v0", **options) for _ in range(2)]
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


def test_torchrl_reads_the_environment_and_our_transforms_delay_it_further():
    env = PettingZooWrapper(made("episode.max_steps=5"), use_mask=True)
    check_env_specs(env, break_when_any_done="both")
    delayed = TransformedEnv(env, ObservationDelay(2, in_keys=[("uav", "observation")]))
    assert delayed.rollout(4)["next", "uav", "age"].max() == 2


def test_a_picture_shows_what_a_film_of_the_episode_shows():
    env = gymnasium.make("damian/Spotting-v0", render_mode="rgb_array", overrides=["delay.obs=2"])
    env.reset(seed=0)
    first = env.render()
    env.step(env.action_space.sample())
    assert first.shape == (690, 720, 3)
    assert first.dtype == np.uint8
    assert not np.array_equal(first, env.render())
    env.reset(seed=0)
    assert np.array_equal(first, env.render())


def test_what_a_user_can_get_wrong_is_said_in_one_line():
    with pytest.raises(InputError, match=r"agents: 2 is not 1.*UavParallelEnv"):
        gymnasium.make("damian/Spotting-v0", overrides=["agents=2"])
    alone = compose_scenario("agents=1")
    with pytest.raises(InputError, match="render_mode: human is not one of rgb_array"):
        UavGymEnv(alone, render_mode="human")
    vector = UavVectorEnv(alone, 2)
    with pytest.raises(InputError, match="seed"):
        vector.reset(seed=[1, 2])
    vector.reset()
    with pytest.raises(InputError, match="actions"):
        vector.step([0])
    env = made()
    env.reset()
    with pytest.raises(InputError, match="action of uav_1: -1 is not in Discrete"):
        env.step({"uav_0": 0, "uav_1": -1, "uav_2": 0})
