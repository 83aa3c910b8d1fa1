"""A transform through which agents send messages to each other, which arrive late or are lost."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from damian.common import checks, counter_rng
from damian.common.tensors import expand_mask
from damian.common.text_files import listed
from damian.delays.laws import is_matrix, link_sampler, same_size
from damian.delays.line import BroadcastLine
from damian.delays.samplers import MessageContext, Sampler, streams_for
from damian.keys import STEPPED
from damian.transforms.base import (
    Change,
    Entries,
    Memory,
    StatefulTransform,
    as_rows,
    existing,
    read_keys,
    require_keys,
    require_new,
    row_shape,
    select_entries,
    sibling_key,
    spec_rows,
)

_SERVER_STREAM, _TURN_DRAW = 1, 4
"""Counters that keep the server's random streams, and the draws of who may send, apart from the delays'."""


class Channel(StatefulTransform):
    """Lets the agents of a group send messages to each other, which arrive some steps later or are lost.

    In each step an agent sends entries of its own (``in_keys``), or what its policy chooses (``action_key``).
    Each receiver holds, of each sender, the message that was generated last of those that have arrived, and
    observes it, its age, and whether any has arrived in this episode. An agent knows its own message at once.
    The outputs of a reset are sent like those of a step; a chosen message exists from the first step on, in
    whose outputs it arrives with delay 0. With delay 0 everyone sees everyone's current message. No gradient
    flows through the channel.

    What an agent sends is stored once for all receivers. With a longest delay of K steps, N agents and
    contents of F float32 numbers, a world takes 4 (K + 1) N F bytes for what is in transit, 4 N^2 F for what
    is held, and about 8 (K + 10) N^2 for times and states of the links: 31 kB with K = 10, N = 10, F = 18. It
    would take 109 kB if each link stored what is in transit on it.

    Args:
        delay: steps (``3``), a time (``"3s"``), or a law of ``damian.delays.laws`` (``Uniform(3, 7)``); or an
            N x N nested list of them, ``delay[receiver][sender]``, whose diagonal is not used. A delay is
            drawn for each receiver and message. With a ``position_key``, a law may read ``position`` and
            ``receiver_position``; with a server, ``position`` is that of the agent that sends or receives.
        in_keys: keys of the entries [*B, N, ...] of a group of agents that every agent sends together; if
            neither this nor ``action_key`` is given, ``("agents", "observation")``.
        out_keys: keys under which the received entries are written, [*B, N, N, ...] (receiver, sender); if
            not given, ``received``, and with several in_keys ``received_`` and the name of each.
        loss: probability that a message does not reach a receiver, or an N x N nested list of it.
        topology: ``all``: agents send to all others. ``server``: agents send to a server by ``delay`` and
            ``loss``; in each step the server broadcasts the newest message that it holds of each agent, and
            each receiver gets this broadcast by ``down_delay`` and ``down_loss``. A nested list or tensor
            [N, N] of bool: which sender each receiver hears.
        down_delay: delay from the server to an agent; 0 if not given.
        down_loss: probability that a broadcast of the server does not reach an agent.
        comm_range: an agent hears only agents within this distance [m] when they send.
        position_key: key of an entry [*B, N, ...] whose first two numbers are the agent's position [m].
        limit: so many agents of a world may send in a step, as on a shared medium; a random draw decides
            among those that want to. A server's broadcasts do not count.
        sent_key: key of a flag [*B, N] bool: does the agent send in this step.
        request_key: key of a flag, [*B, N, N] (receiver, sender) or [*B, N] (receiver, for all senders) bool:
            only what is asked for is sent.
        action_key: key of an action [*B, N, message_size] in [-1, 1] that the transform adds to the action
            spec, and sends.
        message_size: how many numbers ``action_key`` has.
        known_at_reset: everyone knows everyone's first message, whatever the delay and the topology.
        dt: length of a step [s], for delays given as times.
        age_key: key for the age of the held messages, in steps, [*B, N, N] float; before one has arrived,
            steps since the reset; None to leave it out.
        mask_key: key for a flag, [*B, N, N] bool: has a message of this episode arrived; None to leave it
            out.
        seed: seed of all draws until the environment is seeded; if there is none, it is drawn from torch's
            global generator at the first reset.

    A bare name for one of the keys means an entry in the same TensorDict as ``in_keys[0]`` or ``action_key``.
    The flags ``sent_key`` and ``request_key`` are read from the outputs of a reset and of each step. If a
    reset has no such entry, the policy must write it before each step, and nothing is sent at the reset.

    Raises:
        InputError: an argument is invalid, or does not go with another one.

    Examples:
        >>> env = VmasEnv("navigation", num_envs=32, n_agents=3)
        >>> env = TransformedEnv(env, Channel(Uniform(1, 5), loss=0.1))
        >>> env.rollout(100)["agents", "received"]  # [32, 100, 3, 3, 18]
    """

    omittable_outputs = ("age_key", "mask_key")

    def __init__(
        self,
        delay: Any,
        in_keys: NestedKey | Sequence[NestedKey] | None = None,
        out_keys: NestedKey | Sequence[NestedKey] | None = None,
        *,
        loss: Any = 0.0,
        topology: Any = "all",
        down_delay: Any = None,
        down_loss: float | None = None,
        comm_range: float | None = None,
        position_key: NestedKey | None = None,
        limit: int | None = None,
        sent_key: NestedKey | None = None,
        request_key: NestedKey | None = None,
        action_key: NestedKey | None = None,
        message_size: int | None = None,
        known_at_reset: bool = False,
        dt: float = 1.0,
        age_key: NestedKey | None = "received_age",
        mask_key: NestedKey | None = "received_mask",
        seed: int | None = None,
    ) -> None:
        if action_key is None:
            checks.require(message_size is None, "message_size", message_size, "needs an action_key")
        else:
            checks.whole("message_size", message_size, 1, unit="numbers")
            should = "does not go with in_keys: agents send these or an action; use two Channels for both"
            checks.require(in_keys is None, "action_key", action_key, should)
            should = "does not go with action_key: at a reset no message has been chosen yet"
            checks.require(not known_at_reset, "known_at_reset", known_at_reset, should)
        sent, written, beside = _keys_of(in_keys, out_keys, action_key)
        super().__init__(sent, written, seed=seed)
        self.action_key = None if action_key is None else beside
        self.message_size, self._beside = message_size, beside
        self.age_key, self.mask_key, self.sent_key, self.request_key, self.position_key = (
            sibling_key(beside, key) for key in (age_key, mask_key, sent_key, request_key, position_key)
        )
        if limit is not None:
            checks.whole("limit", limit, 1, unit="agents")
        self.n_agents = same_size({"delay": delay, "loss": loss, "topology": topology})
        """The number of agents for which links are given one by one, if any are."""
        limits = SendLimits(dt, limit, known_at_reset, sends_at_reset=action_key is None)
        self.topology = make_topology(
            topology, delay, loss, down_delay, down_loss, comm_range, limits, position_key is not None
        )
        should = "does not go with topology='server': requests go to agents"
        to_agents = isinstance(self.topology, DirectLinks)
        checks.require(request_key is None or to_agents, "request_key", request_key, should)
        self.draws = self.topology.draws
        self.flag_keys = existing([self.sent_key, self.request_key])
        self.action_keys = existing([self.action_key, *self.flag_keys])
        self.step_keys = [*self.required_keys, *self.flag_keys]

    @property
    def memory_sizes(self) -> dict[str, int]:
        return {"longest": self.topology.longest, "in_keys": len(self.in_keys)}

    @property
    def row_key(self) -> NestedKey:
        return self._beside

    @property
    def required_keys(self) -> Sequence[NestedKey]:
        return existing([*self.in_keys, self.position_key])

    def find_rows(self, tensordict: TensorDictBase) -> torch.Size:
        agents = row_shape(tensordict, self.row_key)
        self._check_agents(agents, len(tensordict.batch_size))
        return self.topology.rows(agents)

    def _check_agents(self, agents: torch.Size, n_batch: int) -> None:
        """Require that the entries are those of a group of agents, [*B, N]."""
        name = "action_key" if self.action_key else "in_keys"
        checks.require(len(agents) == n_batch + 1, name, self._beside, _NO_GROUP)
        n, given = agents[-1], self.n_agents
        should = f"are given for {given} agents, but {self._beside} is of {n}"
        checks.require(given in (None, n), "Channel", "the links", should)

    @property
    def agents(self) -> torch.Size:
        """The shape of the agents, [*B, N]."""
        return self.rows[:-1] if isinstance(self.topology, DirectLinks) else self.rows

    # The memory is that of the topology; ``flag_i`` [M] holds what the policy wrote under ``flag_keys[i]``.

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        entries = select_entries(tensordict, self.step_keys)
        contents = self._contents(entries, next(iter(tensordict.values(True, True))).device)
        streams = self.streams(tensordict.batch_size, contents[0].device)
        memory = self.topology.init_memory(contents, streams, self.agents[-1])
        absent = [i for i, key in enumerate(self.flag_keys) if key not in entries]
        return memory | {f"flag_{i}": torch.zeros_like(streams, dtype=torch.bool) for i in absent}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        self.topology.write(memory, self._contents(entries, mask.device))
        silent = {name: torch.zeros_like(memory[name]) for name in memory if name.startswith("flag_")}
        wanted = mask & self._wanted(memory | silent, entries, mask)
        senders = Senders(mask, wanted & (self.action_key is None), self._position(entries))
        memory = memory | self.topology.reset(memory, senders)
        return memory, self._outputs(memory)

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        if self.action_key:
            self.topology.write(memory, [as_rows(entries[self.action_key], self.agents)])
        written = {}
        for i, key in enumerate(self.flag_keys):
            if f"flag_{i}" in memory:
                written[f"flag_{i}"] = self._flag_rows(key, entries[key])
        return memory | written, {}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        if not self.action_key:
            self.topology.write(memory, [as_rows(entries[key], self.agents) for key in self.in_keys])
        device = next(iter(memory.values())).device
        active = torch.ones(self.rows.numel(), dtype=torch.bool, device=device)
        if STEPPED in entries:
            active = self.expand_worlds(entries[STEPPED].reshape(-1))
        senders = Senders(active, self._wanted(memory, entries, active), self._position(entries))
        memory = memory | self.topology.step(memory, senders)
        return memory, self._outputs(memory)

    def _contents(self, entries: Entries, device: torch.device) -> list[Tensor]:
        """What the agents send at a reset, [B * N, ...] each; zeros for an action that is not chosen yet."""
        if self.message_size:
            return [torch.zeros(self.agents.numel(), self.message_size, device=device)]
        return [as_rows(entries[key], self.agents) for key in self.in_keys]

    def _position(self, entries: Entries) -> Tensor | None:
        """Positions of the agents [m], [B * N, 2]."""
        return as_rows(entries[self.position_key], self.agents)[:, :2] if self.position_key else None

    def _wanted(self, memory: Memory, entries: Entries, active: Tensor) -> Tensor:
        """Rows among the active ones [M] on which an agent wants to send, [M] bool."""
        for i, key in enumerate(self.flag_keys):
            written = memory.get(f"flag_{i}")
            active = active & (self._flag_rows(key, entries[key]) if written is None else written)
        return active

    def _flag_rows(self, key: NestedKey, flag: Tensor) -> Tensor:
        """A flag of agents, or of receivers and senders, as rows, [M] bool."""
        n = self.agents[-1]
        if flag.numel() == self.rows.numel():
            return flag.reshape(-1)
        by_link = flag.reshape(-1, n, 1) if key == self.request_key else flag.reshape(-1, 1, n)
        return by_link.expand(-1, n, n).reshape(-1)

    def _outputs(self, memory: Memory) -> Entries:
        received, shape = self.topology.received(memory), (*self.agents, self.agents[-1])
        flags = {self.age_key: received.age.to(torch.float32), self.mask_key: received.arrived}
        values = [*received.contents, *(value for key, value in flags.items() if key is not None)]
        return {
            key: value.view(*shape, *value.shape[2:])
            for key, value in zip(self.created_keys, values, strict=True)
        }

    # The chosen message is an action for the policy, but none for the environment.

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = super()._inv_call(tensordict)
        return tensordict.exclude(self.action_key) if self.action_key else tensordict

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        input_spec = super().transform_input_spec(input_spec)
        if self.action_key and self.message_size:
            specs = cast(Composite, input_spec)["full_action_spec"]
            known = list(specs.keys(True, True))
            beside = [sibling_key(key, self.action_key[-1]) for key in known]
            should = f"is not a new name beside one of the actions {listed(map(str, known))}"
            good = self.action_key in beside and self.action_key not in known
            checks.require(good, "action_key", self.action_key, should)
            shape = torch.Size((*spec_rows(specs, self.action_key), self.message_size))
            specs[self.action_key] = Bounded(-1.0, 1.0, shape, device=specs.device)
        return input_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        require_keys("Channel", self.required_keys, observation_spec)
        agents, device = spec_rows(observation_spec, self._beside), observation_spec.device
        self._check_agents(agents, len(observation_spec.shape))
        if self.action_key:
            require_new("Channel", self.action_key, observation_spec.keys(True))
        sent = [observation_spec[key] for key in self.in_keys]
        kinds = [(spec.shape[len(agents) :], spec.dtype) for spec in sent]
        kinds += [((self.message_size,), torch.float32)] if self.message_size else []
        kinds += [((), torch.float32)] if self.age_key else []
        kinds += [((), torch.bool)] if self.mask_key else []
        for key, (size, dtype) in zip(self.created_keys, kinds, strict=True):
            shape = torch.Size((*agents, agents[-1], *size))
            numbers = Unbounded(shape, dtype=dtype, device=device)
            flags = Binary(shape[-1], shape, dtype=dtype, device=device)
            observation_spec[key] = flags if dtype == torch.bool else numbers
        return observation_spec


def _keys_of(
    in_keys: Any, out_keys: Any, action_key: Any
) -> tuple[list[NestedKey], list[NestedKey], NestedKey]:
    """Keys of the entries that are sent and received, and the key beside which a bare name is meant."""
    sent = read_keys(("agents", "observation") if in_keys is None else in_keys) if action_key is None else []
    checks.require(bool(sent or action_key), "in_keys", in_keys, "name nothing to send")
    beside = sent[0] if sent else unravel_key(action_key)
    checks.require(isinstance(beside, tuple), "action_key" if not sent else "in_keys", beside, _NO_GROUP)
    names = [f"received_{key[-1]}" for key in sent] if len(sent) > 1 else ["received"]
    written = [sibling_key(beside, key) for key in (names if out_keys is None else read_keys(out_keys))]
    written = cast(list[NestedKey], written)
    should = f"are not {len(names)} keys, as many as what is sent"
    checks.require(len(written) == len(names), "out_keys", out_keys, should)
    return sent, written, beside


_NO_GROUP = "is not in a group of agents, as ('agents', 'observation') is"


class SendLimits(NamedTuple):
    """What limits who sends in a step, whatever the agents want."""

    dt: float
    """Length of a step [s]."""
    limit: int | None
    """Number of agents of a world that may send in a step; None for all."""
    known_at_reset: bool
    """Whether all agents know the first message of all agents."""
    sends_at_reset: bool
    """Whether agents have something to send at a reset."""


class Senders(NamedTuple):
    """Who sends in a step."""

    active: Tensor
    """Rows of the worlds that take the step, [M] bool."""
    wanted: Tensor
    """Rows on which an agent wants to send, [M] bool; only active ones."""
    position: Tensor | None
    """Positions of the agents [m], [B * N, 2], if anything depends on them."""


class Received(NamedTuple):
    """What N receivers in each of B worlds hold of N senders."""

    contents: list[Tensor]
    """Contents of the messages, [B * N, N, ...] each; zeros before one has arrived."""
    age: Tensor
    """Steps since the messages were generated, or since the reset if none has arrived, [B * N, N]."""
    arrived: Tensor
    """Whether a message of this episode has arrived, [B * N, N] bool."""


class Topology(nn.Module, ABC):
    """Base class of the ways that messages take in B worlds of N agents; its methods are pure functions.

    The memory has M rows; a row is a link or an agent. Only its rings of messages are written in place. The
    time of a message is counted in steps since the reset, whose own messages have time 1.

    Args:
        sampler: draws the delays of what agents send.
        limits: what restricts the messages.
    """

    def __init__(self, sampler: Sampler, limits: SendLimits) -> None:
        super().__init__()
        self.sampler, self.limits, self.line = sampler, limits, BroadcastLine(sampler)
        self.draws = sampler.constant_delay is None or limits.limit is not None
        self.longest = sampler.longest

    @abstractmethod
    def rows(self, agents: torch.Size) -> torch.Size:
        """The shape of the rows, M in all, for agents of shape [*B, N]."""

    @abstractmethod
    def init_memory(self, contents: list[Tensor], streams: Tensor, n_agents: int) -> Memory:
        """Create the memory for contents such as these, [B * N, ...] each, and random streams [M]."""

    @abstractmethod
    def write(self, memory: Memory, contents: list[Tensor]) -> None:
        """Write what the agents may send in the next step, [B * N, ...] each."""

    @abstractmethod
    def clear(self, memory: Memory, mask: Tensor) -> Memory:
        """Discard all messages of the rows of the mask [M]."""

    @abstractmethod
    def step(self, memory: Memory, senders: Senders, known: Tensor | None = None) -> Memory:
        """Send what was written last, and deliver what arrives in this step.

        Args:
            memory: before the step.
            senders: who sends.
            known: rows to whose receivers everything is delivered at once, [M] bool.
        """

    @abstractmethod
    def received(self, memory: Memory) -> Received:
        """What the agents hold."""

    def reset(self, memory: Memory, senders: Senders) -> Memory:
        """Begin an episode in the active worlds, with messages that were written before."""
        mask = senders.active
        begun = self.clear(memory, mask)
        after = self.step(begun, senders, mask if self.limits.known_at_reset else None)
        return {
            name: new if new is begun[name] else torch.where(expand_mask(mask, new), new, begun[name])
            for name, new in after.items()
        }

    def _may_send(self, line: Memory, wants: Tensor) -> Tensor:
        """Draw who may send if not all may, [B, N] bool, among those who want to, [B, N] bool."""
        if self.limits.limit is None:
            return wants
        streams, clock = line["streams"][line["link"]], line["clock"][line["link"]] + 1
        n = wants.shape[-1]
        agent = torch.arange(len(clock), device=clock.device) % n
        draw = counter_rng.bits(streams, clock, torch.full_like(clock, _TURN_DRAW), agent)
        turn = (draw * n + agent).view(wants.shape)
        before = wants.unsqueeze(1) & (turn.unsqueeze(1) < turn.unsqueeze(2))
        return wants & (before.sum(-1) < self.limits.limit)

    def _context(
        self, line: Memory, sender: Tensor, receiver: Tensor, n_sending: Tensor, entries: dict[str, Tensor]
    ) -> MessageContext:
        """The context of the messages of a line's next step."""
        clock = line["clock"]
        return MessageContext(
            sender=sender,
            receiver=receiver,
            n_sending=n_sending,
            time=(clock - line["reset_at"]) * self.limits.dt,
            uniform=counter_rng.uniform(line["streams"], clock + 1),
            dt=self.limits.dt,
            entries=entries,
        )

    def _with_own(self, held: list[Tensor], own: list[Tensor], time: Tensor, now: Tensor) -> Received:
        """What the agents hold, if each one knows its own message at once.

        Args:
            held: contents of the messages that have arrived, [B * N, N, ...] each.
            own: contents of what the agents sent last, [B * N, ...] each.
            time: of the messages that have arrived; 0 if none has, [B * N, N].
            now: time of this step, [B * N, N].
        """
        n = now.shape[-1]
        agents, senders = torch.arange(len(now), device=now.device), torch.arange(n, device=now.device)
        is_own = (agents % n).unsqueeze(-1) == senders
        own_time = now if self.limits.sends_at_reset else now.masked_fill(now == 1, 0)
        time = torch.where(is_own, own_time, time)
        pairs = zip(own, held, strict=True)
        contents = [torch.where(expand_mask(is_own, old), new.unsqueeze(1), old) for new, old in pairs]
        return Received(contents, now - time.clamp(min=1), time > 0)


class DirectLinks(Topology):
    """Agents send to each other; the rows are the links (receiver, sender), [*B, N, N].

    Args:
        sampler: draws the delays of the links.
        limits: what restricts the messages.
        hears: which sender each receiver hears, [N, N] bool; all of them if not given.
        comm_range: distance beyond which a receiver does not hear a sender [m], if there is one.
    """

    def __init__(
        self,
        sampler: Sampler,
        limits: SendLimits,
        hears: Tensor | None = None,
        comm_range: float | None = None,
    ) -> None:
        super().__init__(sampler, limits)
        self._hears, self._comm_range = None if hears is None else hears.flatten().tolist(), comm_range

    def rows(self, agents: torch.Size) -> torch.Size:
        return torch.Size((*agents, agents[-1]))

    def init_memory(self, contents: list[Tensor], streams: Tensor, n_agents: int) -> Memory:
        links = torch.arange(len(streams), device=streams.device)
        receiver, sender = links // n_agents, links % n_agents
        streams = streams_for(self.sampler, streams, n_agents**2)
        memory = self.line.init_memory(contents, streams, receiver // n_agents * n_agents + sender)
        hears = receiver % n_agents != sender
        if self._hears is not None:
            matrix = torch.tensor(self._hears, device=streams.device)
            hears = hears & matrix.repeat(len(streams) // len(matrix))
        return memory | {"hears": hears}

    def write(self, memory: Memory, contents: list[Tensor]) -> None:
        self.line.write(memory, contents)

    def clear(self, memory: Memory, mask: Tensor) -> Memory:
        return self.line.reset(memory, mask)

    def step(self, memory: Memory, senders: Senders, known: Tensor | None = None) -> Memory:
        sent = self._sent(memory, senders)
        sees = self.sampler.sees_context
        context = self._links_context(memory, sent, senders.position) if sees else None
        memory = self.line.step(memory, sent, context)
        return memory if known is None else self.line.deliver_now(memory, known)

    def received(self, memory: Memory) -> Received:
        n = _n_agents(memory)
        time, now = ((memory[name] - memory["reset_at"]).view(-1, n) for name in ("generated_at", "clock"))
        held = [value.view(-1, n, *value.shape[1:]) for value in self.line.held(memory)]
        return self._with_own(held, self.line.newest(memory), time, now)

    def _sent(self, memory: Memory, senders: Senders) -> Tensor:
        """The links that carry a message, [M] bool."""
        n = _n_agents(memory)
        sent = senders.wanted & memory["hears"]
        if self._comm_range is not None:
            assert senders.position is not None
            place = senders.position.view(-1, n, senders.position.shape[-1])
            distance = torch.linalg.vector_norm(place.unsqueeze(1) - place.unsqueeze(2), dim=-1)
            sent = sent & (distance <= self._comm_range).view(-1)
        by_link = sent.view(-1, n, n)
        return (by_link & self._may_send(memory, by_link.any(1)).unsqueeze(1)).view(-1)

    def _links_context(self, memory: Memory, sent: Tensor, position: Tensor | None) -> MessageContext:
        """The context of the messages of all links."""
        n, sender = _n_agents(memory), memory["sender"]
        receiver = torch.arange(len(sender), device=sender.device) // n
        n_sending = sent.view(-1, n, n).any(1).sum(-1).repeat_interleave(n * n)
        places = {"position": sender, "receiver_position": receiver}
        entries = {} if position is None else {k: position.index_select(0, v) for k, v in places.items()}
        return self._context(memory, sender % n, receiver % n, n_sending, entries)


class ServerLinks(Topology):
    """Agents send to a server, which broadcasts the newest message that it holds of each agent in each step.

    The rows are the agents, [*B, N]. A broadcast to a receiver is one message. The memory of what agents send
    has names with ``up_``, that of the broadcasts with ``down_``.

    Args:
        sampler: draws the delays of what agents send.
        down_sampler: draws the delays of the broadcasts.
        limits: what restricts the messages of the agents.
    """

    def __init__(self, sampler: Sampler, down_sampler: Sampler, limits: SendLimits) -> None:
        super().__init__(sampler, limits)
        self.down_sampler, self.down_line = down_sampler, BroadcastLine(down_sampler)
        self.draws = self.draws or down_sampler.constant_delay is None
        self.longest += down_sampler.longest

    def rows(self, agents: torch.Size) -> torch.Size:
        return agents

    def init_memory(self, contents: list[Tensor], streams: Tensor, n_agents: int) -> Memory:
        agents = torch.arange(len(streams), device=streams.device)
        up = self.line.init_memory(contents, streams_for(self.sampler, streams, n_agents), agents)
        down_streams = counter_rng.bits(streams, torch.full_like(streams, _SERVER_STREAM))
        down_streams = streams_for(self.down_sampler, down_streams, n_agents)
        examples = self._broadcast(up, n_agents)
        return _joined(up, self.down_line.init_memory(examples, down_streams, agents // n_agents))

    def write(self, memory: Memory, contents: list[Tensor]) -> None:
        self.line.write(_parts(memory)[0], contents)

    def clear(self, memory: Memory, mask: Tensor) -> Memory:
        up, down = _parts(memory)
        return _joined(self.line.reset(up, mask), self.down_line.reset(down, mask))

    def step(self, memory: Memory, senders: Senders, known: Tensor | None = None) -> Memory:
        up, down = _parts(memory)
        n = _n_agents(down)
        sent = self._may_send(up, senders.wanted.view(-1, n)).view(-1)
        sees = self.sampler.sees_context
        up = self.line.step(up, sent, self._up_context(up, sent, n, senders.position) if sees else None)
        up = up if known is None else self.line.deliver_now(up, known)
        self.down_line.write(down, self._broadcast(up, n))
        sees = self.down_sampler.sees_context
        context = self._down_context(down, senders.position) if sees else None
        down = self.down_line.step(down, senders.active, context)
        return _joined(up, down if known is None else self.down_line.deliver_now(down, known))

    def received(self, memory: Memory) -> Received:
        up, down = _parts(memory)
        *held, time = self.down_line.held(down)
        now = (down["clock"] - down["reset_at"]).unsqueeze(-1).expand_as(time)
        return self._with_own(held, self.line.newest(up), time, now)

    def _broadcast(self, up: Memory, n_agents: int) -> list[Tensor]:
        """What the server broadcasts, [B, N, ...] each: contents and, at the end, times of the messages."""
        values = [*self.line.held(up), up["generated_at"] - up["reset_at"]]
        return [value.view(-1, n_agents, *value.shape[1:]) for value in values]

    def _up_context(self, up: Memory, sent: Tensor, n: int, position: Tensor | None) -> MessageContext:
        n_sending = sent.view(-1, n).sum(-1).repeat_interleave(n)
        entries = {} if position is None else {"position": position}
        sender = up["sender"] % n
        return self._context(up, sender, torch.full_like(sender, -1), n_sending, entries)

    def _down_context(self, down: Memory, position: Tensor | None) -> MessageContext:
        receiver = torch.arange(len(down["clock"]), device=down["clock"].device) % _n_agents(down)
        entries = {} if position is None else {"position": position}
        one = torch.ones_like(receiver)
        return self._context(down, -one, receiver, one, entries)


def _n_agents(line: Memory) -> int:
    """The number of links of a sender."""
    return len(line["sender"]) // len(line["link"])


def _joined(up: Memory, down: Memory) -> Memory:
    return {f"up_{k}": v for k, v in up.items()} | {f"down_{k}": v for k, v in down.items()}


def _parts(memory: Memory) -> tuple[Memory, Memory]:
    up, down = (
        {k.removeprefix(prefix): v for k, v in memory.items() if k.startswith(prefix)}
        for prefix in ("up_", "down_")
    )
    return up, down


def make_topology(
    topology: Any,
    delay: Any,
    loss: Any,
    down_delay: Any,
    down_loss: float | None,
    comm_range: float | None,
    limits: SendLimits,
    has_position: bool,
) -> Topology:
    """Build a topology from the arguments of ``Channel``.

    Raises:
        InputError: one is invalid, or does not go with another one.
    """
    by_server = isinstance(topology, str) and topology == "server"
    if by_server:
        for name, matrix in (("delay", delay), ("loss", loss)):
            should = "has an entry for each link, but with topology='server' agents send to the server only"
            checks.require(not is_matrix(matrix), name, matrix, should)
        checks.require(comm_range is None, "comm_range", comm_range, "does not go with topology='server'")
        up = _sampler("delay", delay, loss, limits.dt, ["position"] * has_position)
        down_delay, down_loss = down_delay or 0, down_loss or 0.0
        down = _sampler("down_delay", down_delay, down_loss, limits.dt, ["position"] * has_position)
        return ServerLinks(up, down, limits)
    for name, value in (("down_delay", down_delay), ("down_loss", down_loss)):
        checks.require(value is None, name, value, "goes only with topology='server'")
    if not is_matrix(topology):
        checks.one_of("topology", topology, ["all", "server", "a nested list of N x N bool"])
    if comm_range is not None:
        checks.above("comm_range", comm_range, 0.0, "m")
        checks.require(has_position, "comm_range", comm_range, "needs a position_key")
    hears = torch.as_tensor(topology) if is_matrix(topology) else None
    good = hears is None or hears.dtype == torch.bool
    checks.require(good, "topology", topology, "is not a matrix of bool: who hears whom")
    offered = ["position", "receiver_position"] if has_position else []
    return DirectLinks(_sampler("delay", delay, loss, limits.dt, offered), limits, hears, comm_range)


def _sampler(key: str, delay: Any, loss: Any, dt: float, offered: list[str]) -> Sampler:
    """A sampler whose laws read nothing but the entries offered."""
    sampler = link_sampler(delay, loss, dt, key)
    for name in sampler.reads:
        can = f"can read {', '.join(offered)}" if offered else "can read positions only with a position_key"
        checks.require(name in offered, key, f"a law that reads {name}", f"does not go here: it {can}")
    return sampler
