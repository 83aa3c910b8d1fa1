"""Back-updating with late rewards, sums of rewards and slow clocks, against a loop over a world's steps."""

import random

import pytest
import torch
from remote import (
    GAMMA,
    LONGEST,
    WORLDS,
    Case,
    Twin,
    both_layouts,
    key,
    make_env,
    make_storage,
    rollout,
    stored,
)
from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer
from torchrl.envs import Compose, GymEnv, StepCounter, TransformedEnv

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
