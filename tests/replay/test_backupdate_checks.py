"""What a back-updating storage refuses: one line, from an environment's specs or the first steps."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from remote import make_env, make_storage, recompute_of, rollout, stored
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.envs import MultiStepTransform

from damian.common.errors import InputError
from damian.replay.backupdate import BackupdateStorage


def refuse(message: str, recompute: Any = None, group: tuple[str, ...] = (), **options: Any) -> None:
    env = make_env(group)
    steps = rollout(env, 8)
    for options_of in ({"env": env}, {}):
        with pytest.raises(InputError) as error:
            stored(make_storage(group, recompute, **options, **options_of), steps)
        assert str(error.value) == message


ADD_DELAY = "add ObservationDelay(delay, ['message'], ['received'], age_key='age', delay_key='delay')"
OF = "(T = 2 steps of B = 3 worlds)"


@pytest.mark.parametrize(
    ("name", "other", "message"),
    [
        (
            "message",
            "none",
            "message_key: the steps have no ('next', 'none'), the message sent in each step, [T, B, M] or "
            "[T, B, N, M]: the environment must output it; that of UAVs does with make_env(..., "
            "extras=['message'])",
        ),
        (
            "received",
            "none",
            "received_key: the steps have no ('next', 'none'), the message that the receiver holds after "
            f"each step, [T, B, M]: {ADD_DELAY.replace('received', 'none')}",
        ),
        (
            "delay",
            "none",
            "delay_key: the steps have no ('next', 'none'), the delay of the message sent in each step "
            f"[steps], [T, B, 1]: {ADD_DELAY.replace(chr(39) + 'delay', chr(39) + 'none')}",
        ),
        (
            "age",
            "none",
            "age_key: the steps have no ('next', 'none'), the age of the message that the receiver holds "
            f"[steps], [T, B, 1]: {ADD_DELAY.replace(chr(39) + 'age', chr(39) + 'none')}",
        ),
        (
            "step_count",
            "none",
            "step_count_key: the steps have no none, the number of earlier steps in the episode, [T, B, 1]: "
            "add StepCounter()",
        ),
        (
            "message",
            "world",
            "message_key: ('next', 'world') has the shape [2, 3], which is not [T, B, M] or [T, B, N, M]",
        ),
        (
            "received",
            "observation",
            f"received_key: ('next', 'observation') has the shape [2, 3, 3], not [2, 3, 2] {OF}",
        ),
        ("delay", "message", f"delay_key: ('next', 'message') has the shape [2, 3, 2], not [2, 3, 1] {OF}"),
        ("age", "world", f"age_key: ('next', 'world') has the shape [2, 3], not [2, 3, 1] {OF}"),
        ("step_count", "message", f"step_count_key: message has the shape [2, 3, 2], not [2, 3, 1] {OF}"),
        ("hindsight", "received", "hindsight_key: ('next', 'received') is an entry of the steps already"),
    ],
)
def test_a_missing_or_misshapen_entry_is_one_line(name, other, message):
    refuse(message, **{f"{name}_key": other})


def test_in_a_group_the_line_names_the_agents():
    add = "add ObservationDelay(delay, [('agents', 'message')], [('agents', 'received')], age_key='none', "
    refuse(
        "age_key: the steps have no ('next', 'none'), the age of the message that the receiver holds "
        f"[steps], [T, B, N, 1]: {add}delay_key=('agents', 'delay'))",
        group=("agents",),
        age_key="none",
    )
    shapes = "has the shape [2, 3, 1], not [2, 3, 2, 1]"
    refuse(f"delay_key: ('next', 'done') {shapes} {OF}", group=("agents",), delay_key="done")


REWARD = ("next", "reward")
SHAPES = "has the shape [2, 3], not [2, 3, 1]"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda _: None, "a NoneType is not a dict of entries by key, such as {('next', 'reward'): reward}"),
        (lambda _: {"reward": 0}, "reward is not after the step: its key must begin with 'next'"),
        (
            lambda entries: {("next", "received"): entries[REWARD]},
            "('next', 'received') tells what was known at the time, and must stay: with hindsight_key, late "
            "messages are stored",
        ),
        (
            lambda entries: entries | {("next", "success"): entries["next", "done"]},
            "the steps have no ('next', 'success'), which it returns: the environment must output it",
        ),
        (lambda entries: entries | {REWARD: 1.0}, "('next', 'reward') is a float, no tensor"),
        (
            lambda entries: entries | {REWARD: entries[REWARD].squeeze(-1)},
            f"('next', 'reward') {SHAPES} {OF}",
        ),
        (
            lambda entries: entries | {REWARD: entries[REWARD].double()},
            "('next', 'reward') has the dtype torch.float64, not torch.float32",
        ),
        (
            lambda entries: {key: entries[key] for key in (REWARD, ("next", "done"))},
            "('next', 'terminated') is missing: return ('next', 'done'), ('next', 'terminated') and "
            "('next', 'truncated'), or none of them",
        ),
    ],
)
def test_a_mistake_in_recompute_is_one_line(change, message):
    refuse(f"recompute: {message}", lambda *arguments: change(recompute_of(())(*arguments)))


def test_steps_without_flags_of_the_end_are_refused():
    steps = rollout(make_env(()), 8)
    for name, message in (
        (
            "done",
            "done: the steps have no ('next', 'done'), the end of an episode, [T, B, 1]: store steps as",
        ),
        (
            "truncated",
            "recompute: the steps have no ('next', 'truncated'), which it returns: StepCounter(max_steps=",
        ),
    ):
        with pytest.raises(InputError) as error:
            stored(make_storage(()), steps.exclude(("next", name)))
        assert str(error.value).startswith(message)


def test_settings_are_checked():
    with pytest.raises(InputError, match=r"env: the batch size \[2, 2\] is not \[\] or \[B\]"):
        make_storage((), env=SimpleNamespace(batch_size=torch.Size([2, 2])))
    with pytest.raises(InputError, match="longest: -1 steps is not at least 0 steps"):
        BackupdateStorage(10, recompute_of(()), -1)


@pytest.mark.parametrize("with_env", [False, True])
def test_recompute_is_checked_only_once_on_two_steps(with_env):
    n_steps = []

    def recompute(steps: TensorDictBase, messages: Tensor) -> dict[NestedKey, Tensor]:
        n_steps.append(len(steps))
        return recompute_of(())(steps, messages)

    env = make_env(())
    storage = make_storage((), recompute, **({"env": env} if with_env else {}))
    assert n_steps == [2] * with_env
    stored(storage, rollout(env, 20), 2)
    assert n_steps == [2, 10, 20]


@pytest.mark.parametrize("knows_env", [True, False])
def test_batches_of_another_shape_than_steps_of_the_same_worlds_are_refused(knows_env):
    env = make_env(())
    steps = rollout(env, 8)
    storage = make_storage((), None, **({"env": env} if knows_env else {}))
    stored(storage, steps)
    for batch in (steps.transpose(0, 1), steps[:2]):
        with pytest.raises(InputError, match=r"steps: a batch of shape \[.*\] is not one of 3 worlds: give"):
            stored(storage, batch)
    with pytest.raises(InputError, match=r"steps: a batch of shape \[24\] is not \[T, B\]"):
        storage.set(range(24), steps.reshape(-1))


def test_recompute_must_correct_something_unless_hindsight_is_stored():
    refuse("recompute: {} corrects nothing: return at least one entry", lambda steps, messages: {})


@pytest.mark.parametrize("group", [(), ("agents",)], ids=["at the root", "in a group"])
def test_no_messages_change_nothing_and_messages_need_stored_steps(group):
    storage, none, one = make_storage(group), torch.zeros(0, dtype=torch.long), torch.zeros(1).long()
    with pytest.raises(InputError) as error:
        storage.receive(one, one, one, torch.zeros(1, 2))
    assert str(error.value) == (
        "receive: 1 messages belong to no step: none is stored yet, so extend the replay buffer first"
    )
    storage.receive(none, none, none, torch.zeros(0, 2))  # before any step too
    before = stored(storage, rollout(make_env(group), 8)).clone()
    storage.receive(none, none if group else None, none, torch.zeros(0, 2))
    assert (storage[storage.latest()] == before).all()


def test_steps_that_a_transform_has_joined_are_refused():
    env = make_env(())
    n_step = MultiStepTransform(n_steps=3, gamma=0.9)
    buffer = ReplayBuffer(storage=make_storage((), env=env), transform=n_step, batch_size=4)
    with pytest.raises(
        InputError, match="transform: MultiStepTransform joins steps before they are corrected"
    ):
        buffer.extend(rollout(env, 20))
