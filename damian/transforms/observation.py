"""Observations that arrive late."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded

from damian import checks
from damian.delays import ORDERS, law_of
from damian.transforms.mailbox import Delivery, Mailbox
from damian.transforms.stateful import Order, Stateful, as_rows, beside, flag_rows, row_shape


class ObservationDelay(Stateful):
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

    A bare name for one of the last keys means one beside ``in_keys[0]``.

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
        self.mailbox = Mailbox(law_of(delay).sampler(dt, loss), order, len(self.in_keys))
        self._first: NestedKey = self.in_keys[0]
        self.age_key, self.fresh_key, self.delay_key, self.sent_key = (
            beside(self._first, key) for key in (age_key, fresh_key, delay_key, sent_key)
        )

    def compile(self) -> None:  # type: ignore[override]
        """Compile what a step computes."""
        self.mailbox.compile()

    @property
    def order(self) -> Order:
        sent = [self.sent_key] if self.sent_key else []
        made = [key for key in self.out_keys if key not in self.in_keys]
        return Order(reads=[*self.in_keys, *sent], holds=self.in_keys, makes=made)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        shape = row_shape(tensordict_reset, self._first)
        values = self._values(tensordict_reset, shape)
        if not self.mailbox.begun:
            streams = self._streams(tensordict_reset.batch_size, shape, values[0].device)
            self.mailbox.allocate(values, streams)
        self.mailbox.begin(values, flag_rows(tensordict, "_reset", self._first, shape))
        return self._show(tensordict_reset, shape, Delivery.at_once(values))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if not self.mailbox.begun:
            self._refuse()
        shape = row_shape(next_tensordict, self._first)
        sent = next_tensordict.get(self.sent_key).reshape(-1) if self.sent_key else None
        delivery = self.mailbox.exchange(self._values(next_tensordict, shape), sent)
        return self._show(next_tensordict, shape, delivery)

    def _values(self, tensordict: TensorDictBase, shape: torch.Size) -> list[Tensor]:
        return [as_rows(tensordict.get(key), shape) for key in self.in_keys]

    def _show(self, tensordict: TensorDictBase, shape: torch.Size, what: Delivery) -> TensorDictBase:
        for key, held in zip(self.out_keys, what.held, strict=True):
            tensordict.set(key, held.view(*shape, *held.shape[1:]))
        if self.age_key:
            tensordict.set(self.age_key, what.age.float().view(*shape, 1))
        if self.fresh_key:
            tensordict.set(self.fresh_key, what.fresh.view(*shape, 1))
        if self.delay_key:
            delay = torch.where(what.delay < self.mailbox.sampler.lost, what.delay, -1)
            tensordict.set(self.delay_key, delay.view(*shape, 1))
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            if out_key != key:
                observation_spec[out_key] = observation_spec[key].clone()
        inner = observation_spec
        if isinstance(self._first, tuple):
            inner = observation_spec[self._first[:-1]]
        shape, device = torch.Size((*inner.shape, 1)), observation_spec.device
        if self.age_key:
            observation_spec[self.age_key] = Unbounded(shape, device=device)
        if self.fresh_key:
            observation_spec[self.fresh_key] = Binary(1, shape=shape, dtype=torch.bool, device=device)
        if self.delay_key:
            observation_spec[self.delay_key] = Unbounded(shape, dtype=torch.long, device=device)
        return observation_spec
