"""Observations that arrive late."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded

from damian.common import checks
from damian.delays.delay_line import ORDERS, DelayLine, Delivery
from damian.delays.laws import law_of
from damian.transforms.base import StatefulTransform
from damian.transforms.entries import (
    Change,
    Entries,
    Memory,
    as_rows,
    from_rows,
    select_entries,
    sibling_key,
    spec_rows,
)
from damian.transforms.order import KeyUsage


class ObservationDelay(StatefulTransform):
    """Shows what has arrived instead of what is: each step's entries travel as one message.

    After a reset the first message is there at once. Without a delay nothing changes, bit for bit.

    Args:
        delay: a law, steps, or a time (``damian.delays.law_of``); drawn for each world, each agent (under a
            nested key) and each step.
        in_keys: entries that travel together, with the same batch size.
        out_keys: where what has arrived is shown; in place of what is, if not given.
        loss: probability that a message is lost.
        order: show what was ``generation``-ated last (its age grows by at most one a step) or what came
            last (``arrival``).
        dt: length of a step [s], for laws in time.
        age_key: where the age of what is shown is written [steps], [..., 1] float; None for nowhere.
        fresh_key: where is written whether it arrived just now, [..., 1] bool; None for nowhere.
        delay_key: where the delay of the message sent just now is written [steps], [..., 1]; -1 if it will
            never arrive. Nothing that an actor may know: a learner's storage needs it.
        sent_key: which rows send in this step, [...] bool; all of them if not given.
        seed: of the delays.

    A bare name for one of the last keys means one sibling_key ``in_keys[0]``.

    Raises:
        InputError: an impossible law.
    """

    def __init__(
        self,
        delay: Any,
        in_keys: Sequence[NestedKey] = ("observation",),
        out_keys: Sequence[NestedKey] | None = None,
        *,
        loss: float = 0.0,
        order: str = "generation",
        dt: float = 1.0,
        age_key: NestedKey | None = "age",
        fresh_key: NestedKey | None = None,
        delay_key: NestedKey | None = None,
        sent_key: NestedKey | None = None,
        seed: int | None = None,
    ) -> None:
        checks.one_of("order", order, ORDERS)
        super().__init__(in_keys, out_keys or in_keys, seed=seed)
        self.sampler = law_of(delay).sampler(dt, loss)
        self.line = DelayLine(self.sampler, order)
        self.age_key, self.fresh_key, self.delay_key, self.sent_key = (
            sibling_key(self.row_key, key) for key in (age_key, fresh_key, delay_key, sent_key)
        )
        self.step_keys = [*self.in_keys, *([self.sent_key] if self.sent_key else [])]

    @property
    def key_usage(self) -> KeyUsage:
        made = [key for key in self.out_keys if key not in self.in_keys]
        return KeyUsage(reads=self.step_keys, delays=self.in_keys, creates=made)

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        values = self._values(select_entries(tensordict, self.in_keys))
        return self.line.init_memory(values, self.streams(tensordict.batch_size, values[0].device))

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory, delivery = self.line.reset(memory, self._values(entries), mask)
        return memory, self._shown(delivery)

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        sent = entries[self.sent_key].reshape(-1) if self.sent_key else None
        memory, delivery = self.line.step(memory, self._values(entries), sent)
        return memory, self._shown(delivery)

    def _values(self, entries: Entries) -> list[Tensor]:
        return [as_rows(entries[key], self.rows) for key in self.in_keys]

    def _shown(self, what: Delivery) -> Entries:
        shown = {key: from_rows(held, self.rows) for key, held in zip(self.out_keys, what.held, strict=True)}
        flags = {self.age_key: what.age.float(), self.fresh_key: what.fresh}
        if self.delay_key:
            flags[self.delay_key] = torch.where(what.delay < self.sampler.lost, what.delay, -1)
        return shown | {key: flag.view(*self.rows, 1) for key, flag in flags.items() if key is not None}

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            if out_key != key:
                observation_spec[out_key] = observation_spec[key].clone()
        shape = torch.Size((*spec_rows(observation_spec, self.row_key), 1))
        device = observation_spec.device
        if self.age_key:
            observation_spec[self.age_key] = Unbounded(shape, device=device)
        if self.fresh_key:
            observation_spec[self.fresh_key] = Binary(1, shape=shape, dtype=torch.bool, device=device)
        if self.delay_key:
            observation_spec[self.delay_key] = Unbounded(shape, dtype=torch.long, device=device)
        return observation_spec
