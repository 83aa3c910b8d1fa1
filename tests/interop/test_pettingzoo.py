"""Several UAVs for users of PettingZoo: its own checkers, and TorchRL reads what we wrap."""

from itertools import product

import numpy as np
import pytest
import torch
from pettingzoo.test import parallel_api_test, parallel_seed_test
from torchrl.envs import TransformedEnv
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import check_env_specs

from damian import ObservationDelay, compose_scenario, keys
from damian.common.errors import InputError
from damian.envs.pipeline import make_env
from damian.interop import TASKS, UavParallelEnv

DELAYS = ["delay=none", "delay=paper", "delay.act=2", "delay.rew=1", "links=matrix"]
KINDS = [
    (*kind, delay)
    for kind, delay in zip(
        product(TASKS, ("discrete", "continuous"), ("instant", "polynomial")), 4 * DELAYS, strict=True
    )
]
"""Every task, kind of action and motion; over them the delays take turns."""


def made(*overrides, **options):
    return UavParallelEnv(compose_scenario(*overrides), **options)


@pytest.mark.sample(4)
@pytest.mark.parametrize(("task", "actions", "motion", "delay"), KINDS[::3])  # every value of each
def test_pettingzoos_checkers_find_nothing(task, actions, motion, delay, capsys):
    overrides = [f"scenario={task}", f"actions={actions}", f"motion={motion}", delay, "episode.max_steps=4"]
    parallel_api_test(made(*overrides), num_cycles=6)
    parallel_seed_test(lambda: made(*overrides))
    assert "Passed Parallel API test" in capsys.readouterr().out


def test_the_environment_does_what_the_torchrl_environment_does():
    scenario = compose_scenario("delay=paper", "episode.max_steps=8")
    env, reference = UavParallelEnv(scenario, seed=3), make_env(scenario, 1, seed=3)
    reference.seed_worlds(torch.tensor([5]))
    now = reference.reset()
    observations, infos = env.reset(seed=5)
    for _ in range(8):
        for number, agent in enumerate(env.possible_agents):
            assert np.array_equal(observations[agent], now[keys.OBSERVATION][0, number].numpy())
            assert np.array_equal(infos[agent]["action_mask"], now[keys.ACTION_MASK][0, number].numpy())
        assert np.array_equal(env.state(), now[keys.GLOBAL_OBSERVATION][0].flatten().numpy())
        chosen = {name: env.action_space(name).sample(infos[name]["action_mask"]) for name in env.agents}
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


def test_torchrl_reads_the_environment_and_our_transforms_delay_it_further():
    env = PettingZooWrapper(made("episode.max_steps=5"), use_mask=True)
    check_env_specs(env, break_when_any_done="both")
    delayed = TransformedEnv(env, ObservationDelay(2, in_keys=[("uav", "observation")]))
    assert delayed.rollout(4)["next", "uav", "age"].max() == 2


def test_what_a_user_can_get_wrong_is_said_in_one_line():
    env = made()
    env.reset()
    with pytest.raises(InputError, match="action of uav_1: -1 is not in Discrete"):
        env.step({"uav_0": 0, "uav_1": -1, "uav_2": 0})
