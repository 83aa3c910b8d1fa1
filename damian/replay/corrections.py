"""What transforms after the receiver do to the entries that it computes, done again on stored steps.

``corrections_of`` finds them in an environment, for ``BackupdateStorage(corrections=...)``.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Protocol, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from damian import keys
from damian.common import checks
from damian.common.errors import InputError
from damian.common.tensors import expand_mask
from damian.keys import next_key
from damian.replay.hindsight import paid_by_now
from damian.transforms import ActionHistory, CumulativeReward, RewardDelay, SampleAndHold
from damian.transforms.entries import Entries
from damian.transforms.order import leaf_transforms
from damian.transforms.reward_delay import discounted_sum


class Correction(Protocol):
    """A pure function that changes entries after consecutive stored steps."""

    @property
    def lookback(self) -> int:
        """Number of earlier steps on which the entries after a step depend."""
        ...

    def __call__(self, entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
        """Change what was recomputed.

        Args:
            entries: entries after the steps, by keys that begin with ``"next"``.
            steps: stored steps [T, B], the last of which is the latest one.
            count: earlier steps in the episode of each step, [T, B].
        """
        ...


@dataclass(frozen=True)
class CreditLateRewards:
    """Credits a late reward to the step that earned it, as soon as it has been paid (``RewardDelay``).

    Args:
        reward_key: key of the reward. What ``recompute`` returns is what the step earned.
        delay_key: key of the delay of the reward earned in each step.
        earned_key: key of the reward earned in each step, which is used if ``recompute`` returns none.
    """

    reward_key: NestedKey
    delay_key: NestedKey
    earned_key: NestedKey | None = None
    lookback: int = 0

    def __call__(self, entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
        key = next_key(self.reward_key)
        earned = entries[key] if key in entries else _stored(steps, "earned_key", self.earned_key)
        paid = self.paid(steps, count).squeeze(-1)
        return entries | {key: torch.where(expand_mask(paid, earned), earned, torch.zeros_like(earned))}

    def delay(self, steps: TensorDictBase) -> Tensor:
        """Delay of the reward of each step [steps]."""
        return _stored(steps, "delay_key", self.delay_key)

    def paid(self, steps: TensorDictBase, count: Tensor) -> Tensor:
        """Whether the reward of each step has been paid by the last step, as the delay in shape."""
        delay = self.delay(steps)
        begins = expand_mask(count == 0, delay).expand_as(delay)
        return paid_by_now(delay, begins, expand_mask(steps[keys.RESET_AFTER].squeeze(-1), delay))


@dataclass(frozen=True)
class SumLatestRewards:
    """Replaces rewards by the discounted sum of the latest ones of the episode (eq. 4, ``CumulativeReward``).

    Args:
        reward_key: key of the reward.
        steps: number of rewards in the sum.
        gamma: discount per step.
    """

    reward_key: NestedKey
    steps: int
    gamma: float

    @property
    def lookback(self) -> int:
        return self.steps - 1

    def __call__(self, entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
        key = next_key(self.reward_key)
        reward = _recomputed(entries, key, "sum")
        before = torch.cat([reward.new_zeros(self.lookback, *reward.shape[1:]), reward])
        past = before.unfold(0, self.steps, 1).movedim(-1, 0).flip(0)  # [K, T, B, ...], the newest first
        age = torch.arange(self.steps, device=count.device).view(-1, 1, 1)
        past = past.masked_fill(expand_mask(age > count, past), 0)
        return entries | {key: discounted_sum(past, self.gamma, cast(Tensor, steps[key]).dtype)}


@dataclass(frozen=True)
class HoldBetweenTicks:
    """Keeps entries, between two ticks of a slow clock, as they were at the latest tick (``SampleAndHold``).

    The clock ticks at every reset, and every ``period`` steps from there.

    Args:
        held_keys: keys of the entries.
        period: steps between two ticks.
    """

    held_keys: tuple[NestedKey, ...]
    period: int

    @property
    def lookback(self) -> int:
        return self.period - 1

    def __call__(self, entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
        elapsed = count + 1
        index = torch.arange(len(count), device=count.device).unsqueeze(-1)
        tick, world = index - elapsed % self.period, torch.arange(count.shape[1], device=count.device)
        # Nothing is late at a reset: what was held until the first tick after it stays.
        stays, held = (elapsed < self.period) | (tick < 0), dict(entries)
        for key in map(next_key, self.held_keys):
            value = _recomputed(entries, key, "hold")
            stored = steps[key][..., : value.shape[-1]]
            at_tick = value[tick.clamp(min=0), world]
            held[key] = torch.where(expand_mask(stays, value), stored, at_tick)
        return held


@dataclass(frozen=True)
class KeepLastColumns:
    """Completes an entry by its stored last columns, such as an actor's past actions (``ActionHistory``).

    Args:
        key: key of the entry, of which ``recompute`` returns only the first columns.
    """

    key: NestedKey
    lookback: int = 0

    def __call__(self, entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
        key = next_key(self.key)
        value = _recomputed(entries, key, "complete")
        return entries | {key: torch.cat([value, steps[key][..., value.shape[-1] :]], -1)}


def corrections_of(transform: Transform, recomputed: Collection[NestedKey]) -> list[Correction]:
    """The corrections that follow from the transforms of an environment, in their order.

    Args:
        transform: a transform, or a ``Compose`` of several (``env.transform``).
        recomputed: keys of the entries that ``recompute`` returns, without ``"next"``, and of the rewards.

    Raises:
        InputError: a transform does not write what its correction reads, or its clocks are staggered.
    """
    found: list[Correction] = []
    for leaf in leaf_transforms(transform):
        if isinstance(leaf, RewardDelay) and leaf.reward_key in recomputed:
            if leaf.delay_key is None:
                raise InputError(
                    "RewardDelay: back-updating needs each delay: give it delay_key='reward_delay'"
                )
            found.append(CreditLateRewards(leaf.reward_key, leaf.delay_key, leaf.earned_key))
        elif isinstance(leaf, CumulativeReward) and leaf.reward_key in recomputed and leaf.n_past > 1:
            found.append(SumLatestRewards(leaf.reward_key, leaf.n_past, leaf.gamma))
        elif isinstance(leaf, SampleAndHold) and leaf.period > 1:
            held = tuple(key for key in leaf.in_keys if key in recomputed)
            should = "has ticks that no stored step tells: back-updating needs a clock without stagger"
            checks.require(not (held and leaf.stagger), "SampleAndHold: stagger", leaf.stagger, should)
            found += [HoldBetweenTicks(held, leaf.period)] if held else []
        elif isinstance(leaf, ActionHistory):
            found += [KeepLastColumns(key) for key in leaf.in_keys if key in recomputed]
    return found


def _recomputed(entries: Entries, key: NestedKey, verb: str) -> Tensor:
    """The entry that ``recompute`` returned under a key."""
    if key not in entries:
        raise InputError(f"recompute: it returns no {key}, which a correction is to {verb}")
    return entries[key]


def _stored(steps: TensorDictBase, name: str, key: NestedKey | None) -> Tensor:
    """The entry after the steps that ``RewardDelay`` writes under the key of this argument."""
    value = None if key is None else steps.get(next_key(key), None)
    if value is None:
        raise InputError(f"{name}: the steps have no {key} after them: RewardDelay({name}=...) writes it")
    return value
