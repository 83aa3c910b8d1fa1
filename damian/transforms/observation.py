"""A transform that delays observations (paper, section 3.4)."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from damian.common import checks
from damian.delays.laws import sampler_of
from damian.delays.line import ORDERS, DelayLine, Delivery
from damian.transforms.base import Change, Memory, StatefulTransform
from damian.transforms.context import ContextReader
from damian.transforms.entries import (
    Entries,
    Keys,
    add_spec,
    existing,
    select_entries,
    sibling_key,
    spec_rows,
)


class ObservationDelay(StatefulTransform):
    """Delays observations: replaces the current observation by the latest one received, and writes
    its age.

    In each step, the entries ``in_keys`` of a world (or agent) are sent together as one message.
    The receiver holds a message until another one arrives. After a reset it holds the first message
    of the episode, which has no delay. With delay 0 the rollout is the same, bit for bit, as
    without the transform.

    A worked timeline, with a delay of 3 steps: the reset, t = 0, shows observation 0, of age 0.
    Observation 1 is sent at t = 1 and arrives at t = 4. So t = 1, 2 and 3 show observation 0 again,
    of ages 1, 2 and 3, and t = 4 shows observation 1, of age 3.

    Args:
        delay: steps (``3``), a time (``"3s"``), a distribution (``Uniform(3, 7)``), a function of a
            ``MessageContext``, or a ``Sampler``. A delay is drawn for each world, each agent
            (under a nested key) and each step.
        in_keys: keys of the entries that are sent together, or one key. A bare name for another key
            means an entry beside the first one.
        out_keys: keys under which the received entries are written; if not given, ``in_keys``.
        loss: probability that a message is lost.
        order: ``generation``: the receiver holds the message that was generated last, so that the
            age grows
            by at most one per step. ``arrival``: it holds the message that arrived last.
        dt: length of a step [s], for delays given as times.
        age_key: key for the age of the held message [steps], [..., 1] float; or None.
        delay_key: key for the delay of the message sent in this step [steps], [..., 1] long, -1 if
            it never arrives; or None. An actor must not observe it; back-updating needs it.
        sent_key: key of a flag, [...] bool: which rows send a message in this step; if not given,
            all do.
        context_keys: keys of the entries that the law may read, by name (``ContextSampler``).
        seed: as in ``StatefulTransform``.

    Examples:
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), ObservationDelay(Uniform(3, 7), loss=0.1))
        >>> env.rollout(100)["age"]  # steps since each observation was generated
    """

    def __init__(
        self,
        delay: Any,
        in_keys: Keys = "observation",
        out_keys: Keys | None = None,
        *,
        loss: float = 0.0,
        order: str = "generation",
        dt: float = 1.0,
        age_key: NestedKey | None = "age",
        delay_key: NestedKey | None = None,
        sent_key: NestedKey | None = None,
        context_keys: Mapping[str, NestedKey] | None = None,
        seed: int | None = None,
    ) -> None:
        checks.one_of("order", order, ORDERS)
        super().__init__(in_keys, out_keys or in_keys, seed=seed)
        self.sampler = sampler_of(delay, dt, loss)
        self.line = DelayLine(self.sampler, order)
        self.age_key, self.delay_key, self.sent_key = (
            sibling_key(self.row_key, key) for key in (age_key, delay_key, sent_key)
        )
        self.out_keys = [*self.out_keys, *existing([self.age_key, self.delay_key])]
        self.contexts = ContextReader(self.sampler, context_keys, dt, self.row_key)
        self.step_keys = existing([*self.in_keys, self.sent_key, *self.contexts.keys.values()])

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        values = self._values(select_entries(tensordict, self.in_keys))
        streams = self.streams(tensordict.batch_size, values[0].device, self.sampler)
        memory = self.line.init_memory(values, streams)
        return self.contexts.init_memory(memory, tensordict, self.rows)

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory, delivery = self.line.reset(memory, self._values(entries), mask)
        return memory, self._outputs(delivery)

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        sent = self.sending_rows(entries)
        context = self.contexts.read(memory, entries, sent, self.rows)
        memory, delivery = self.line.step(memory, self._values(entries), sent, context)
        return memory, self._outputs(delivery)

    def _values(self, entries: Entries) -> list[Tensor]:
        return [self.to_rows(entries[key]) for key in self.in_keys]

    def _outputs(self, delivery: Delivery) -> Entries:
        # A copy, because the line keeps what it holds; the other ``out_keys`` follow.
        pairs = zip(self.out_keys, delivery.held, strict=False)
        entries = {key: self.from_rows(value.clone()) for key, value in pairs}
        if self.age_key:
            entries[self.age_key] = delivery.age.to(torch.float32).view(*self.rows, 1)
        if self.delay_key:
            delay = torch.where(delivery.delay < self.sampler.lost, delivery.delay, -1)
            entries[self.delay_key] = delay.view(*self.rows, 1)
        return entries

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        for key, out_key in zip(self.in_keys, self.out_keys, strict=False):
            if out_key != key:
                observation_spec[out_key] = observation_spec[key].clone()
        shape = (*spec_rows(observation_spec, self.row_key), 1)
        add_spec(observation_spec, self.age_key, shape)
        add_spec(observation_spec, self.delay_key, shape, torch.long)
        return observation_spec
