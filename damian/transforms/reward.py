"""Rewards that are paid late, and rewards that look back."""

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian import checks
from damian.compiling import compiled
from damian.delays import law_of
from damian.transforms.stateful import Order, Stateful, as_rows, flag_rows, row_shape, wide


class OnRewards(Stateful):
    """A transform that remembers rewards, in a buffer [K, M, ...]."""

    past: Tensor

    def __init__(self, reward_key: NestedKey, seed: int | None = None) -> None:
        super().__init__([reward_key], [reward_key], seed=seed)
        self.reward_key: NestedKey = self.in_keys[0]
        self.register_buffer("past", None)

    @property
    def order(self) -> Order:
        return Order(holds=[self.reward_key])

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self.past is None:  # made by the first step, as a reset shows no reward
            return tensordict_reset
        rows = row_shape(tensordict_reset, self.reward_key)
        mask = flag_rows(tensordict, "_reset", self.reward_key, rows)
        if mask is None:
            self.past = torch.zeros_like(self.past)
        else:
            self.past = self.past.masked_fill(wide(mask, self.past[0]), 0)
        return tensordict_reset


class RewardDelay(OnRewards):
    """Pays each reward some steps later; what is still owed when an episode ends is paid with its last step.

    Without a delay nothing changes, bit for bit.

    Args:
        delay: a law without losses, steps, or a time (``damian.delays.law_of``); drawn for each world, each
            agent (under a nested key) and each step.
        reward_key: the reward.
        dt: length of a step [s], for laws in time.
        seed: of the delays.

    Raises:
        InputError: an impossible law, or one that loses rewards.
    """

    clock: Tensor
    streams: Tensor
    memory: Tensor

    def __init__(
        self, delay: Any, reward_key: NestedKey = "reward", *, dt: float = 1.0, seed: int | None = None
    ) -> None:
        super().__init__(reward_key, seed)
        self.sampler = law_of(delay).sampler(dt)
        loses = (self.sampler.chances[:, -1] > 1e-9).any().item()
        checks.require(not loses, "delay", delay, "loses messages, but no reward may be lost")
        for name in ("clock", "streams", "memory"):
            self.register_buffer(name, None)
        self._advance = self._pay

    def compile(self) -> None:  # type: ignore[override]
        """Compile what a step computes."""
        self._advance = compiled(self._pay)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        rows = row_shape(next_tensordict, self.reward_key)
        reward = as_rows(next_tensordict.get(self.reward_key), rows)
        if self.past is None:
            self._allocate(reward, self._streams(next_tensordict.batch_size, rows, reward.device))
        done = flag_rows(next_tensordict, "done", self.reward_key, rows)
        if done is None:
            done = torch.zeros_like(self.streams, dtype=torch.bool)
        state = self.clock, self.streams, self.memory, self.past
        self.clock, self.memory, self.past, paid = self._advance(*state, reward, done)
        return next_tensordict.set(self.reward_key, paid.view(*rows, *reward.shape[1:]))

    def _pay(
        self,
        clock: Tensor,
        streams: Tensor,
        memory: Tensor,
        pending: Tensor,
        reward: Tensor,
        done: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """New clock, channels' memory and pending rewards [K, M, ...], and what is paid now [M, ...]."""
        clock = clock + 1
        n_slots, n_rows = pending.shape[:2]
        delay, memory = self.sampler(streams, clock, memory)
        row = (clock + delay) % n_slots * n_rows + torch.arange(n_rows, device=delay.device)
        pending = pending.flatten(0, 1).index_add(0, row, reward).view_as(pending)
        today = (clock % n_slots).view(1)
        due = pending.index_select(0, today).squeeze(0)
        over = wide(done, due)
        paid = torch.where(over, pending.sum(0), due)
        pending = pending.index_fill(0, today, 0).masked_fill(over, 0)
        return clock, memory, pending, paid

    def _allocate(self, reward: Tensor, streams: Tensor) -> None:
        self.clock, self.streams = streams.new_zeros(()), streams
        self.memory = self.sampler.begin(streams)
        self.past = reward.new_zeros(self.sampler.longest + 1, *reward.shape)


class CumulativeReward(OnRewards):
    """Replaces a reward by the discounted sum of the latest ones (eq. 4 of the paper).

    R(t) = sum of gamma^(t - t') r(t') over the last ``steps`` steps t' <= t of the episode. With one step
    nothing changes.

    Args:
        steps: T, how many rewards are summed up.
        gamma: in (0, 1].
        reward_key: the reward.
    """

    def __init__(self, steps: int, gamma: float = 0.9, reward_key: NestedKey = "reward") -> None:
        checks.in_range("steps", steps, 1)
        checks.above("gamma", gamma, 0.0)
        checks.in_range("gamma", gamma, 0.0, 1.0)
        super().__init__(reward_key)
        self.steps = steps
        self.weights = [gamma**age for age in range(steps)]

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        rows = row_shape(next_tensordict, self.reward_key)
        reward = as_rows(next_tensordict.get(self.reward_key), rows)
        if self.past is None:
            self.past = reward.new_zeros(self.steps, *reward.shape)
        self.past = torch.cat([reward.unsqueeze(0), self.past[:-1]])
        total = torch.tensordot(reward.new_tensor(self.weights), self.past, 1)
        return next_tensordict.set(self.reward_key, total.view(*rows, *reward.shape[1:]))
