"""Transforms that delay rewards, and sum the latest ones (paper, section 3.5)."""

from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from damian import keys
from damian.common import checks
from damian.common.errors import InputError
from damian.common.tensors import expand_mask, next_true, where_rows
from damian.delays.laws import LOSES, sampler_of
from damian.keys import next_key
from damian.transforms.base import Change, Correction, Memory, StatefulTransform
from damian.transforms.context import ContextReader
from damian.transforms.entries import (
    Entries,
    add_spec,
    any_flag,
    existing,
    flag_keys,
    sibling_key,
    spec_rows,
)


class RewardTransform(StatefulTransform):
    """Base class of transforms that add up rewards of up to K = ``n_slots`` steps.

    The memory's ``past`` [M, K, ...] has rewards of each row.
    """

    is_of_rewards = True
    n_slots: int
    lowest_dtype = torch.bool
    """Sums have the dtype of the rewards, or this one if it is higher."""

    def __init__(self, reward_key: NestedKey, seed: int | None = None) -> None:
        super().__init__(reward_key, reward_key, seed=seed)
        self.reward_key: NestedKey = self.in_keys[0]

    def no_rewards(self) -> Tensor:
        """Rewards of 0, [M, K, ...]."""
        specs = self.env.full_reward_spec
        zero = self.as_rows_of_spec(specs[self.reward_key].zero(), specs, self.reward_key)
        return zero.unsqueeze(1).repeat_interleave(self.n_slots, 1)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:  # type: ignore[override]
        key = self.reward_key
        if self.n_slots > 1:  # sums of rewards have other bounds than one reward
            old = reward_spec[key]
            dtype = torch.promote_types(old.dtype, self.lowest_dtype)
            reward_spec[key] = Unbounded(old.shape, dtype=dtype, device=old.device)
        return reward_spec


class RewardDelay(RewardTransform):
    """Delays rewards: each reward is received some steps after it was earned.

    Rewards that are received in the same step are added up. In the last step of an episode, all
    rewards in transit are received, so that none is lost. Hence the transform must come after every
    transform that ends episodes, such as ``StepCounter(max_steps=100)``. With delay 0 the rollout
    is the same, bit for bit, as without it.

    A worked timeline, with a delay of 3 steps: the reward r1 of the first step is earned at t = 1
    and received at t = 4; the steps before receive 0. If the episode ends at t = 5, that step
    receives r2 + r3 + r4 + r5.

    The memory's ``past`` [M, K, ...] is what each row will receive, by the number of steps until
    then.

    Args:
        delay, dt, context_keys, seed: as in ``ObservationDelay``; the law must lose nothing.
        reward_key: key of the reward.
        delay_key: key for the delay of the reward earned in this step [steps], [..., 1] long, 0
            after a reset. A bare name, here and below, means an entry beside the reward. An actor
            must not observe either.
        earned_key: key for the reward earned in this step, whenever it is received; 0 after a
            reset. Back-updating needs it if no messages tell the reward.

    Examples:
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), RewardDelay(Uniform(0, 4)))
        >>> rollout = env.rollout(200)  # the sum of the rewards is that of the environment
    """

    flushes_at_end = True

    def __init__(
        self,
        delay: Any,
        reward_key: NestedKey = "reward",
        *,
        dt: float = 1.0,
        context_keys: Mapping[str, NestedKey] | None = None,
        delay_key: NestedKey | None = None,
        earned_key: NestedKey | None = None,
        seed: int | None = None,
    ) -> None:
        super().__init__(reward_key, seed)
        self.delay_key = sibling_key(self.reward_key, delay_key)
        self.earned_key = sibling_key(self.reward_key, earned_key)
        self.out_keys = [self.reward_key, *existing([self.delay_key, self.earned_key])]
        self.sampler = sampler_of(delay, dt)
        checks.require(not self.sampler.loses, "delay", delay, LOSES)
        self.n_slots = self.sampler.longest + 1
        self.contexts = ContextReader(self.sampler, context_keys, dt, self.reward_key)

    @property
    def required_keys(self) -> Sequence[NestedKey]:
        return [self.reward_key, *self.contexts.keys.values()]

    @property
    def step_keys(self) -> Sequence[NestedKey]:  # type: ignore[override]
        return [*self.required_keys, *self.done_keys]

    @cached_property
    def done_keys(self) -> list[NestedKey]:
        """Keys of the flags that end an episode of the reward, by the environment's specs."""
        return flag_keys("done", self.reward_key, self.env.done_keys)

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        past = self.no_rewards()
        streams = self.streams(tensordict.batch_size, past.device, self.sampler)
        zero = torch.zeros_like(streams)
        state = self.sampler.initial_state(streams)
        memory = {name: zero.clone() for name in ("clock", "reset_at")}
        memory |= {"streams": streams, "state": state, "past": past}
        return self.contexts.init_memory(memory, tensordict, self.rows)

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        clock = memory["clock"]
        past = where_rows(~mask, memory["past"], 0)
        memory = memory | {
            "reset_at": torch.where(mask, clock, memory["reset_at"]),
            "state": self.sampler.begin_episode(memory["state"], mask),
            "past": past,
        }
        return memory, self._told(torch.zeros_like(clock), torch.zeros_like(past[:, 0]))

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        clock = memory["clock"] + 1
        reward = self.to_rows(entries[self.reward_key])
        context = self.contexts.read(memory, entries, None, self.rows)
        delay, state = self.sampler(memory["streams"], clock, memory["state"], context)
        before = memory["past"]
        past = torch.cat([before[:, 1:], torch.zeros_like(before[:, :1])], 1)
        steps = torch.arange(self.n_slots, device=delay.device)
        arrives = steps == delay.unsqueeze(-1)
        past = where_rows(arrives, past + reward.unsqueeze(1), past)
        received = past[:, 0]
        done = [entries[key] for key in self.done_keys if key in entries]
        if done:
            ended = any_flag(done, self.rows)
            # In double precision, so that the order of the sum, which depends on the batch, does
            # not matter.
            precise = torch.float64 if past.is_floating_point() else past.dtype
            in_transit = past[:, 1:].sum(1, dtype=precise).to(past.dtype)
            received = where_rows(ended, received + in_transit, received)
            past = where_rows(~ended, past, 0)
        memory = memory | {"clock": clock, "state": state, "past": past}
        outputs: Entries = {self.reward_key: self.from_rows(received)}
        return memory, outputs | self._told(delay, reward)

    def _told(self, delay: Tensor, earned: Tensor) -> Entries:
        """The entries of ``delay_key`` and ``earned_key``, from the delays [M] and the rewards
        [M, ...]."""
        entries = {}
        if self.delay_key is not None:
            delays = delay.unsqueeze(-1).clone()
            entries[self.delay_key] = self.from_rows(delays)
        if self.earned_key is not None:
            entries[self.earned_key] = self.from_rows(earned.clone())
        return entries

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        rewards = self.env.full_reward_spec
        earned = rewards[self.reward_key]
        rows = spec_rows(rewards, self.reward_key)
        add_spec(observation_spec, self.delay_key, (*rows, 1), torch.long)
        add_spec(observation_spec, self.earned_key, earned.shape, earned.dtype)
        return observation_spec

    def hindsight(self, keys: Collection[NestedKey]) -> Correction | None:
        """Credits a late reward to the step that earned it, as soon as it has been paid."""
        if self.reward_key not in keys:
            return None
        if self.delay_key is None:
            raise InputError(
                "RewardDelay: back-updating needs each delay: give it delay_key='reward_delay'"
            )
        return Correction(self._credit, paid=self._paid, delay_key=self.delay_key)

    def _credit(self, entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
        """What the rewards are by now: what a step earned if that has been paid, else 0."""
        key = next_key(self.reward_key)
        earned_key = self.earned_key and next_key(self.earned_key)
        if key in entries:
            earned = entries[key]
        elif earned_key is not None and earned_key in steps.keys(True):
            earned = steps[earned_key]
        else:
            raise InputError(
                f"earned_key: nothing says what {key} was earned: give RewardDelay an earned_key"
            )
        paid = self._paid(steps, count).squeeze(-1)
        return entries | {key: where_rows(paid, earned, 0)}

    def _paid(self, steps: TensorDictBase, count: Tensor) -> Tensor:
        """Whether the reward of each step has been paid by the last step, in the shape of the
        delays."""
        key = next_key(cast(NestedKey, self.delay_key))
        delay = cast(Tensor, steps[key])
        begins = expand_mask(count == 0, delay).expand_as(delay)
        number = torch.arange(len(delay), device=delay.device)
        step = expand_mask(number, delay).expand_as(delay)
        # The last step before a reset pays what is still in transit, if the environment was done
        # there.
        end = torch.full_like(step[:1], len(step))
        last = torch.cat([next_true(begins)[1:], end]) - 1
        reset_after = steps[keys.RESET_AFTER].squeeze(-1)
        done = expand_mask(reset_after, delay).expand_as(step)
        arrived = step + delay <= last
        return arrived | done.gather(0, last)


class CumulativeReward(RewardTransform):
    """Replaces the reward by the discounted sum of the latest rewards (paper, eq. 4).

    R(t) = sum of gamma^(t - t') r(t') over the last ``steps`` steps t' <= t of the episode; gamma
    is in (0, 1]. Sums of integers are float32.

    Examples:
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), CumulativeReward(5, gamma=0.9))
        >>> rollout = env.rollout(200)  # each reward is a discounted sum of the last five
    """

    lowest_dtype = torch.float32

    def __init__(self, steps: int, gamma: float = 0.9, reward_key: NestedKey = "reward") -> None:
        checks.whole("steps", steps, 1)
        checks.above("gamma", gamma, 0.0)
        checks.in_range("gamma", gamma, 0.0, 1.0)
        super().__init__(reward_key)
        self.step_keys = self.in_keys
        self.n_slots = steps
        self.gamma = gamma

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        return {"past": self.no_rewards()}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        past = memory["past"]
        past = past.masked_fill(expand_mask(mask, past), 0)
        return {"past": past}, {}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        reward = self.to_rows(entries[self.reward_key])
        before = memory["past"][:, :-1]
        past = torch.cat([reward.unsqueeze(1), before], 1)
        total = discounted_sum(past.movedim(1, 0), self.gamma)
        return {"past": past}, {self.reward_key: self.from_rows(total)}

    def hindsight(self, keys: Collection[NestedKey]) -> Correction | None:
        """Sums the corrected rewards of the same episode."""
        if self.reward_key not in keys or self.n_slots == 1:
            return None
        return Correction(self._sum_again, lookback=self.n_slots - 1)

    def _sum_again(self, entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
        key = next_key(self.reward_key)
        reward = entries[key]
        none_before = reward.new_zeros(self.n_slots - 1, *reward.shape[1:])
        rewards = torch.cat([none_before, reward])
        windows = rewards.unfold(0, self.n_slots, 1)
        past = windows.movedim(-1, 0).flip(0)  # [K, T, B, ...], the newest first
        age = torch.arange(self.n_slots, device=count.device)
        is_earlier = age.view(-1, 1, 1) > count  # of an earlier episode
        past = past.masked_fill(expand_mask(is_earlier, past), 0)
        return entries | {key: discounted_sum(past, self.gamma)}


def discounted_sum(past: Tensor, gamma: float) -> Tensor:
    """The discounted sum (paper, eq. 4) of the latest K rewards, the newest first, [K, ...]."""
    dtype = torch.promote_types(past.dtype, torch.float32)
    ages = torch.arange(len(past), dtype=torch.float64, device=past.device)
    weights = (gamma**ages).to(dtype)
    # In double precision, so that the order of the sum, which depends on the batch, does not
    # matter.
    ones = [1] * (past.dim() - 1)
    weighted = weights.view(-1, *ones) * past
    return weighted.sum(0, dtype=torch.float64).to(dtype)
