"""Delays of stored steps equal those that the same transforms make in the environment."""

import runpy
from pathlib import Path

import pytest
import torch
from delay_twin import ACTION, OBSERVATION, REWARD, WORLDS, Counting
from environments import vmas
from helpers import same
from torchrl.envs import (
    Compose,
    GymEnv,
    InitTracker,
    RewardSum,
    SerialEnv,
    TransformedEnv,
)

from damian import (
    ActionHistory,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
    Uniform,
    set_seed,
)

EXAMPLE = runpy.run_path(
    str(Path(__file__).parents[2] / "examples/transforms/late_replay_buffer.py")
)
delay_trajectories = EXAMPLE["delay_trajectories"]

LATE = Uniform(0, 3)


ROOT = ("observation", "action", "reward")
AGENTS = (OBSERVATION, ACTION, REWARD)
KINDS = {
    "Pendulum": (lambda: GymEnv("Pendulum-v1"), ROOT),
    "CartPole, two": (lambda: SerialEnv(2, lambda: GymEnv("CartPole-v1")), ROOT),
    "counting": (lambda: Counting(WORLDS), AGENTS),
    "VMAS": (vmas, AGENTS),
}
CHAINS = {
    "observation": lambda o, a, r: ObservationDelay(
        LATE,
        [o],
        loss=0.1,
        delay_key="d",
        seed=1,
    ),
    "all": lambda o, a, r: Compose(
        ObservationDelay(LATE, [o], order="arrival", seed=1),
        Compose(RewardDelay(LATE, r, seed=2), CumulativeReward(2, 0.9, r)),
        SampleAndHold(2, [o]),
        ActionHistory(2, a, append_to=o, age_key="age"),
        RewardSum([r], ["sum"] if isinstance(r, str) else [("agents", "sum")]),
        InitTracker(),
    ),
}


def collect(env, n_steps=30):
    """Steps under random actions, the same at each call, with resets in between; [*, T]."""
    set_seed(env, 0)
    torch.manual_seed(0)
    return env.rollout(n_steps, break_when_any_done=False)


@pytest.mark.sample(5)
@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.parametrize("kind", KINDS)
def test_stored_steps_are_delayed_as_in_the_environment(kind, chain):
    make, keys = KINDS[kind]
    env = TransformedEnv(make(), CHAINS[chain](*keys))
    online = collect(env)
    stored = collect(make())
    assert online[keys[1]].equal(stored[keys[1]])
    found = delay_trajectories(stored, env.transform, action_spec=make().action_spec)
    assert same(found, online)
    assert found.batch_size == online.batch_size
    assert found.names == online.names
