"""Back-updating with late rewards, sums of rewards and slow clocks, against a loop over a world's steps."""

import random
from typing import NamedTuple

import pytest
import torch
from remote import LONGEST, WORLDS, Receiver, Remote, Twin, both_layouts, key, make_storage, rollout, stored
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
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
    set_seed,
)


class Case(NamedTuple):
    """How late rewards are, how many are summed, and how slow the receiver's clock is."""

    latest: int | None = None
    window: int = 1
    period: int = 1
    loss: float = 0.0
    order: str = "generation"


GAMMA = 0.7


def make_late(group: tuple[str, ...], case: Case) -> TransformedEnv:
    """The remote environment with late messages and what a case says."""
    message, received, reward = (key(group, name) for name in ("message", "received", "reward"))
    delay = ObservationDelay(
        Uniform(0, LONGEST),
        [message],
        [received],
        loss=case.loss,
        order=case.order,
        delay_key="delay",
        seed=3,
    )
    transforms = [delay, StepCounter(), Receiver(group)]
    if case.latest is not None:
        transforms.append(RewardDelay(Uniform(0, case.latest), reward, delay_key="reward_delay", seed=4))
    transforms.append(CumulativeReward(case.window, GAMMA, reward))
    transforms.append(SampleAndHold(case.period, [key(group, "observation")]))
    return TransformedEnv(Remote(group), Compose(*transforms))


class LateTwin(Twin):
    """The twin of ``remote``, with late rewards, sums of rewards and a slow clock."""

    def __init__(self, steps: TensorDictBase, world: int, group: tuple[str, ...], case: Case) -> None:
        super().__init__(steps, world, group)
        self.case = case

    def paid(self, t: int, row: tuple[int, ...]) -> bool:
        """Has the reward that step t earned been received by the last step."""
        if self.case.latest is None:
            return True
        delay = int(self.steps[next_key(key(self.group, "reward_delay"))][(t, *row)])
        for later in range(t, self.T):
            if self.start[later] != self.start[t]:
                return False
            if later - t >= delay or self.steps["next", "done"][later]:
                return True
        return False

    def summed(self, t: int, row: tuple[int, ...]) -> float:
        """The reward after the step: eq. 4 of the rewards that have been received."""
        latest = range(max(self.start[t], t - self.case.window + 1), t + 1)
        return sum(GAMMA ** (t - g) * self.reward(g, row) for g in latest if self.paid(g, row))

    def held(self, t: int, row: tuple[int, ...]) -> list[float]:
        """The observation after the step: that of the latest tick, or of the reset."""
        tick = t - (t - self.start[t] + 1) % self.case.period
        if tick < self.start[t]:
            return self.steps[key(self.group, "observation")][(self.start[t], *row)].tolist()
        return self.observation(tick, row)

    def held_before(self, t: int, row: tuple[int, ...]) -> list[float]:
        if t == self.start[t]:
            return self.steps[key(self.group, "observation")][(t, *row)].tolist()
        return self.held(t - 1, row)


def random_case(rng: random.Random) -> Case:
    latest, window, period = rng.choice([None, 0, 2, LONGEST]), rng.randint(1, 4), rng.randint(1, 5)
    return Case(latest, window, period, rng.choice([0.0, 0.4]), rng.choice(["generation", "arrival"]))


def storage_of(env: TransformedEnv, group: tuple[str, ...], n_steps: int) -> BackupdateStorage:
    """A storage of ``n_steps`` steps, with the corrections that follow from the environment."""
    recomputed = [key(group, name) for name in ("observation", "reward")]
    corrections = corrections_of(env.transform, recomputed)
    storage = make_storage(group, corrections=corrections)
    storage.max_size = n_steps * WORLDS
    return storage


@pytest.mark.sample(2)
@both_layouts
@pytest.mark.parametrize("seed", range(4))
def test_stored_steps_become_what_a_slow_twin_says(group, seed):
    rng = random.Random(seed)
    for _ in range(3):
        case, part = random_case(rng), rng.choice([4, 10, 20])
        env = make_late(group, case)
        collected = rollout(env, 40)
        capacity = part + 2 * LONGEST + case.window - 1 + case.period - 1  # the least, so that the ring wraps
        after = stored(storage_of(env, group, min(capacity, 40)), collected, 40 // part)
        steps, n_older = collected.transpose(0, 1), 40 - len(after)
        for world in range(WORLDS):
            twin = LateTwin(steps, world, group, case)
            for t in range(n_older, 40):
                for row in twin.senders:
                    check_step(after, (t - n_older, world, *row), twin, t, row)
    assert n_older >= 0


def check_step(after: TensorDictBase, at: tuple[int, ...], twin: LateTwin, t: int, row: tuple) -> None:
    """Compare what is stored of a step with the twin."""
    observation, reward = key(twin.group, "observation"), key(twin.group, "reward")
    assert after[next_key(reward)][at].item() == pytest.approx(twin.summed(t, row)), (twin.case, t)
    assert after[next_key(observation)][at].tolist() == pytest.approx(twin.held(t, row)), (twin.case, t)
    assert after[observation][at].tolist() == pytest.approx(twin.held_before(t, row)), (twin.case, t)


def test_writing_in_small_batches_around_the_ring_gives_the_same_as_writing_at_once():
    for case in (
        Case(3, 4, 5, 0.7),
        Case(None, 6, 1, 0.7),
        Case(None, 1, 6, 0.5),
        Case(0, 2, 2, 0.7, "arrival"),
    ):
        env = make_late((), case)
        collected = rollout(env, 60)
        least = 2 + 2 * LONGEST + case.window - 1 + case.period - 1
        whole, ring = (
            stored(storage_of(env, (), 200), collected),
            stored(storage_of(env, (), least), collected, 30),
        )
        n_older = 60 - least
        assert all(whole[name][n_older:].equal(ring[name]) for name in ring.keys(True, True)), case


@both_layouts
def test_neither_messages_nor_rewards_that_arrive_later_are_used(group):
    case = Case(4, 3, 2)
    env = make_late(group, case)
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
