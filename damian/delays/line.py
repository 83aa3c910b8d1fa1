"""Delay lines: messages arrive some steps after they were sent, and are held until a newer one
arrives."""

from typing import NamedTuple

import torch
from torch import Tensor

from damian.common.tensors import where_rows
from damian.delays.samplers import MessageContext, Sampler

Memory = dict[str, Tensor]
"""State of a delay line, by name."""

ORDERS = ("generation", "arrival")
"""Which received message a receiver holds: the one generated last, or the one that arrived last."""


class Delivery(NamedTuple):
    """What M receivers hold after a step."""

    held: list[Tensor]
    """Values of the held messages, [M, ...] each."""
    age: Tensor
    """Age of the held message: steps since it was generated, [M]."""
    fresh: Tensor
    """Whether the held message arrived in this step, [M] bool."""
    delay: Tensor
    """Delay of the message sent in this step [steps], [M]; ``Sampler.lost`` if it is lost or none
    is sent."""


class DelayLine:
    """Delays the messages of M senders, each of which sends at most one message per step.

    A message is written at once into the slot of the step at which it will arrive, where a later
    message that arrives at the same step replaces it. The slots form a ring. Steps and resets are
    pure functions of the memory, except that a step writes the slots in place.

    A worked timeline. At the reset, t = 0, the receiver holds the first message m0. The messages
    m1, m2, m3 and m4 are sent at t = 1, 2, 3, 4, with delays of 3, 1, 0 and 2 steps:

    - t = 1: m1 is written into the slot of t = 4; the receiver holds m0, of age 1.
    - t = 2: m2 is written into the slot of t = 3; the receiver holds m0, of age 2.
    - t = 3: m3 replaces the older m2 in the slot of t = 3, and arrives at once: the receiver holds
      m3, of age 0.
    - t = 4: m1 arrives. By ``generation`` the receiver keeps the newer m3, now of age 1; by
      ``arrival`` it holds m1, of age 3. m4 is written into the slot of t = 6.

    The memory, [M] if nothing else is said: ``clock``, the number of steps so far; ``place`` of the
    current slot (slot times M, plus the sender's number); random ``streams``; the sampler's
    ``state``, [M, ...]; clock of the latest reset, ``reset_at``, and of the held message,
    ``generated_at``; ``stamps``, the clock of the message in each of K slots, and in one for
    messages that never arrive, [K + 1, M]; values in these, ``slots_i`` [K + 1, M, ...], and held,
    ``held_i`` [M, ...].
    """

    def __init__(self, sampler: Sampler, order: str) -> None:
        self.sampler = sampler
        self._hold_last_generated = order == "generation"
        self._always_longest = sampler.constant_delay == sampler.longest

    def init_memory(self, values: list[Tensor], streams: Tensor) -> Memory:
        """Create the memory for messages like ``values`` [M, ...] and senders with random
        ``streams`` [M]."""
        n_rows = self.sampler.lost + 1
        zero = torch.zeros_like(streams)
        memory = {
            "clock": zero,
            "place": torch.arange(len(streams), device=streams.device),
            "streams": streams,
            "state": self.sampler.initial_state(streams),
            "reset_at": zero.clone(),
            "generated_at": zero.clone(),
            "stamps": zero.new_full((n_rows, len(streams)), -1),
        }
        for i, value in enumerate(values):
            memory[f"slots_{i}"] = value.new_zeros(n_rows, *value.shape)
            memory[f"held_{i}"] = value.clone()
        return memory

    def reset(self, memory: Memory, values: list[Tensor], mask: Tensor) -> tuple[Memory, Delivery]:
        """Where the mask [M] is true, hold ``values`` [M, ...] and discard all messages in
        transit."""
        clock = memory["clock"]
        # What is in transit stays in its slots, and is no longer newer than what is held.
        memory = memory | {
            n: torch.where(mask, clock, memory[n]) for n in ("reset_at", "generated_at")
        }
        memory["state"] = self.sampler.begin_episode(memory["state"], mask)
        for i, new in enumerate(values):
            memory[f"held_{i}"] = where_rows(mask, new, memory[f"held_{i}"])
        zero = torch.zeros_like(memory["generated_at"])
        return memory, Delivery(values, zero, zero == 0, zero)

    def step(
        self,
        memory: Memory,
        values: list[Tensor],
        sent: Tensor | None,
        context: MessageContext | None = None,
    ) -> tuple[Memory, Delivery]:
        """Send ``values`` [M, ...] of the senders ``sent`` [M] (None: all), and deliver what
        arrives now."""
        clock = memory["clock"] + 1
        generated_at = memory["generated_at"]
        n_slots = self.sampler.lost
        n_senders = len(generated_at)
        n_places = n_slots * n_senders
        row_now = (memory["place"] + n_senders) % n_places
        delay, state = self.sampler(memory["streams"], clock, memory["state"], context)
        row_sent = memory[
            "place"
        ]  # K - 1 steps ahead in a ring of K slots is the slot of the step before
        if not self._always_longest:
            row_sent = (row_now + delay * n_senders) % n_places
        if sent is not None:
            delay = torch.where(sent, delay, self.sampler.lost)
        if sent is not None or not self._always_longest:
            row_sent = torch.where(delay < n_slots, row_sent, n_places + row_now % n_senders)
        stamps = memory["stamps"].view(-1)
        stamp = stamps.index_copy_(0, row_sent, clock).index_select(0, row_now)
        if self._hold_last_generated:
            generated_after = generated_at
        else:  # any message sent since the reset, but none that the previous turn of the ring left behind
            generated_after = torch.maximum(memory["reset_at"], clock - n_slots)
        fresh = stamp > generated_after
        generated_at = torch.where(fresh, stamp, generated_at)
        memory = memory | {
            "clock": clock,
            "place": row_now,
            "state": state,
            "generated_at": generated_at,
        }
        held = []
        for i, value in enumerate(values):
            flat = memory[f"slots_{i}"].flatten(0, 1)
            old = memory[f"held_{i}"]
            flat.index_copy_(0, row_sent, value)
            held.append(where_rows(fresh, flat.index_select(0, row_now), old))
            memory[f"held_{i}"] = held[i]
        return memory, Delivery(held, clock - generated_at, fresh, delay)
