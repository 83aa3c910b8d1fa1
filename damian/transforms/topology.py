"""Who hears whom: messages go from agent to agent, or through a server node."""

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from damian.common import checks, counter_rng
from damian.common.tensors import expand_mask
from damian.delays.laws import is_matrix, link_sampler
from damian.delays.line import BroadcastLine, Memory
from damian.delays.samplers import MessageContext, Sampler, streams_for

_SERVER_STREAM, _TURN_DRAW = 1, 4
"""Counters that tell the server's random streams, and the draws of who may send, from those of the delays."""


class Rules(NamedTuple):
    """What restricts the messages of a step."""

    dt: float
    """Length of a step [s]."""
    limit: int | None
    """Number of agents of a world that may send in a step; None for all."""
    known_at_reset: bool
    """Whether all agents know the first message of all agents."""
    sends_at_reset: bool
    """Whether agents have something to send at a reset."""


class Sending(NamedTuple):
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
        rules: what restricts the messages.
    """

    def __init__(self, sampler: Sampler, rules: Rules) -> None:
        super().__init__()
        self.sampler, self.rules, self.line = sampler, rules, BroadcastLine(sampler)
        self.draws = sampler.constant_delay is None or rules.limit is not None
        self.longest = sampler.longest

    @abstractmethod
    def rows(self, agents: torch.Size) -> torch.Size:
        """The shape of the rows, M in all, for agents of shape [*B, N]."""

    @abstractmethod
    def init_memory(self, contents: list[Tensor], streams: Tensor, n_agents: int) -> Memory:
        """Create the memory for contents such as these, [B * N, ...] each, and random streams [M]."""

    @abstractmethod
    def n_bytes(self, n_total: int, n_agents: int, size: int) -> int:
        """Size of the memory, for messages of ``size`` bytes of B * N = ``n_total`` agents, about [bytes]."""

    @abstractmethod
    def try_laws(self, memory: Memory, position: Tensor | None) -> None:
        """Try the laws that see the context of messages once; their errors stay as they are."""

    @abstractmethod
    def write(self, memory: Memory, contents: list[Tensor]) -> None:
        """Write what the agents may send in the next step, [B * N, ...] each."""

    @abstractmethod
    def clear(self, memory: Memory, mask: Tensor) -> Memory:
        """Discard all messages of the rows of the mask [M]."""

    @abstractmethod
    def step(self, memory: Memory, sending: Sending, known: Tensor | None = None) -> Memory:
        """Send what was written last, and deliver what arrives in this step.

        Args:
            memory: before the step.
            sending: who sends.
            known: rows to whose receivers everything is delivered at once, [M] bool.
        """

    @abstractmethod
    def received(self, memory: Memory) -> Received:
        """What the agents hold."""

    def reset(self, memory: Memory, sending: Sending) -> Memory:
        """Begin an episode in the active worlds, with messages that were written before."""
        mask = sending.active
        begun = self.clear(memory, mask)
        after = self.step(begun, sending, mask if self.rules.known_at_reset else None)
        return {
            name: new if new is begun[name] else torch.where(expand_mask(mask, new), new, begun[name])
            for name, new in after.items()
        }

    def _may_send(self, line: Memory, wants: Tensor) -> Tensor:
        """Draw who may send if not all may, [B, N] bool, among those who want to, [B, N] bool."""
        if self.rules.limit is None:
            return wants
        streams, clock = line["streams"][line["link"]], line["clock"][line["link"]] + 1
        n = wants.shape[-1]
        agent = torch.arange(len(clock), device=clock.device) % n
        draw = counter_rng.bits(streams, clock, torch.full_like(clock, _TURN_DRAW), agent)
        turn = (draw * n + agent).view(wants.shape)
        before = wants.unsqueeze(1) & (turn.unsqueeze(1) < turn.unsqueeze(2))
        return wants & (before.sum(-1) < self.rules.limit)

    def _context(
        self, line: Memory, sender: Tensor, receiver: Tensor, n_sending: Tensor, entries: dict[str, Tensor]
    ) -> MessageContext:
        """The context of the messages of a line's next step."""
        clock = line["clock"]
        return MessageContext(
            sender=sender,
            receiver=receiver,
            n_sending=n_sending,
            time=(clock - line["reset_at"]) * self.rules.dt,
            uniform=counter_rng.uniform(line["streams"], clock + 1),
            dt=self.rules.dt,
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
        own_time = now if self.rules.sends_at_reset else now.masked_fill(now == 1, 0)
        time = torch.where(is_own, own_time, time)
        pairs = zip(own, held, strict=True)
        contents = [torch.where(expand_mask(is_own, old), new.unsqueeze(1), old) for new, old in pairs]
        return Received(contents, now - time.clamp(min=1), time > 0)


class DirectLinks(Topology):
    """Agents send to each other; the rows are the links (receiver, sender), [*B, N, N].

    Args:
        sampler: draws the delays of the links.
        rules: what restricts the messages.
        hears: which sender each receiver hears, [N, N] bool; all of them if not given.
        comm_range: distance beyond which a receiver does not hear a sender [m], if there is one.
    """

    def __init__(
        self, sampler: Sampler, rules: Rules, hears: Tensor | None = None, comm_range: float | None = None
    ) -> None:
        super().__init__(sampler, rules)
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

    def n_bytes(self, n_total: int, n_agents: int, size: int) -> int:
        return self.line.n_bytes(n_total, n_total * n_agents, size)

    def try_laws(self, memory: Memory, position: Tensor | None) -> None:
        if self.sampler.sees_context:
            _try(self.sampler, memory, self._links_context(memory, memory["hears"], position))

    def write(self, memory: Memory, contents: list[Tensor]) -> None:
        self.line.write(memory, contents)

    def clear(self, memory: Memory, mask: Tensor) -> Memory:
        return self.line.reset(memory, mask)

    def step(self, memory: Memory, sending: Sending, known: Tensor | None = None) -> Memory:
        sent = self._sent(memory, sending)
        sees = self.sampler.sees_context
        context = self._links_context(memory, sent, sending.position) if sees else None
        memory = self.line.step(memory, sent, context)
        return memory if known is None else self.line.deliver_now(memory, known)

    def received(self, memory: Memory) -> Received:
        n = _n_agents(memory)
        time, now = ((memory[name] - memory["reset_at"]).view(-1, n) for name in ("generated_at", "clock"))
        held = [value.view(-1, n, *value.shape[1:]) for value in self.line.held(memory)]
        return self._with_own(held, self.line.newest(memory), time, now)

    def _sent(self, memory: Memory, sending: Sending) -> Tensor:
        """The links that carry a message, [M] bool."""
        n = _n_agents(memory)
        sent = sending.wanted & memory["hears"]
        if self._comm_range is not None:
            assert sending.position is not None
            place = sending.position.view(-1, n, sending.position.shape[-1])
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
        rules: what restricts the messages of the agents.
    """

    def __init__(self, sampler: Sampler, down_sampler: Sampler, rules: Rules) -> None:
        super().__init__(sampler, rules)
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

    def n_bytes(self, n_total: int, n_agents: int, size: int) -> int:
        broadcast = n_agents * (8 + size)
        up = self.line.n_bytes(n_total, n_total, size)
        return up + self.down_line.n_bytes(n_total // n_agents, n_total, broadcast)

    def try_laws(self, memory: Memory, position: Tensor | None) -> None:
        up, down = _parts(memory)
        everyone = torch.ones_like(up["clock"], dtype=torch.bool)
        if self.sampler.sees_context:
            _try(self.sampler, up, self._up_context(up, everyone, _n_agents(down), position))
        if self.down_sampler.sees_context:
            _try(self.down_sampler, down, self._down_context(down, position))

    def write(self, memory: Memory, contents: list[Tensor]) -> None:
        self.line.write(_parts(memory)[0], contents)

    def clear(self, memory: Memory, mask: Tensor) -> Memory:
        up, down = _parts(memory)
        return _joined(self.line.reset(up, mask), self.down_line.reset(down, mask))

    def step(self, memory: Memory, sending: Sending, known: Tensor | None = None) -> Memory:
        up, down = _parts(memory)
        n = _n_agents(down)
        sent = self._may_send(up, sending.wanted.view(-1, n)).view(-1)
        sees = self.sampler.sees_context
        up = self.line.step(up, sent, self._up_context(up, sent, n, sending.position) if sees else None)
        up = up if known is None else self.line.deliver_now(up, known)
        self.down_line.write(down, self._broadcast(up, n))
        sees = self.down_sampler.sees_context
        context = self._down_context(down, sending.position) if sees else None
        down = self.down_line.step(down, sending.active, context)
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


def _try(sampler: Sampler, line: Memory, context: MessageContext) -> None:
    """Draw once, and discard the delays."""
    sampler(line["streams"], line["clock"], line["channel"], context)


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
    rules: Rules,
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
        up = _sampler("delay", delay, loss, rules.dt, ["position"] * has_position)
        down_delay, down_loss = down_delay or 0, down_loss or 0.0
        down = _sampler("down_delay", down_delay, down_loss, rules.dt, ["position"] * has_position)
        return ServerLinks(up, down, rules)
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
    return DirectLinks(_sampler("delay", delay, loss, rules.dt, offered), rules, hears, comm_range)


def _sampler(key: str, delay: Any, loss: Any, dt: float, offered: list[str]) -> Sampler:
    """A sampler whose laws read nothing but the entries offered."""
    sampler = link_sampler(delay, loss, dt, key)
    for name in sampler.reads:
        can = f"can read {', '.join(offered)}" if offered else "can read positions only with a position_key"
        checks.require(name in offered, key, f"a law that reads {name}", f"does not go here: it {can}")
    return sampler
