"""A transform through which agents send messages to each other, which arrive late or are lost."""

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from damian.common import checks, counter_rng
from damian.common.tensors import where_rows
from damian.delays.laws import link_sampler
from damian.delays.line import DelayLine
from damian.delays.samplers import MessageContext
from damian.keys import STEPPED
from damian.transforms.base import Change, Memory, StatefulTransform
from damian.transforms.entries import (
    Entries,
    add_spec,
    existing,
    select_entries,
    sibling_key,
    spec_rows,
)


class Channel(StatefulTransform):
    """Lets the agents of a group send messages to each other, which arrive some steps later or are
    lost.

    In each step an agent sends an entry of its own (``in_key``). Each receiver holds, of each
    sender, the message that was generated last of those that have arrived, and observes it and its
    age. An agent knows its own message at once, and everyone knows everyone's first message of an
    episode, whatever the delay and the links. No gradient flows through the channel.

    A ``DelayLine`` delays what its sender sends on each of the M links, which are numbered by
    world, receiver and sender.

    A worked timeline, with a delay of 3 steps: messages of t = 1 arrive at t = 4. Until t = 3 an
    agent holds those of the reset, t = 0, of the others.

    Args:
        delay, dt, seed: as in ``ObservationDelay``, but drawn for each receiver and message; or an
            N x N nested list of delays, ``delay[receiver][sender]``, whose diagonal is not used.
            With a ``position_key``, a law may read ``position`` and ``receiver_position``.
        in_key: key of the entry [*B, N, ...] of a group of agents that every agent sends. A bare
            name for another key means an entry beside it.
        out_key: key under which the received entries are written, [*B, N, N, ...]
            (receiver, sender).
        loss: probability that a message does not reach a receiver, or an N x N nested list of it, 1
            where a receiver never hears a sender.
        comm_range: an agent hears only agents within this distance [m] when they send.
        position_key: key of an entry [*B, N, ...] whose first two numbers are the agent's position
            [m].
        sent_key: key of a flag [*B, N] bool: does the agent send in this step.
        age_key: key for the age of the held messages [steps], [*B, N, N] float; or None.
        delay_key: key for the delays of the messages sent in this step [steps], [*B, N, N] long
            (receiver, sender), -1 if they never arrive; or None. An actor must not observe it.

    Examples:
        >>> env = VmasEnv("navigation", num_envs=32, n_agents=3)
        >>> env = TransformedEnv(env, Channel(Uniform(1, 5), loss=0.1))
        >>> env.rollout(100)["agents", "received"]  # [32, 100, 3, 3, 18]
    """

    def __init__(
        self,
        delay: Any,
        in_key: NestedKey = ("agents", "observation"),
        out_key: NestedKey = "received",
        *,
        loss: Any = 0.0,
        comm_range: float | None = None,
        position_key: NestedKey | None = None,
        sent_key: NestedKey | None = None,
        dt: float = 1.0,
        age_key: NestedKey | None = "received_age",
        delay_key: NestedKey | None = None,
        seed: int | None = None,
    ) -> None:
        placed = position_key is not None
        known_places = comm_range is None or placed
        checks.require(known_places, "comm_range", comm_range, "needs a position_key")
        super().__init__(in_key, seed=seed)
        sent = self.in_keys[0]
        should = "is not in a group of agents, as ('agents', 'observation') is"
        checks.require(isinstance(sent, tuple), "in_key", sent, should)
        written = [sibling_key(sent, key) for key in (out_key, age_key, delay_key)]
        _, self.age_key, self.delay_key = written
        self.out_keys = existing(written)
        self.sent_key = sibling_key(sent, sent_key)
        self.position_key = sibling_key(sent, position_key)
        self.dt = dt
        self.comm_range = comm_range
        self.sampler = link_sampler(delay, loss, dt)
        self.n_agents = getattr(self.sampler, "n_agents", None)
        """The number of agents for which links are given one by one, if any are."""
        for name in self.sampler.reads:
            given = placed and name in ("position", "receiver_position")
            checks.require(given, "delay", f"a law that reads {name}", "needs a position_key")
        self.line = DelayLine(self.sampler, "generation")
        self.step_keys = existing([*self.in_keys, self.position_key, self.sent_key])

    def find_rows(self, tensordict: TensorDictBase) -> torch.Size:
        """The shape of the rows: there is one for each link (receiver, sender), [*B, N, N]."""
        agents = super().find_rows(tensordict)
        n = agents[-1]
        checks.require(
            self.n_agents in (None, n),
            "Channel",
            "the links",
            f"are given for {self.n_agents} agents, but {self.row_key} is of {n}",
        )
        return torch.Size((*agents, n))

    @property
    def agents(self) -> torch.Size:
        """The shape of the agents, [*B, N]."""
        return self.rows[:-1]

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        content = self._by_sender(select_entries(tensordict, self.in_keys)[self.in_keys[0]])
        streams = self.streams(tensordict.batch_size, content.device, self.sampler)
        memory = self.line.init_memory([content], streams)
        own = torch.eye(self.agents[-1], dtype=torch.bool, device=content.device)
        memory["is_own"] = own.expand(self.rows).flatten()
        memory["delay"] = torch.zeros_like(streams)
        return memory

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        content = self._by_sender(entries[self.in_keys[0]])
        begun, _ = self.line.reset(memory, [], mask)
        after = self._send(begun, content, entries, mask)
        known = {
            "held_0": content,
            "generated_at": after["clock"],
            "delay": torch.zeros_like(after["delay"]),
        }
        memory = dict(memory)
        for name, new in (after | known).items():
            old = begun[name]
            changed = new is not old
            memory[name] = where_rows(mask, new, old) if changed else new
        return memory, self._outputs(memory, content)

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        content = self._by_sender(entries[self.in_keys[0]])
        active = torch.ones_like(memory["is_own"])
        if STEPPED in entries:
            active = self.expand_worlds(entries[STEPPED].reshape(-1))
        memory = self._send(memory, content, entries, active)
        return memory, self._outputs(memory, content)

    def _by_sender(self, value: Tensor) -> Tensor:
        """Copy the entry of each sender [*B, N, ...] to all of its links, [M, ...]."""
        at_receivers = value.unsqueeze(len(self.agents) - 1)
        return self.to_rows(at_receivers.expand(*self.rows, *value.shape[len(self.agents) :]))

    def _by_receiver(self, value: Tensor) -> Tensor:
        """Copy the entry of each receiver [*B, N, ...] to all of its links, [M, ...]."""
        at_senders = value.unsqueeze(len(self.agents))
        return self.to_rows(at_senders.expand(*self.rows, *value.shape[len(self.agents) :]))

    def _send(self, memory: Memory, content: Tensor, entries: Entries, active: Tensor) -> Memory:
        """Send the content [M, ...] over the active links [M], and deliver what arrives in this
        step."""
        sent = active & ~memory["is_own"]
        if self.sent_key is not None:
            wants = entries[self.sent_key].reshape(self.agents)
            sent = sent & self._by_sender(wants)
        places = {}
        if self.position_key is not None:
            position = entries[self.position_key][..., :2]
            places["position"] = self._by_sender(position)
            places["receiver_position"] = self._by_receiver(position)
        if self.comm_range is not None:
            way = places["position"] - places["receiver_position"]
            sent = sent & (torch.linalg.vector_norm(way, dim=-1) <= self.comm_range)
        context = self._context(memory, sent, places) if self.sampler.sees_context else None
        memory, delivery = self.line.step(memory, [content], sent, context)
        return memory | {"delay": delivery.delay}

    def _context(self, memory: Memory, sent: Tensor, places: dict[str, Tensor]) -> MessageContext:
        """What laws may read of the messages that are ``sent`` over the links [M]."""
        n = self.agents[-1]
        numbers = torch.arange(n, device=sent.device).expand(self.agents)
        sender = self._by_sender(numbers)
        receiver = self._by_receiver(numbers)
        is_sending = sent.view(-1, n, n).any(1)
        n_sending = is_sending.sum(-1).repeat_interleave(n * n)
        steps = memory["clock"] - memory["reset_at"]
        time = steps * self.dt
        uniform = counter_rng.uniform(memory["streams"], memory["clock"] + 1)
        return MessageContext(sender, receiver, n_sending, time, uniform, self.dt, places)

    def _outputs(self, memory: Memory, content: Tensor) -> Entries:
        """The messages that agents hold, with ages and delays; an agent's own arrives at once."""
        is_own = memory["is_own"]
        held = where_rows(is_own, content, memory["held_0"])
        written: Entries = {self.out_keys[0]: self.from_rows(held)}
        if self.age_key is not None:
            age = memory["clock"] - memory["generated_at"]
            age = age.masked_fill(is_own, 0)
            written[self.age_key] = self.from_rows(age.to(torch.float32))
        if self.delay_key is not None:
            delay = memory["delay"].masked_fill(is_own, 0)
            delay = torch.where(delay < self.sampler.lost, delay, -1)
            written[self.delay_key] = self.from_rows(delay)
        return written

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        agents = spec_rows(observation_spec, self.row_key)
        pairs = (*agents, agents[-1])
        sent = observation_spec[self.in_keys[0]]
        size = sent.shape[len(agents) :]
        add_spec(observation_spec, self.out_keys[0], (*pairs, *size), sent.dtype)
        add_spec(observation_spec, self.age_key, pairs)
        add_spec(observation_spec, self.delay_key, pairs, torch.long)
        return observation_spec
