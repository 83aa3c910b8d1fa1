"""Back-updating in any environment, against a loop over a world's steps, and what a storage refuses."""

import random

import pytest
import torch
from remote import (
    ENDS,
    GAMMA,
    LONGEST,
    WORLDS,
    Case,
    Twin,
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
from torchrl.envs import Compose, GymEnv, MultiStepTransform, StepCounter, TransformedEnv

from damian.common.errors import InputError
from damian.delays.laws import Uniform
from damian.keys import next_key
from damian.replay.backupdate import BackupdateStorage, corrections_of
from damian.transforms import (
    ActionDelay,
    CumulativeReward,
    RewardDelay,
    set_seed,
)


def random_case(rng: random.Random) -> Case:
    latest, window, period = rng.choice([None, 0, 2, LONGEST]), rng.randint(1, 4), rng.randint(1, 5)
    return Case(latest, window, period, rng.choice([0.0, 0.4]), rng.choice(["generation", "arrival"]))


def storage_of(env: TransformedEnv, group: tuple[str, ...], n_steps: int) -> BackupdateStorage:
    """A storage of ``n_steps`` steps, with the corrections that follow from the environment."""
    recomputed = [key(group, name) for name in ("observation", "reward")]
    corrections, hindsight = corrections_of(env.transform, recomputed), key(group, "hindsight")
    storage = make_storage(group, corrections=corrections, hindsight_key=hindsight)
    storage.max_size = n_steps * WORLDS
    return storage


@pytest.mark.sample(2)
@both_layouts
@pytest.mark.parametrize("seed", range(4))
def test_stored_steps_become_what_a_slow_twin_says(group, seed):
    rng = random.Random(seed)
    for _ in range(3):
        case, part = random_case(rng), rng.choice([4, 10, 20])
        env = make_env(group, case)
        collected = rollout(env, 40)
        capacity = part + 2 * LONGEST + case.window - 1 + case.period - 1  # the least, so that the ring wraps
        after = stored(storage_of(env, group, min(capacity, 40)), collected, 40 // part)
        steps, n_older = collected.transpose(0, 1), 40 - len(after)
        for world in range(WORLDS):
            twin = Twin(steps, world, group, case)
            done = [a or b for a, b in zip(twin.terminated, twin.truncated, strict=True)]
            for name, right in (
                ("terminated", twin.terminated),
                ("truncated", twin.truncated),
                ("done", done),
            ):
                assert after["next", name][:, world, 0].tolist() == right[n_older:]
            assert after["valid"][:, world, 0].tolist() == twin.valid[n_older:]
            for t in range(n_older, 40):
                for row in twin.senders:
                    check_step(after, (t - n_older, world, *row), twin, t, row)
    assert n_older >= 0


def check_step(after: TensorDictBase, at: tuple[int, ...], twin: Twin, t: int, row: tuple) -> None:
    """Compare what is stored of a step with the twin."""
    observation, reward = key(twin.group, "observation"), key(twin.group, "reward")
    assert after[next_key(key(twin.group, "hindsight"))][at].tolist() == twin.message(t, row)
    assert after[next_key(reward)][at].item() == pytest.approx(twin.summed(t, row)), (twin.case, t)
    assert after[next_key(observation)][at].tolist() == pytest.approx(twin.held(t, row)), (twin.case, t)
    assert after[observation][at].tolist() == pytest.approx(twin.held_before(t, row)), (twin.case, t)


@both_layouts
def test_neither_messages_nor_rewards_that_arrive_later_are_used(group):
    case = Case(4, 3, 2)
    env = make_env(group, case)
    collected = rollout(env, 30)
    spoilt = collected.clone()
    now = torch.arange(30).view(1, 30, *[1] * (len(group) + 1))
    message, delay = (next_key(key(group, name)) for name in ("message", "delay"))
    late = now + collected[delay] > 29
    spoilt[message] = torch.where(late, torch.nan, collected[message])
    spoilt[delay] = torch.where(late, LONGEST, collected[delay])
    reward, reward_delay = (next_key(key(group, name)) for name in ("reward", "reward_delay"))
    unpaid = now + collected[reward_delay] > 29
    unpaid &= ~collected["next", "done"].flip(1).cummax(1).values.flip(1).view(
        WORLDS, 30, *[1] * (unpaid.dim() - 2)
    )
    spoilt[reward_delay] = torch.where(unpaid, 4, collected[reward_delay])
    spoilt[reward] = torch.full_like(spoilt[reward], torch.nan)  # the sums that were paid tell nothing
    assert late.any()
    assert unpaid.any()
    one, other = (stored(storage_of(env, group, 60), steps, 3) for steps in (collected, spoilt))
    names = (reward, next_key(key(group, "observation")), ("next", "done"), "valid")
    assert all(one[name].equal(other[name]) for name in names)


def late_cartpole(*transforms: object) -> TransformedEnv:
    late = RewardDelay(Uniform(0, 4), delay_key="reward_delay", earned_key="earned", seed=0)
    env = TransformedEnv(GymEnv("CartPole-v1"), Compose(StepCounter(), late, *transforms))
    set_seed(env, 0)
    return env


@pytest.mark.parametrize("window", [1, 3])
def test_late_rewards_alone_are_credited_in_any_environment(window):
    env = late_cartpole(CumulativeReward(window, GAMMA))
    steps = env.rollout(70, break_when_any_done=False)
    corrections = corrections_of(env.transform, ["reward"])
    storage = BackupdateStorage(200, None, 4, corrections=corrections)
    buffer = ReplayBuffer(storage=storage)
    for part in steps.split(10):
        buffer.extend(part.unsqueeze(0))
    after = storage[storage.latest()].squeeze(1)
    count, done = (steps[name].flatten().tolist() for name in ("step_count", ("next", "done")))
    delay = steps["next", "reward_delay"].flatten().tolist()
    for t in range(70):
        latest = range(t - min(count[t], window - 1), t + 1)
        paid = [g for g in latest if g + delay[g] <= 69 or any(done[g:])]
        expected = sum(GAMMA ** (t - g) for g in paid)
        assert after["next", "reward"][t].item() == pytest.approx(expected)
    assert not steps["next", "reward"].equal(after["next", "reward"])
    paid_late = [g for g in range(70) if delay[g] > 0 and (g + delay[g] <= 69 or any(done[g:]))]
    assert after["backupdated"].flatten().nonzero().flatten().tolist() == paid_late
    assert after["next", "done"].equal(steps["next", "done"])
    assert after["valid"].all()


def test_a_reward_delay_that_does_not_tell_its_delays_is_refused():
    with pytest.raises(InputError, match="RewardDelay: back-updating needs each delay"):
        corrections_of(Compose(ActionDelay(2), RewardDelay(2)), ["reward"])


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


# Mistakes.


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
        (
            lambda entries: entries | {("next", "success"): entries["next", "reward"]},
            "is not an entry after the steps",
        ),
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
