"""What TorchRL's own transforms do, every transform does on every kind of environment."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from contract import Drift
from environments import KINDS, Kind
from every_transform import (
    GROUPS,
    LATE,
    TRANSFORMS,
    every_case,
    every_kind,
    every_transform,
    observation_delay,
    played,
)
from helpers import all_same, same
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from damian.delays.laws import Burst, Uniform
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    Channel,
    CumulativeReward,
    ObservationDelay,
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
        SampleAndHold(1, () if kind.stateless else kind.observation, kind.action)
        if kind.observation != "state"
        else SampleAndHold(1, kind.observation)
    ),
}

# Specs.


@pytest.mark.sample(2)
@every_case
def test_the_outputs_match_the_specs_and_every_spec_can_do_without_the_batch(kind, make):
    env = TransformedEnv(kind.make(), make(kind, LATE))
    if kind.stateless:
        assert set(played(env, kind)[-1].keys(True, True)) >= set(env.full_observation_spec.keys(True, True))
    else:
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


@pytest.mark.sample(3)
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


@every_case
def test_what_is_written_shares_no_memory_with_the_buffers(kind, make):
    env = TransformedEnv(kind.make(), make(kind, LATE))
    env.set_seed(0)
    td = env.reset(kind.begin(env))
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


OTHER_SIZES = {
    "delay": (lambda: ObservationDelay(2), lambda: ObservationDelay(5)),
    "keys": (lambda: ObservationDelay(2), lambda: ObservationDelay(2, ["a", "observation"])),
    "sum": (lambda: CumulativeReward(2), lambda: CumulativeReward(5)),
}


@pytest.mark.parametrize("pair", OTHER_SIZES.values(), ids=OTHER_SIZES)
@pytest.mark.parametrize("swapped", [False, True])
def test_the_state_of_another_delay_is_refused(pair, swapped):
    one, other = (make() for make in (pair[::-1] if swapped else pair))
    if "a" in one.in_keys:
        one, other = other, one
    env = TransformedEnv(GymEnv("Pendulum-v1"), one)
    env.rollout(3)
    with pytest.raises(RuntimeError, match=rf"{type(one).__name__} has .*loaded state is of one with"):
        other.load_state_dict(one.state_dict())
    assert not other.has_memory


@every_transform
@pytest.mark.parametrize("first", [True, False], ids=["the reset", "a step"])
def test_after_inference_mode_come_normal_steps(make, first):
    env, expected = (TransformedEnv(Drift(), make(KINDS["Pendulum"], LATE)) for _ in range(2))
    outputs = []
    for each, inference in ((env, True), (expected, False)):
        each.set_seed(0)
        torch.manual_seed(0)
        with torch.inference_mode(inference and first):
            td = each.reset()
        with torch.inference_mode(inference and not first):
            td = each.step_and_maybe_reset(each.rand_action(td))[1]
        outputs.append([])
        for _ in range(5):
            td = each.step_and_maybe_reset(each.rand_action(td.clone()))[1]
            outputs[-1].append(td.clone())
    assert all_same(*outputs)


# Graphs.


# Gradients.


def action_gradients(transform: StatefulTransform | None, key: Any = "observation") -> list[torch.Tensor]:
    """The gradient of each step's entry with respect to the actions of all steps so far."""
    env = Drift() if transform is None else TransformedEnv(Drift(), transform)
    td, actions, gradients = env.reset(), [], []
    for _ in range(3):
        actions.append(torch.full((3, 2), 0.5, requires_grad=True))
        td = env.step(td.clone().set("action", actions[-1]))["next"]
        value = td[key].sum()
        found = (
            torch.autograd.grad(value, actions, retain_graph=True, allow_unused=True)
            if (value.requires_grad)
            else [None] * len(actions)
        )
        gradients.append(torch.stack([torch.zeros(3, 2) if one is None else one for one in found]))
    return gradients


def test_at_delay_0_gradients_are_those_of_the_environment():
    kind = KINDS["Pendulum"]
    undelayed = action_gradients(None)
    assert undelayed[0].any()
    for name in ("ObservationDelay", "ActionDelay", "RewardDelay"):
        found = action_gradients(TRANSFORMS[name](kind, 0, gradients=True))
        assert all(a.equal(b) for a, b in zip(found, undelayed, strict=True))


def test_gradients_reach_back_to_when_the_held_entry_was_made():
    kind = KINDS["Pendulum"]
    undelayed = action_gradients(None)[0][0]
    for name in ("ObservationDelay", "ActionDelay"):
        found = action_gradients(TRANSFORMS[name](kind, 1, gradients=True))
        assert not found[0].any()
        assert found[1][0].equal(undelayed)
        assert found[2][1].equal(undelayed)
    summed = action_gradients(CumulativeReward(2, 0.5, gradients=True), "reward")
    assert summed[1][0].equal(0.5 * summed[1][1])
    held = action_gradients(SampleAndHold(2, "observation", gradients=True))
    assert not held[0].any()
    assert held[1][1].equal(undelayed)
    assert held[2][1].equal(undelayed)


# Keys.


def test_a_key_may_stand_for_a_list_of_one_key():
    for key in ("observation", ["observation"], ("observation",)):
        assert ObservationDelay(2, key).in_keys == ["observation"]
    for key in (("agents", "observation"), [("agents", "observation")]):
        assert ObservationDelay(2, key).in_keys == [("agents", "observation")]
    assert ObservationDelay(2, ["a", ("b", "c")]).in_keys == ["a", ("b", "c")]
