"""Back-updating without UAVs, against a slow twin: messages at the root or in a group, and hindsight."""

import pytest
import torch
from remote import (
    ENDS,
    Case,
    both_layouts,
    key,
    make_env,
    make_storage,
    recompute_of,
    rollout,
    stored,
)
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer

from damian.keys import next_key


@both_layouts
@pytest.mark.parametrize("order", ["generation", "arrival"])
def test_backupdated_counts_the_rewards_that_late_messages_have_changed_and_not_the_messages(group, order):
    reward, received = (next_key(key(group, name)) for name in ("reward", "received"))

    def recompute(_: TensorDictBase, messages: Tensor) -> dict[NestedKey, Tensor]:
        return {reward: (messages[..., 1:] > 0.3).float()}

    collected = rollout(make_env(group, Case(order=order)), 60)
    collected[reward] = recompute(collected, collected[received])[reward]
    storage = make_storage(group, recompute, hindsight_key=key(group, "hindsight"))
    buffer, known = ReplayBuffer(storage=storage), collected[reward].transpose(0, 1).clone()
    changed = torch.zeros_like(known, dtype=torch.bool)
    for end in range(5, 65, 5):
        buffer.extend(collected[:, end - 5 : end])
        now = storage[storage.latest()]
        changed[:end] |= now[reward] != known[:end]
        known[:end] = now[reward]
    assert now[key(group, "backupdated")].equal(changed)
    replaced = (now[next_key(key(group, "hindsight"))] != now[received]).any(-1)
    assert 0 < changed.float().mean() < 0.8 * replaced.float().mean()


@both_layouts
def test_what_was_known_at_the_time_stays_beside_hindsight(group):
    collected = rollout(make_env(group), 40)
    after = stored(make_storage(group, hindsight_key=key(group, "hindsight")), collected, 4)
    names = {next_key(key(group, name)) for name in ("message", "received", "delay", "age")}
    for name in names | set(ENDS) | {key(group, "received"), "action", "step_count", ("next", "step_count")}:
        assert after[name].equal(collected[name].transpose(0, 1)), name
    held, hindsight, sent = (
        after[next_key(key(group, name))] for name in ("received", "hindsight", "message")
    )
    assert (hindsight == held).any()
    assert (hindsight[..., 0] > held[..., 0]).any()  # numbers of messages grow
    assert (hindsight[..., 0] >= held[..., 0]).all()
    assert (hindsight[..., 0] <= sent[..., 0]).all()


@both_layouts
def test_the_ends_stay_if_recompute_returns_none(group):
    reward = next_key(key(group, "reward"))

    def recompute(steps: TensorDictBase, messages: Tensor) -> dict[NestedKey, Tensor]:
        return {reward: recompute_of(group)(steps, messages)[reward]}

    collected = rollout(make_env(group), 40)
    after, full = (stored(make_storage(group, f), collected, 4) for f in (recompute, None))
    for name in ENDS:
        assert after["next", name].equal(collected["next", name].transpose(0, 1))
    assert after["valid"].all()
    assert after["reset_after"].equal(after["next", "done"])
    assert after[reward].equal(full[reward])
    assert not after[reward].equal(collected[reward].transpose(0, 1))
    name = key(group, "observation")
    assert after[name].equal(collected[name].transpose(0, 1))
