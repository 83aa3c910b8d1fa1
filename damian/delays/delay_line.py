"""Messages on their way: sent in each step, delivered some steps later, held until a newer one comes."""

from typing import NamedTuple

import torch
from torch import Tensor

from damian.delays.samplers import Sampler
from damian.transforms.base import Memory, wide


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


class Mailbox:
    """Delays rows of values by a law; each of M senders sends at most one message per step.

    A message is written at once into the slot of the step at which it will arrive, where a later one that
    arrives at the same time replaces it. Pure but for the slots, which are written in place. It remembers

    - ``clock``: steps so far, and ``today``: the slot of this step, [M] each;
    - ``streams``: random stream of each sender, [M], and ``channel``: state of its channel, [M];
    - ``began``: clock at its latest reset, [M], and ``since``: when what is held was generated, [M];
    - ``senders``: 0, 1, ..., M - 1;
    - ``stamps``: when the message in a slot was generated, [K + 1, M]: K slots for the steps to come, and
      one for the messages that never arrive;
    - ``slots_i``: the values of the messages, [K + 1, M, ...], and ``held_i``: of those held, [M, ...].

    Args:
        sampler: the delays.
        order: hold the message that was generated last (``generation``) or that came last (``arrival``).
    """

    def __init__(self, sampler: Sampler, order: str) -> None:
        self.sampler = sampler
        self._newest = order == "generation"

    def allocate(self, values: list[Tensor], streams: Tensor) -> Memory:
        """The memory for messages of these values [M, ...] and senders of these random streams [M]."""
        n_slots, zero = self.sampler.lost + 1, torch.zeros_like(streams)
        memory = {
            "clock": zero,
            "today": zero.clone(),
            "streams": streams,
            "channel": self.sampler.begin(streams),
            "began": zero.clone(),
            "since": zero.clone(),
            "senders": torch.arange(len(streams), device=streams.device),
            "stamps": zero.new_full((n_slots, len(streams)), -1),
        }
        for i, value in enumerate(values):
            memory[f"slots_{i}"] = value.new_zeros(n_slots, *value.shape)
            memory[f"held_{i}"] = value.clone()
        return memory

    def begin(self, memory: Memory, values: list[Tensor], mask: Tensor) -> tuple[Memory, Delivery]:
        """Where the mask [M] says so, hold these values [M, ...] from now on; forget what is on its way."""
        clock = memory["clock"]
        memory = memory | {name: torch.where(mask, clock, memory[name]) for name in ("began", "since")}
        for i, new in enumerate(values):
            memory[f"held_{i}"] = torch.where(wide(mask, new), new, memory[f"held_{i}"])
        zero = torch.zeros_like(memory["since"])
        return memory, Delivery(values, zero, zero == 0, zero)

    def exchange(self, memory: Memory, values: list[Tensor], sent: Tensor | None) -> tuple[Memory, Delivery]:
        """Let a step pass: send these values [M, ...], deliver what arrives.

        Args:
            memory: before it.
            values: to be sent.
            sent: which are really sent, [M]; all of them if not given.
        """
        clock, since = memory["clock"] + 1, memory["since"]
        n_slots, n_senders = self.sampler.lost, len(since)
        today = after(memory["today"], 1, n_slots)
        delay, channel = self.sampler(memory["streams"], clock, memory["channel"])
        if sent is not None:
            delay = torch.where(sent, delay, self.sampler.lost)
        arrives = torch.where(delay < n_slots, after(today, delay, n_slots), n_slots)
        row, here = (slot * n_senders + memory["senders"] for slot in (arrives, today))
        stamps = memory["stamps"].view(-1)
        stamp = stamps.index_copy_(0, row, clock).index_select(0, here)
        older = since if self._newest else torch.maximum(memory["began"], clock - n_slots)
        fresh = stamp > older
        since = torch.where(fresh, stamp, since)
        memory = memory | {"clock": clock, "today": today, "channel": channel, "since": since}
        held = []
        for i, value in enumerate(values):
            slots, old = memory[f"slots_{i}"], memory[f"held_{i}"]
            new = slots.flatten(0, 1).index_copy_(0, row, value).index_select(0, here)
            held.append(torch.where(wide(fresh, old), new, old))
            memory[f"held_{i}"] = held[i]
        return memory, Delivery(held, clock - since, fresh, delay)


def after(slot: Tensor, steps: Tensor | int, n_slots: int) -> Tensor:
    """The slot some steps (fewer than there are slots) later; a division for each element would cost more."""
    later = slot + steps
    return torch.where(later < n_slots, later, later - n_slots)
