"""On every kind of environment, a transform without delay changes nothing."""

from collections.abc import Callable

import pytest
from environments import Kind
from every_transform import (
    GROUPS,
    every_kind,
    observation_delay,
    played,
)
from helpers import all_same, same
from torchrl.envs import TransformedEnv

from damian.delays.laws import Burst, Uniform
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    Channel,
    CumulativeReward,
    RewardDelay,
    SampleAndHold,
    StatefulTransform,
)

IDENTITIES: dict[str, Callable[[Kind], StatefulTransform]] = {
    "ObservationDelay": lambda kind: observation_delay(kind, 0),
    "ObservationDelay, bursts": lambda kind: observation_delay(kind, Burst(good=0, bad=0, bad_loss=0.0)),
    "ActionDelay": lambda kind: ActionDelay(Uniform(0, 0, 0.5), kind.action),
    "RewardDelay": lambda kind: RewardDelay("0s", kind.reward),
    "CumulativeReward": lambda kind: CumulativeReward(1, 0.5, kind.reward),
    "ActionHistory": lambda kind: ActionHistory(3, kind.action),
    "SampleAndHold": lambda kind: (
        SampleAndHold(1, kind.observation, kind.action)
        if kind.observation != "state"
        else SampleAndHold(1, kind.observation)
    ),
}


@pytest.mark.parametrize("kind", GROUPS.values(), ids=GROUPS)
def test_a_channel_without_delay_shows_current_messages_and_changes_nothing_else(kind):
    undelayed = played(kind.make(), kind)
    delayed = played(TransformedEnv(kind.make(), Channel(0, kind.observation)), kind)
    group = kind.observation[0]
    for td, other in zip(delayed, undelayed, strict=True):
        assert same(td.select(*other.keys(True, True)), other)
        sent = other[kind.observation]
        assert td[group, "received"].equal(sent.unsqueeze(-3).expand_as(td[group, "received"]))
        assert not td[group, "received_age"].any()
        assert td[group, "received_mask"].all()


@pytest.mark.sample(5)
@every_kind
@pytest.mark.parametrize("identity", IDENTITIES.values(), ids=IDENTITIES)
def test_delay_0_changes_nothing_for_a_policy_that_draws_from_torchs_generator(kind, identity):
    undelayed = played(kind.make(), kind)
    transform = identity(kind)
    env = TransformedEnv(kind.make(), transform)
    delayed = played(env, kind)
    pairs = zip(delayed, undelayed, strict=True)
    assert all_same([td.select(*other.keys(True, True)) for td, other in pairs], undelayed)
