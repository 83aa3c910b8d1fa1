"""What a back-updating storage refuses: one line for each kind of mistake."""

import pytest
from remote import LONGEST, WORLDS, make_env, make_storage, recompute_of, rollout, stored
from torchrl.data import ReplayBuffer
from torchrl.envs import MultiStepTransform

from damian.common.errors import InputError
from damian.replay.backupdate import BackupdateStorage

REWARD = ("next", "reward")


@pytest.mark.parametrize(
    ("name", "other", "message"),
    [
        ("message", "none", r"message_key: \('next', 'none'\) is not in the steps"),
        ("step_count", "none", r"step_count_key: none is not in the steps: StepCounter\(\) writes it"),
    ],
)
def test_a_missing_or_misshapen_entry_is_one_line(name, other, message):
    with pytest.raises(InputError, match=message):
        stored(make_storage((), **{f"{name}_key": other}), rollout(make_env(()), 8))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda entries: entries | {("next", "success"): entries[REWARD]}, "is not an entry after the steps"),
        (lambda entries: {("next", "done"): entries["next", "done"]}, "are returned in part"),
    ],
)
def test_a_mistake_in_recompute_is_one_line(change, message):
    storage = make_storage((), lambda *arguments: change(recompute_of(())(*arguments)))
    with pytest.raises(InputError, match=f"recompute: .*{message}"):
        stored(storage, rollout(make_env(()), 8))


def test_batches_of_another_shape_than_steps_of_the_same_worlds_are_refused():
    steps, storage = rollout(make_env(()), 8), make_storage(())
    with pytest.raises(InputError, match="step_count grows from world to world"):
        stored(make_storage(()), steps.transpose(0, 1))
    stored(storage, steps)
    for batch in (steps.transpose(0, 1), steps[:2]):
        with pytest.raises(InputError, match=r"steps: a batch of shape \[.*\] is not one of 3 worlds: give"):
            stored(storage, batch)
    with pytest.raises(InputError, match=r"steps: a batch of shape \[24\] is not \[T, B\]"):
        storage.set(range(24), steps.reshape(-1))
    with pytest.raises(InputError, match="longest: -1 steps is not at least 0 steps"):
        BackupdateStorage(10, recompute_of(()), -1)


def test_a_storage_holds_a_batch_and_twice_the_longest_delay_or_is_refused():
    steps, least = rollout(make_env(()), 8), 8 + 2 * LONGEST
    names = {f"{name}_key": name for name in ("message", "received", "delay", "age")}
    stored(BackupdateStorage(least * WORLDS, recompute_of(()), LONGEST, **names), steps)
    with pytest.raises(InputError, match=f"{least} steps of {WORLDS} worlds need {least * WORLDS}"):
        stored(BackupdateStorage((least - 1) * WORLDS, recompute_of(()), LONGEST, **names), steps)


def test_steps_that_a_transform_has_joined_are_refused():
    n_step = MultiStepTransform(n_steps=3, gamma=0.9)
    buffer = ReplayBuffer(storage=make_storage(()), transform=n_step, batch_size=4)
    with pytest.raises(InputError, match="MultiStepTransform joins steps before they are corrected"):
        buffer.extend(rollout(make_env(()), 20))
