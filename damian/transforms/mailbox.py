"""Messages on their way: sent in each step, delivered some steps later, held until a newer one comes."""

from typing import NamedTuple

import torch
from torch import Tensor

from damian.compiling import compiled
from damian.sampling import Sampler
from damian.transforms.stateful import Lazy, wide


class Delivery(NamedTuple):
    """What M receivers hold after a step."""

    held: list[Tensor]
    """The values of the message that each holds, [M, ...] each."""
    age: Tensor
    """Steps since it was generated, [M]."""
    fresh: Tensor
    """Did it arrive just now, [M]."""
    delay: Tensor
    """Of the messages sent just now [steps], [M]; ``Sampler.lost`` if lost, or not sent at all."""

    @classmethod
    def at_once(cls, values: list[Tensor]) -> "Delivery":
        """Every message is there as it is generated."""
        zero = torch.zeros(len(values[0]), dtype=torch.long, device=values[0].device)
        return cls(values, zero, zero == 0, zero)


class Post(NamedTuple):
    """What is on its way and what is held; M senders, K slots for the steps to come and one for the lost."""

    clock: Tensor
    """Steps so far, []."""
    streams: Tensor
    """Random stream of each sender, [M]."""
    memory: Tensor
    """State of each channel, [M]."""
    began: Tensor
    """Clock at the latest reset, [M]."""
    since: Tensor
    """Clock when what is held was generated, [M]."""
    stamps: Tensor
    """Clock when the message in a slot was generated, [K + 1, M]."""
    slots: list[Tensor]
    """Values by the step at which they arrive, [K + 1, M, ...] each."""
    held: list[Tensor]
    """[M, ...] each."""


class Mailbox(Lazy):
    """Delays rows of values by a law; each of M senders sends at most one per step.

    A message is written at once into the slot of the step at which it will arrive, where a later one
    that arrives at the same time replaces it. ``allocate`` makes the buffers.

    Args:
        sampler: the delays.
        order: hold the message ``generation``-ated last, or that came last (``arrival``).
        n_values: tensors in a message.
    """

    def __init__(self, sampler: Sampler, order: str, n_values: int) -> None:
        super().__init__()
        self.sampler = sampler
        self._newest = order == "generation"
        self._tables = [f"slots_{i}" for i in range(n_values)], [f"held_{i}" for i in range(n_values)]
        for name in (*_SINGLE, *self._tables[0], *self._tables[1]):
            self.register_buffer(name, None)
        self._advance, self._compiled = self._exchange, False

    def compile(self) -> None:  # type: ignore[override]
        """Compile what a step computes."""
        self._advance, self._compiled = compiled(self._exchange), True

    @property
    def begun(self) -> bool:
        """Is there anything yet."""
        return self.clock is not None

    def allocate(self, values: list[Tensor], streams: Tensor) -> None:
        """Make the buffers, for values [M, ...] and senders with these random streams [M]."""
        n_slots, zero = self.sampler.lost + 1, torch.zeros_like(streams)
        self.clock, self.streams, self.memory = zero.new_zeros(()), streams, self.sampler.begin(streams)
        self.began, self.since = zero, zero.clone()
        self.stamps = zero.new_full((n_slots, len(streams)), -1)
        for slots, held, value in zip(*self._tables, values, strict=True):
            setattr(self, slots, value.new_zeros(n_slots, *value.shape))
            setattr(self, held, value.clone())

    def begin(self, values: list[Tensor], mask: Tensor | None) -> None:
        """Hold these values [M, ...], generated now; forget what is on its way.

        Only where the mask [M] says so; everywhere, if there is none.
        """
        mask = torch.ones_like(self.since, dtype=torch.bool) if mask is None else mask
        self.began = torch.where(mask, self.clock, self.began)
        self.since = torch.where(mask, self.clock, self.since)
        for name, new in zip(self._tables[1], values, strict=True):
            setattr(self, name, torch.where(wide(mask, new), new, getattr(self, name)))

    def exchange(self, values: list[Tensor], sent: Tensor | None = None) -> Delivery:
        """Let a step pass: send these values [M, ...] and deliver what arrives.

        Args:
            values: to be sent.
            sent: which are really sent, [M]; all of them if not given.
        """
        if sent is None and self._compiled:  # one graph, whose guards do not see what is missing
            sent = torch.ones_like(self.since, dtype=torch.bool)
        post, delivery = self._advance(self._post(), values, sent)
        for name in _CHANGING:
            setattr(self, name, getattr(post, name))
        for name, held in zip(self._tables[1], post.held, strict=True):
            setattr(self, name, held)
        return delivery

    def _exchange(self, post: Post, values: list[Tensor], sent: Tensor | None) -> tuple[Post, Delivery]:
        """Pure but for the slots, which are written in place."""
        clock = post.clock + 1
        n_slots, n_senders = self.sampler.lost, len(post.since)
        delay, memory = self.sampler(post.streams, clock, post.memory)
        if sent is not None:
            delay = torch.where(sent, delay, self.sampler.lost)
        arrives = torch.where(delay < n_slots, (clock + delay) % n_slots, n_slots)
        row = arrives * n_senders + torch.arange(n_senders, device=arrives.device)
        post.stamps.view(-1).index_copy_(0, row, clock.expand(n_senders))
        for slots, value in zip(post.slots, values, strict=True):
            slots.flatten(0, 1).index_copy_(0, row, value)
        today = (clock % n_slots).view(1)
        stamp = post.stamps.index_select(0, today).squeeze(0)
        older = post.since if self._newest else torch.maximum(post.began, clock - n_slots)
        fresh = stamp > older
        since = torch.where(fresh, stamp, post.since)
        held = [
            torch.where(wide(fresh, old), slots.index_select(0, today).squeeze(0), old)
            for slots, old in zip(post.slots, post.held, strict=True)
        ]
        post = post._replace(clock=clock, memory=memory, since=since, held=held)
        return post, Delivery(held, clock - since, fresh, delay)

    def _post(self) -> Post:
        tables = ([getattr(self, name) for name in names] for names in self._tables)
        return Post._make([*(getattr(self, name) for name in _SINGLE), *tables])


_SINGLE = ("clock", "streams", "memory", "began", "since", "stamps")
_CHANGING = ("clock", "memory", "since")
