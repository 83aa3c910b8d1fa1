"""Agents and servers that look at the world less often than it moves."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian.common import checks
from damian.common.tensors import expand_mask
from damian.delays.laws import Delay, in_steps
from damian.transforms.base import StatefulTransform
from damian.transforms.entries import Change, Entries, Memory, as_rows, from_rows, select_entries
from damian.transforms.order import KeyUsage


class SampleAndHold(StatefulTransform):
    """Between two ticks entries stay what they were, and actions too (paper, section 3.6).

    Every episode begins with a tick. With a period of one step nothing changes.

    Args:
        period: steps, or a time.
        in_keys: entries that are sampled and held, in TensorDicts of the same batch size.
        in_keys_inv: actions that are held: what is chosen between two ticks is not executed.
        ready_key: flag that is false between two ticks, [...] bool: no decision is taken.
        dt: length of a step [s], for a period in time.

    Raises:
        InputError: an impossible period.
    """

    def __init__(
        self,
        period: Delay,
        in_keys: Sequence[NestedKey] = ("observation",),
        in_keys_inv: Sequence[NestedKey] = (),
        *,
        ready_key: NestedKey | None = None,
        dt: float = 1.0,
    ) -> None:
        super().__init__(in_keys, in_keys, in_keys_inv, in_keys_inv)
        self.period = in_steps("period", period, dt)
        checks.in_range("period", self.period, 1, unit="steps")
        self.ready_key = ready_key
        self.action_keys = self.in_keys_inv
        self.step_keys = [*self.in_keys, *([ready_key] if ready_key else [])]

    @property
    def key_usage(self) -> KeyUsage:
        return KeyUsage(reads=self.step_keys, delays=self.in_keys, replaces=self.in_keys_inv)

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        seen = select_entries(tensordict, self.in_keys)
        device = seen[self.in_keys[0]].device
        elapsed = torch.zeros(self.rows.numel(), dtype=torch.long, device=device)
        held = {f"held_{i}": as_rows(value, self.rows) for i, value in enumerate(seen.values())}
        specs = self.env.full_action_spec
        acted = {
            f"acted_{i}": as_rows(specs[key].zero(), self.rows) for i, key in enumerate(self.in_keys_inv)
        }
        return {"elapsed": elapsed, **held, **acted}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory = memory | {"elapsed": memory["elapsed"].masked_fill(mask, 0)}
        return self._hold(memory, entries, self.in_keys, "held", mask)

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        return self._hold(memory, entries, self.in_keys_inv, "acted", self._ticks(memory))

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        memory = memory | {"elapsed": memory["elapsed"] + 1}
        ticks = self._ticks(memory)
        memory, shown = self._hold(memory, entries, self.in_keys, "held", ticks)
        if self.ready_key:
            ready = entries[self.ready_key]
            shown[self.ready_key] = ready & ticks.view_as(ready)
        return memory, shown

    def _ticks(self, memory: Memory) -> Tensor:
        """Is this step a tick, [M]."""
        return memory["elapsed"] % self.period == 0

    def _hold(
        self, memory: Memory, entries: Entries, keys: Sequence[NestedKey], name: str, take: Tensor
    ) -> Change:
        """Take the entries where they may be taken [M], and show what is held."""
        shown: Entries = {}
        for i, key in enumerate(keys):
            new, old = as_rows(entries[key], self.rows), memory[f"{name}_{i}"]
            held = torch.where(expand_mask(take, new), new, old)
            memory = memory | {f"{name}_{i}": held}
            shown[key] = from_rows(held, self.rows)
        return memory, shown
