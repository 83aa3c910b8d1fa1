"""A transform through which agents send messages to each other, which arrive late or are lost."""

from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from damian.common import checks, counter_rng
from damian.common.tensors import expand_mask, where_rows
from damian.delays.laws import link_sampler
from damian.delays.line import DelayLine, slot_rows
from damian.delays.samplers import MessageContext
from damian.keys import STEPPED
from damian.transforms.base import Change, Memory, StatefulTransform
from damian.transforms.entries import (
    Entries,
    add_spec,
    as_rows,
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

    A ``DelayLine`` delays only the time at which a message was generated, on every link [M]; the
    latest K messages of each of the S senders lie in a ring (``contents`` [K, S, ...]), and what is
    held in ``held`` [M, ...]. The memory also has the ``sender`` of each link, and a ``link`` of
    each sender.

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
        self._n_slots = self.sampler.longest + 1
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

    # The time of a message is counted in steps since the reset, whose own messages have time 1.

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        content = self._content(select_entries(tensordict, self.in_keys))
        n = self.agents[-1]
        streams = self.streams(tensordict.batch_size, content.device, self.sampler)
        links = torch.arange(len(streams), device=streams.device)
        receiver = links // n
        sender = links % n
        first_of_world = receiver // n * n
        of_last_receiver = links.view(-1, n, n)[:, -1]
        memory = self.line.init_memory([], streams)
        memory["sender"] = first_of_world + sender
        memory["hears"] = receiver % n != sender
        memory["link"] = of_last_receiver.flatten()
        memory["contents"] = content.new_zeros(self._n_slots, *content.shape)
        memory["held"] = content.new_zeros(len(links), *content.shape[1:])
        if self.delay_key:
            memory["delay"] = torch.zeros_like(streams)
        return memory

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        self._put(memory, entries)
        begun, _ = self.line.reset(memory, [], mask)
        after = self._send(begun, entries, self._wanted(entries, mask))
        after["generated_at"] = torch.where(mask, after["clock"], after["generated_at"])
        after = self._hold(after, mask)
        if self.delay_key:
            after["delay"] = torch.zeros_like(after["delay"])
        memory = dict(memory)
        for name, new in after.items():
            old = begun[name]
            changed = new is not old
            memory[name] = where_rows(mask, new, old) if changed else new
        return memory, self._outputs(memory)

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        self._put(memory, entries)
        active = torch.ones_like(memory["hears"])
        if STEPPED in entries:
            active = self.expand_worlds(entries[STEPPED].reshape(-1))
        memory = memory | self._send(memory, entries, self._wanted(entries, active))
        return memory, self._outputs(memory)

    def _content(self, entries: Entries) -> Tensor:
        """What the agents send in a step, [B * N, ...]."""
        return as_rows(entries[self.in_keys[0]], self.agents)

    def _put(self, memory: Memory, entries: Entries) -> None:
        """Write what the senders send in the next step; the step may send it or not."""
        following = memory["clock"][memory["link"]] + 1
        rows = slot_rows(following % self._n_slots)
        memory["contents"].flatten(0, 1).index_copy_(0, rows, self._content(entries))

    def _hold(self, memory: Memory, mask: Tensor) -> Memory:
        """Where the mask [M] is true, hold the messages that were generated at ``generated_at``."""
        slot = memory["generated_at"] % self._n_slots
        old = memory["held"]
        rows = slot * len(memory["link"]) + memory["sender"]
        new = memory["contents"].flatten(0, 1).index_select(0, rows)
        return memory | {"held": where_rows(mask, new, old)}

    def _wanted(self, entries: Entries, active: Tensor) -> Tensor:
        """Links among the active ones [M] on which an agent wants to send, [M] bool."""
        if self.sent_key is None:
            return active
        n = self.agents[-1]
        wants = entries[self.sent_key].reshape(-1, 1, n)
        return active & wants.expand(-1, n, n).reshape(-1)

    def _send(self, memory: Memory, entries: Entries, wanted: Tensor) -> Memory:
        """Send what was written last over the wanted links [M], and deliver what arrives in this
        step."""
        n = self.agents[-1]
        position = None
        if self.position_key:
            position = as_rows(entries[self.position_key], self.agents)[:, :2]
        sent = wanted & memory["hears"]
        if self.comm_range is not None:
            place = cast(Tensor, position).view(-1, n, 2)
            way = place.unsqueeze(1) - place.unsqueeze(2)
            is_near = torch.linalg.vector_norm(way, dim=-1) <= self.comm_range
            sent = sent & is_near.view(-1)
        context = self._context(memory, sent, position) if self.sampler.sees_context else None
        memory, delivery = self.line.step(memory, [], sent, context)
        memory = self._hold(memory, delivery.fresh)
        if self.delay_key:
            memory["delay"] = delivery.delay
        return memory

    def _context(self, memory: Memory, sent: Tensor, position: Tensor | None) -> MessageContext:
        """The circumstances of what is ``sent`` over the links [M]; positions are [B * N, 2]."""
        n = self.agents[-1]
        sender = memory["sender"]
        receiver = torch.arange(len(sender), device=sender.device) // n
        read = {}
        if position is not None:
            read["position"] = position.index_select(0, sender)
            read["receiver_position"] = position.index_select(0, receiver)
        is_sending = sent.view(-1, n, n).any(1)
        n_sending = is_sending.sum(-1).repeat_interleave(n * n)
        steps = memory["clock"] - memory["reset_at"]
        time = steps * self.dt
        uniform = counter_rng.uniform(memory["streams"], memory["clock"] + 1)
        return MessageContext(sender % n, receiver % n, n_sending, time, uniform, self.dt, read)

    def _outputs(self, memory: Memory) -> Entries:
        """What the agents hold, with ages and delays; each agent holds its own message at once."""
        n = self.agents[-1]
        shape = self.rows
        start = memory["reset_at"]
        time = (memory["generated_at"] - start).view(-1, n)
        now = (memory["clock"] - start).view(-1, n)
        agents = torch.arange(len(now), device=now.device)
        senders = torch.arange(n, device=now.device)
        is_own = (agents % n).unsqueeze(-1) == senders
        time = torch.where(is_own, now, time)
        newest = slot_rows(memory["clock"][memory["link"]] % self._n_slots)
        own = memory["contents"].flatten(0, 1).index_select(0, newest)
        held = memory["held"].unflatten(0, (-1, n))
        value = torch.where(expand_mask(is_own, held), own.unsqueeze(1), held)
        entries = {self.out_keys[0]: value.view(*shape, *value.shape[2:])}
        if self.age_key is not None:
            entries[self.age_key] = (now - time).to(torch.float32).view(shape)
        if self.delay_key is not None:
            delay = memory["delay"].view(-1, n).masked_fill(is_own, 0)
            delay = torch.where(delay < self.sampler.lost, delay, -1)
            entries[self.delay_key] = delay.view(shape)
        return entries

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        agents = spec_rows(observation_spec, self.row_key)
        pairs = (*agents, agents[-1])
        sent = observation_spec[self.in_keys[0]]
        size = sent.shape[len(agents) :]
        add_spec(observation_spec, self.out_keys[0], (*pairs, *size), sent.dtype)
        add_spec(observation_spec, self.age_key, pairs)
        add_spec(observation_spec, self.delay_key, pairs, torch.long)
        return observation_spec
