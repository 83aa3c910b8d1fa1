"""Agents and servers that look at the world less often than it moves."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian import checks
from damian.delays import Delay, in_steps
from damian.transforms.stateful import Order, Stateful, as_rows, flag_rows, row_shape, wide


class Clock(Stateful):
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

    elapsed: Tensor

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
        self._held = {key: f"held_{i}" for i, key in enumerate([*self.in_keys, *self.in_keys_inv])}
        for name in ("elapsed", *self._held.values()):
            self.register_buffer(name, None)

    @property
    def order(self) -> Order:
        ready = [self.ready_key] if self.ready_key else []
        return Order(reads=ready, holds=self.in_keys, replaces=self.in_keys_inv)

    @property
    def ticks(self) -> Tensor:
        """Is this step a tick, [M] bool."""
        return self.elapsed % self.period == 0

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        rows = row_shape(tensordict_reset, self.in_keys[0])
        mask = flag_rows(tensordict, "_reset", self.in_keys[0], rows)
        if self.elapsed is None or mask is None:
            device = tensordict_reset.get(self.in_keys[0]).device
            self.elapsed = torch.zeros(rows.numel(), dtype=torch.long, device=device)
            mask = torch.ones_like(self.elapsed, dtype=torch.bool)
        self.elapsed = self.elapsed.masked_fill(mask, 0)
        for key in self.in_keys:
            self._hold(tensordict_reset, key, mask, rows)
        return tensordict_reset  # TorchRL keeps what the other worlds showed

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self.in_keys_inv:
            return tensordict
        if self.container is None or self.elapsed is None:
            self._refuse()
        for key in self.in_keys_inv:
            rows = row_shape(tensordict, key)
            tensordict.set(key, self._hold(tensordict, key, self.ticks, rows))
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self.elapsed is None:
            self._refuse()
        self.elapsed = self.elapsed + 1
        ticks = self.ticks
        rows = row_shape(next_tensordict, self.in_keys[0])
        for key in self.in_keys:
            next_tensordict.set(key, self._hold(next_tensordict, key, ticks, rows))
        if self.ready_key:
            ready = next_tensordict.get(self.ready_key)
            next_tensordict.set(self.ready_key, ready & ticks.view_as(ready))
        return next_tensordict

    def _hold(self, tensordict: TensorDictBase, key: NestedKey, take: Tensor, rows: torch.Size) -> Tensor:
        """What is held of an entry, after taking it where it may be taken, [*rows, ...]."""
        value, name = tensordict.get(key), self._held[key]
        new, old = as_rows(value, rows), getattr(self, name)
        held = new if old is None else torch.where(wide(take, new), new, old)
        setattr(self, name, held)
        return held.view_as(value)
