"""What TorchRL's own transforms do, every transform does on every kind of environment."""

from collections.abc import Callable

import pytest
import torch
from environments import Kind
from every_transform import (
    GROUPS,
    LATE,
    every_case,
    every_kind,
    observation_delay,
    played,
)
from helpers import all_same, same
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from damian.delays.laws import Burst, Uniform
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    Channel,
    CumulativeReward,
    RewardDelay,
    SampleAndHold,
    StatefulTransform,
    set_seed,
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

# Specs.


@pytest.mark.sample(5)
@every_case
def test_the_outputs_match_the_specs_and_every_spec_can_do_without_the_batch(kind, make):
    env = TransformedEnv(kind.make(), make(kind, LATE))
    check_env_specs(env, break_when_any_done="both")
    dims = len(env.batch_size)
    for name in (name for name in dir(type(env)) if name.endswith("_spec_unbatched") and name[0] != "_"):
        spec, whole = getattr(env, name), getattr(env, name.removesuffix("_unbatched"))
        assert spec.shape == whole.shape[dims:], name
        assert spec.rand().shape == spec.shape


# Identity.


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


# Memory.


@pytest.mark.sample(4)
@every_case
def test_what_is_written_shares_no_memory_with_the_buffers(kind, make):
    env = TransformedEnv(kind.make(), make(kind, LATE))
    set_seed(env, 0)
    td = env.reset()
    for _ in range(5):
        owned = [*env.transform.memory.values()]
        td = env.rand_action(td)
        executed = env.transform.inv(td.clone())
        owned += env.transform.memory.values()
        after, td = env.step_and_maybe_reset(td)
        owned += env.transform.memory.values()
        shown = [*executed.values(True, True), *after.values(True, True), *td.values(True, True)]
        assert not storages(owned) & storages(shown)


def storages(tensors: list[torch.Tensor]) -> set[int]:
    """Addresses of the memory of tensors."""
    return {tensor.untyped_storage().data_ptr() for tensor in tensors if tensor.numel()}
