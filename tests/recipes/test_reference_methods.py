"""Reference methods: messages held back to a constant delay (``delay.hold``), and a privileged
critic."""

import math

import pytest
import torch
from helpers import (
    KEEPS_GOING,
    MOTIONS,
    both_kinds,
    both_motions,
    everything,
    play,
    random_actions,
    square,
)
from twin import GLOBAL, LOCAL

from damian import ClockConfig, DelayConfig, make_env
from damian.envs.uav_env import EXTRAS
from damian.keys import PRIVILEGED_OBSERVATION as PRIVILEGED
from damian.learners.config import MappoConfig, SacConfig
from damian.models.config import MlpConfig
from damian.recipes.config import TrainConfig
from damian.recipes.shared.learning import learning_env, make_learner, replay_buffer
from damian.server.config import ObservationConfig
from damian.world.config import ActionConfig, SourceConfig
from damian.world.state import Truth

UNIFORM = {"law": "uniform", "low": 1, "high": 3, "probability": 0.3}
BURST = {
    "law": "burst",
    "enter": 0.2,
    "leave": 0.3,
    "bad": 4,
    "bad_loss": 0.0,
}
LATE = {
    "delay": DelayConfig(obs=BURST, loss=0.3, history=2, rew=1),
    "clock": ClockConfig(server="2s"),
}


def rollout_of(scenario, extras=EXTRAS):
    """Outputs of the environment for random actions, which are the same at each call."""
    env = make_env(scenario, 4, extras=extras)
    generator = torch.Generator().manual_seed(3)
    return play(env, [random_actions(env.uav_env, generator) for _ in range(20)])


@both_motions
def test_delays_and_losses_do_not_change_the_privileged_observation(motion):
    same = {"episode": KEEPS_GOING, "observation": ObservationConfig(LOCAL, GLOBAL)}
    undelayed, delayed = (
        rollout_of(everything(motion, **same, **sections), ("privileged",))
        for sections in ({}, LATE)
    )
    held = ("agents", "global_observation")
    assert not all(
        one[held].equal(other[held]) for one, other in zip(undelayed, delayed, strict=True)
    )
    for one, other in zip(undelayed, delayed, strict=True):
        assert one[PRIVILEGED].equal(other[PRIVILEGED])
        assert one[PRIVILEGED][..., :-2].equal(one[held])


@both_motions
def test_the_privileged_observation_ends_with_the_vector_to_the_source(motion):
    position = [20.0, 150.0]
    outputs = rollout_of(
        square(motion=MOTIONS[motion], source=SourceConfig(position=position)),
        ("privileged", "state"),
    )
    for td in outputs:
        uavs = Truth.unpack(td["state"]).position[..., :2]
        from_centre = torch.tensor(position) - 100.0  # the middle of the square
        to_source = (from_centre - uavs) / (200 * math.sqrt(2))
        torch.testing.assert_close(
            td[PRIVILEGED][..., -2:],
            to_source,
            atol=1e-6,
            rtol=0,
        )


@both_kinds
@pytest.mark.parametrize("learner", [MappoConfig(steps=12, minibatches=2), SacConfig()])
def test_the_actor_beside_a_privileged_critic_has_no_privileged_observation(learner, kind):
    late = vars(
        everything(delay=DelayConfig(obs=UNIFORM, history=2), actions=ActionConfig(kind=kind))
    )
    tiny = {"worlds": 4, "learner": learner, "model": MlpConfig(hidden=[16])}
    config = TrainConfig(**late, **tiny, critic="privileged")
    env = learning_env(config)
    actor = make_learner(config, env, replay_buffer(config, env)).actor
    assert PRIVILEGED not in actor.in_keys
