"""Messages in transit: sent in each step, delivered some steps later, held until a newer one arrives."""

from typing import NamedTuple

import torch
from torch import Tensor

from damian.common.tensors import expand_mask
from damian.delays.samplers import Sampler

Memory = dict[str, Tensor]
"""Everything that a delay line remembers, by name."""

ORDERS = ("generation", "arrival")
"""Which message a receiver holds: the one generated last, or the one that arrived last."""


class Delivery(NamedTuple):
    """What M receivers hold after a step."""

    held: list[Tensor]
    """The values of the held messages, [M, ...] each."""
    age: Tensor
    """Steps since the held message was generated, [M]."""
    fresh: Tensor
    """Did the held message arrive in this step, [M]."""
    delay: Tensor
    """Delay of the message sent in this step [steps], [M]; ``Sampler.lost`` if lost, or if none was sent."""


class DelayLine:
    """Delays rows of values by a law; each of M senders sends at most one message per step.

    A message is written at once into the slot of the step at which it will arrive, where a later message
    that arrives at the same step replaces it. Pure but for the slots, which are written in place. The memory:

    - ``clock``: steps so far, and ``slot``: the slot of this step, [M] each;
    - ``streams``: random stream of each sender, [M], and ``channel``: state of its channel, [M];
    - ``reset_at``: clock at its latest reset, [M], and ``generated_at``: clock at which the held message
      was generated, [M];
    - ``senders``: 0, 1, ..., M - 1;
    - ``stamps``: clock at which the message in a slot was generated, [K + 1, M]: K slots for the steps to
      come, and one for the messages that never arrive;
    - ``slots_i``: the values of the messages, [K + 1, M, ...], and ``held_i``: of the held ones, [M, ...].

    Args:
        sampler: of the delays.
        order: one of ``ORDERS``.
    """

    def __init__(self, sampler: Sampler, order: str) -> None:
        self.sampler = sampler
        self._newest_generated = order == "generation"

    def init_memory(self, values: list[Tensor], streams: Tensor) -> Memory:
        """The memory for messages of these values [M, ...] and senders of these random streams [M]."""
        n_slots, zero = self.sampler.lost + 1, torch.zeros_like(streams)
        memory = {
            "clock": zero,
            "slot": zero.clone(),
            "streams": streams,
            "channel": self.sampler.initial_state(streams),
            "reset_at": zero.clone(),
            "generated_at": zero.clone(),
            "senders": torch.arange(len(streams), device=streams.device),
            "stamps": zero.new_full((n_slots, len(streams)), -1),
        }
        for i, value in enumerate(values):
            memory[f"slots_{i}"] = value.new_zeros(n_slots, *value.shape)
            memory[f"held_{i}"] = value.clone()
        return memory

    def reset(self, memory: Memory, values: list[Tensor], mask: Tensor) -> tuple[Memory, Delivery]:
        """Where the mask [M] is true, hold these values [M, ...] and forget all messages in transit."""
        clock = memory["clock"]
        memory = memory | {n: torch.where(mask, clock, memory[n]) for n in ("reset_at", "generated_at")}
        for i, new in enumerate(values):
            memory[f"held_{i}"] = torch.where(expand_mask(mask, new), new, memory[f"held_{i}"])
        zero = torch.zeros_like(memory["generated_at"])
        return memory, Delivery(values, zero, zero == 0, zero)

    def step(self, memory: Memory, values: list[Tensor], sent: Tensor | None) -> tuple[Memory, Delivery]:
        """Send these values [M, ...], and deliver the messages that arrive in this step.

        Args:
            memory: before the step.
            values: of the messages.
            sent: which of them are sent, [M]; all of them if not given.
        """
        clock, generated_at = memory["clock"] + 1, memory["generated_at"]
        n_slots, n_senders = self.sampler.lost, len(generated_at)
        slot_now = advance_slot(memory["slot"], 1, n_slots)
        delay, channel = self.sampler(memory["streams"], clock, memory["channel"])
        if sent is not None:
            delay = torch.where(sent, delay, self.sampler.lost)
        arrival = torch.where(delay < n_slots, advance_slot(slot_now, delay, n_slots), n_slots)
        row, here = (slot * n_senders + memory["senders"] for slot in (arrival, slot_now))
        stamps = memory["stamps"].view(-1)
        stamp = stamps.index_copy_(0, row, clock).index_select(0, here)
        if self._newest_generated:
            oldest = generated_at
        else:  # every message of this episode, but not what the slot held one round ago
            oldest = torch.maximum(memory["reset_at"], clock - n_slots)
        fresh = stamp > oldest
        generated_at = torch.where(fresh, stamp, generated_at)
        memory = memory | {"clock": clock, "slot": slot_now, "channel": channel, "generated_at": generated_at}
        held = []
        for i, value in enumerate(values):
            slots, old = memory[f"slots_{i}"], memory[f"held_{i}"]
            new = slots.flatten(0, 1).index_copy_(0, row, value).index_select(0, here)
            held.append(torch.where(expand_mask(fresh, old), new, old))
            memory[f"held_{i}"] = held[i]
        return memory, Delivery(held, clock - generated_at, fresh, delay)


def advance_slot(slot: Tensor, steps: Tensor | int, n_slots: int) -> Tensor:
    """The slot some steps later, for fewer steps than slots; a modulo would cost a division per element."""
    later = slot + steps
    return torch.where(later < n_slots, later, later - n_slots)
