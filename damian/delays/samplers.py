"""Samplers draw one delay per message: pure functions of random streams, clocks and contexts."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from damian.common import checks, counter_rng

_LOSS_DRAW, _HOLD_DRAW, _PHASE_DRAW, _LINK_LOSS_DRAW = 0, 1, 2, 3
"""Counters that tell the further draws of a message from the draw of its delay."""


class MessageContext(NamedTuple):
    """Circumstances of M messages at the instant at which they are sent; nothing in it lies in the future."""

    sender: Tensor
    """Index of the sender among the agents of its world, [M] long; 0 if a world has one agent."""
    receiver: Tensor
    """Index of the receiver among the agents of its world, [M] long; -1 for the server or the environment."""
    n_sending: Tensor
    """Number of senders of the same world that send a message in this step, [M] long."""
    time: Tensor
    """Time since the episode began [s], [M]."""
    uniform: Tensor
    """A random number in [0, 1) for each message, [M]; the same again for the same seed."""
    dt: float
    """Length of a step [s]."""
    entries: dict[str, Tensor]
    """The entries that the law reads, by name, [M, ...] each; ``position`` is east and north [m], [M, 2]."""


class Sampler(nn.Module):
    """Draws delays from a table of probabilities.

    A worked timeline: with the table ``[[0.5, 0, 0, 0.5]]`` a message sent at t = 0 arrives at t = 0 or, as
    likely, at t = 3, whatever the delays of the others.

    Args:
        states: for each of S channel states, the probabilities of the delays 0, 1, ... [steps]; if they sum
            to less than 1, the rest is the probability that the message is lost.
        transitions: probabilities of the transitions between the channel states per step, [S, S]; None for
            one state.
        loss: probability that a message is lost, whatever its delay.
    """

    sees_context: bool = False
    """Whether a delay depends on the message's context."""
    reads: tuple[str, ...] = ()
    """Names of the entries that the context must contain."""
    optional_reads: tuple[str, ...] = ()
    """Names of the entries that the context contains where the transform has a key for them."""
    same_draws_for_all_agents: bool = False
    """Whether all agents of a world draw the same numbers."""
    chances: Tensor
    _boundaries: Tensor

    def __init__(
        self, states: list[list[float]], transitions: list[list[float]] | None = None, loss: float = 0.0
    ) -> None:
        super().__init__()
        checks.in_range("loss", loss, 0.0, 1.0)
        self.longest = max(map(len, states)) - 1
        self.lost = self.longest + 1
        """Delay value that marks a message that never arrives."""
        arrive = torch.zeros(len(states), self.longest + 1, dtype=torch.float64)
        for row, chances in zip(arrive, states, strict=True):
            row[: len(chances)] = torch.tensor(chances, dtype=torch.float64) * (1 - loss)
        chances = torch.cat([arrive, (1 - arrive.sum(-1, keepdim=True)).clamp(min=0)], -1)
        self.register_buffer("chances", chances, persistent=False)
        self.loses = bool((chances[:, -1] > 1e-9).any())
        """Whether messages can be lost."""
        change = torch.tensor(transitions or [[1.0]], dtype=torch.float64)
        # The next state and the delay are one outcome, so that a message takes a single draw.
        joint = (change.unsqueeze(-1) * chances.unsqueeze(0)).flatten(1)
        boundaries = (joint.cumsum(-1)[:, :-1] * 2**32).round().long()
        self.register_buffer("_boundaries", boundaries, persistent=False)
        self._bad_share = (change[0, 1] / (change[0, 1] + change[1, 0])).item() if transitions else 0.0
        likeliest = int(chances[0].argmax())
        self.constant_delay = likeliest if bool((chances[:, likeliest] == 1).all()) else None
        """The delay [steps] if it is always the same, else None."""

    @property
    def memoryless(self) -> bool:
        """Whether all delays are drawn independently from the same table, by this class's ``forward``."""
        return len(self.chances) == 1 and type(self).forward is Sampler.forward

    def initial_state(self, streams: Tensor) -> Tensor:
        """Draw the initial state of each sender's channel [M, ...] from its random stream [M]."""
        return (counter_rng.uniform(streams) < self._bad_share).long()

    def begin_episode(self, memory: Tensor, mask: Tensor) -> Tensor:
        """The channels' states [M, ...], where the mask [M] is true before an episode's first message."""
        return memory

    def forward(
        self, streams: Tensor, clock: Tensor, memory: Tensor, context: MessageContext | None = None
    ) -> tuple[Tensor, Tensor]:
        """Draw the delays [M] of the messages sent at ``clock``, and the channels' next states [M, ...]."""
        if self.constant_delay is not None:
            return torch.full_like(streams, self.constant_delay), memory
        draw = counter_rng.bits(streams, clock)
        if len(self.chances) == 1:
            return torch.bucketize(draw, self._boundaries[0], right=True), memory
        outcome = (draw.unsqueeze(-1) >= self._boundaries[memory]).sum(-1)
        n = self.longest + 2
        return outcome % n, outcome // n


class Recorded(Sampler):
    """Plays back recorded delays [steps], -1 if lost; each sender starts at a random one, its state."""

    _delays: Tensor

    def __init__(self, delays: list[int], loss: float) -> None:
        longest = max(*delays, 0)
        codes = torch.tensor([longest + 1 if delay < 0 else delay for delay in delays])
        counts = torch.bincount(codes, minlength=longest + 2)
        frequencies = counts[:-1].double() / len(delays)
        super().__init__([frequencies.tolist()], loss=loss)
        self._loss = loss
        self.register_buffer("_delays", codes, persistent=False)

    def initial_state(self, streams: Tensor) -> Tensor:
        return counter_rng.bits(streams) % len(self._delays)

    def forward(
        self, streams: Tensor, clock: Tensor, memory: Tensor, context: MessageContext | None = None
    ) -> tuple[Tensor, Tensor]:
        delay = self._delays[memory]
        if self._loss:
            delay = torch.where(counter_rng.uniform(streams, clock) < self._loss, self.lost, delay)
        return delay, (memory + 1) % len(self._delays)


class HeldSampler(Sampler):
    """Gives every message the longest delay of another sampler; the same messages are lost."""

    def __init__(self, drawn: Sampler) -> None:
        arrival_chances = (1 - drawn.chances[:, -1]).tolist()
        super().__init__([[0.0] * drawn.longest + [chance] for chance in arrival_chances])
        self.drawn = drawn
        self.sees_context = drawn.sees_context
        self.same_draws_for_all_agents = drawn.same_draws_for_all_agents
        self.reads, self.optional_reads = drawn.reads, drawn.optional_reads
        self.constant_delay = None if self.loses else self.longest

    @property
    def memoryless(self) -> bool:
        return self.drawn.memoryless

    def initial_state(self, streams: Tensor) -> Tensor:
        return self.drawn.initial_state(streams)

    def begin_episode(self, memory: Tensor, mask: Tensor) -> Tensor:
        return self.drawn.begin_episode(memory, mask)

    def forward(
        self, streams: Tensor, clock: Tensor, memory: Tensor, context: MessageContext | None = None
    ) -> tuple[Tensor, Tensor]:
        delay, memory = self.drawn(streams, clock, memory, context)
        return torch.where(delay < self.lost, self.longest, self.lost), memory


class LagSampler(Sampler):
    """Draws a delay (a lag) from a table, and holds it for a period (None: an episode); losses are not held.

    The state of a channel is [M, 2] long: the lag, -1 before the first message of an episode, and the number
    of steps that it is still held.
    """

    def __init__(self, law: Any, chances: list[float], loss: float, period: int | None) -> None:
        super().__init__([chances], loss=loss)
        arrives = sum(chances)
        self._lags = Sampler([[chance / arrives for chance in chances]] if arrives else [[1.0]])
        self._loss = self.chances[0, -1].item() if self.loses else 0.0
        self._period, self._hold_probability = period or _NEVER, law.hold_probability
        self.same_draws_for_all_agents, self._stagger = law.shared, law.stagger

    def initial_state(self, streams: Tensor) -> Tensor:
        return torch.stack([torch.full_like(streams, -1), torch.zeros_like(streams)], -1)

    def begin_episode(self, memory: Tensor, mask: Tensor) -> Tensor:
        return torch.where(mask.unsqueeze(-1), self.initial_state(memory[:, 0]), memory)

    def forward(
        self, streams: Tensor, clock: Tensor, memory: Tensor, context: MessageContext | None = None
    ) -> tuple[Tensor, Tensor]:
        if self.constant_delay is not None:
            return torch.full_like(streams, self.constant_delay), memory
        lag, wait = memory.unbind(-1)
        first, due = lag < 0, wait == 0
        renewed, interval = due, torch.full_like(streams, self._period)
        if self._hold_probability:
            draw = counter_rng.uniform(streams, clock, torch.full_like(clock, _HOLD_DRAW))
            renewed = first | (due & (draw >= self._hold_probability))
        if self._stagger:
            phase = counter_rng.bits(streams, clock, torch.full_like(clock, _PHASE_DRAW)) % self._period
            interval = torch.where(first, 1 + phase, interval)
        drawn, _ = self._lags(streams, clock, memory)
        lag = torch.where(renewed, drawn, lag)
        memory = torch.stack([lag, torch.where(due, interval, wait) - 1], -1)
        if not self._loss:
            return lag, memory
        lost = counter_rng.uniform(streams, clock, torch.full_like(clock, _LOSS_DRAW)) < self._loss
        return torch.where(lost, self.lost, lag), memory


_NEVER = 2**40
"""Steps that no episode lasts."""


class ContextSampler(Sampler):
    """Computes each delay from the context of the message, by a function.

    A worked timeline: the function returns 2.4 for a message sent at t = 0, which is rounded up to 3 steps:
    the message arrives at t = 3. For a message sent at t = 1 it returns -1: the message never arrives.

    Args:
        delay_fn: pure function of a ``MessageContext``, without branches on data, that returns the delays
            [steps], [M]; they are rounded up and cut to ``longest``, and a message of negative delay is lost.
        longest: longest delay [steps].
        loss: probability that a message is lost, whatever its delay.
        loses: whether ``delay_fn`` can lose a message. With False, negative delays count as 0, as rewards
            need it.
        reads, optional_reads: names of the entries that ``delay_fn`` reads, such as ``position``, always or
            if the transform has a key for them.

    Examples:
        >>> ContextSampler(lambda context: context.n_sending // 4, longest=5, loses=False)
    """

    def __init__(
        self,
        delay_fn: Callable[[MessageContext], Tensor],
        longest: int,
        loss: float = 0.0,
        *,
        loses: bool = True,
        reads: Sequence[str] = (),
        optional_reads: Sequence[str] = (),
    ) -> None:
        # The table holds the worst case, because the true chances depend on the contexts: it serves only to
        # tell the longest delay, and whether messages can be lost.
        super().__init__([[0.0] * longest + [float(not loses)]], loss=loss)
        self.constant_delay = None
        self.sees_context, self.reads, self.optional_reads = True, tuple(reads), tuple(optional_reads)
        self._delay_fn, self._loss, self._loses = delay_fn, loss, loses

    def forward(
        self, streams: Tensor, clock: Tensor, memory: Tensor, context: MessageContext | None = None
    ) -> tuple[Tensor, Tensor]:
        delay = self._delay_fn(cast(MessageContext, context)).view_as(streams)
        arrives = delay >= 0  # false for nan too
        steps = torch.where(arrives, delay, 0)
        if steps.dtype.is_floating_point:  # 21.000002 steps are 21
            steps = steps - 1e-5 * steps.clamp(1, self.longest)
        steps = steps.ceil().clamp(max=self.longest).long()
        if self._loses:
            steps = torch.where(arrives, steps, self.lost)
        if self._loss:  # by a draw that is independent of ``context.uniform``
            draw = counter_rng.uniform(streams, clock, torch.full_like(clock, _LOSS_DRAW))
            steps = torch.where(draw < self._loss, self.lost, steps)
        return steps, memory


class LinkSampler(Sampler):
    """Draws the delays of messages on the links between N agents, by a law and a loss for each link.

    Links are numbered receiver * N + sender; message m of the M of a step belongs to link m modulo N * N.
    Every distinct law has one sampler, which draws for all links. The states of all samplers lie side by
    side, [M, S].

    A worked timeline: the link from agent 0 to agent 1 has a constant delay of 3 steps, the link to agent 2
    one of 1 step. What agent 0 sends at t = 0 arrives at agent 2 at t = 1, and at agent 1 at t = 3.
    """

    _law_index: Tensor
    _loss: Tensor

    def __init__(self, samplers: Sequence[Sampler], law_index: Tensor, loss: Tensor) -> None:
        longest = max(sampler.longest for sampler in samplers)
        super().__init__([[0.0] * (longest + 1)])  # the worst case: every message may be lost
        self.constant_delay = None
        self.samplers = nn.ModuleList(samplers)
        self.sees_context = any(sampler.sees_context for sampler in samplers)
        self.reads = tuple(dict.fromkeys(name for sampler in samplers for name in sampler.reads))
        self._loses = bool((loss > 0).any())
        example = torch.zeros(1, dtype=torch.long)
        self._state_shapes = [sampler.initial_state(example).shape[1:] for sampler in samplers]
        self.register_buffer("_law_index", law_index, persistent=False)
        self.register_buffer("_loss", loss, persistent=False)

    def initial_state(self, streams: Tensor) -> Tensor:
        return _side_by_side([sampler.initial_state(streams) for sampler in self._samplers])

    def begin_episode(self, memory: Tensor, mask: Tensor) -> Tensor:
        pairs = zip(self._samplers, self._states(memory), strict=True)
        return _side_by_side([sampler.begin_episode(state, mask) for sampler, state in pairs])

    def forward(
        self, streams: Tensor, clock: Tensor, memory: Tensor, context: MessageContext | None = None
    ) -> tuple[Tensor, Tensor]:
        n_links = len(self._law_index)
        n_worlds, delay, states = len(streams) // n_links, torch.zeros_like(streams), []
        index = self._law_index.repeat(n_worlds)
        for k, (sampler, state) in enumerate(zip(self._samplers, self._states(memory), strict=True)):
            drawn, new_state = sampler(streams_for(sampler, streams, n_links), clock, state, context)
            drawn = torch.where(drawn < sampler.lost, drawn, self.lost)
            delay = torch.where(index == k, drawn, delay)
            states.append(new_state)
        if self._loses:
            draw = counter_rng.uniform(streams, clock, torch.full_like(clock, _LINK_LOSS_DRAW))
            delay = torch.where(draw < self._loss.repeat(n_worlds), self.lost, delay)
        return delay, _side_by_side(states)

    @property
    def _samplers(self) -> list[Any]:
        return list(self.samplers)

    def _states(self, memory: Tensor) -> list[Tensor]:
        """The state of each sampler, [M, ...]."""
        parts = memory.split([shape.numel() for shape in self._state_shapes], -1)
        pairs = zip(parts, self._state_shapes, strict=True)
        return [part.reshape(len(part), *shape) for part, shape in pairs]


def _side_by_side(states: list[Tensor]) -> Tensor:
    return torch.cat([state.reshape(len(state), -1) for state in states], -1)


def streams_for(sampler: Sampler, streams: Tensor, n_rows: int) -> Tensor:
    """The random streams [M] from which a sampler draws: for ``n_rows`` rows of a world, maybe one."""
    if not sampler.same_draws_for_all_agents:
        return streams
    return streams.view(-1, n_rows)[:, :1].expand(-1, n_rows).reshape(-1)
