"""Samplers draw one delay per message: pure functions of random streams, clocks and contexts."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from damian.common import checks, counter_rng
from damian.common.tensors import where_rows

_LOSS_DRAW, _HOLD_DRAW, _PHASE_DRAW, _LINK_LOSS_DRAW = 0, 1, 2, 3
"""Counters that tell the further draws of a message from the draw of its delay."""


class MessageContext(NamedTuple):
    """Circumstances of M messages at the instant at which they are sent; nothing in it lies in the
    future."""

    sender: Tensor
    """Index of the sender among the agents of its world, [M] long; 0 if a world has one agent."""
    receiver: Tensor
    """Index of the receiver among the agents of its world, [M] long; -1 for the server or the
    environment."""
    n_sending: Tensor
    """Number of senders of the same world that send a message in this step, [M] long."""
    time: Tensor
    """Time since the episode began [s], [M]."""
    uniform: Tensor
    """A random number in [0, 1) for each message, [M]; the same again for the same seed."""
    dt: float
    """Length of a step [s]."""
    entries: dict[str, Tensor]
    """The entries that the law reads, by name, [M, ...] each; ``position`` is east and north [m],
    [M, 2]."""


Context = MessageContext | None
"""None if the sampler sees no context."""
Drawn = tuple[Tensor, Tensor]
"""The delays of M messages, [M] long, from 0 to ``longest``, or ``lost``; and the next states,
[M, ...]."""


class Sampler(nn.Module, ABC):
    """Draws a delay for each message; derive from it to draw by a rule, or with a state, of your
    own.

    A sender has a state, by default an unused number, which is carried from message to message and
    on into
    the next episode. Draws come from the streams: those of other worlds, and of other agents, are
    different.

    Args:
        longest: longest delay [steps].
        loses: whether ``forward`` loses messages by a rule of its own; rewards may not be lost.
        loss: probability that a message is lost, whatever its delay, as ``lose`` draws it.
    """

    sees_context: bool = False
    """Whether a delay depends on the message's context."""
    reads: tuple[str, ...] = ()
    """Names of the entries that the context must contain."""
    same_draws_for_all_agents: bool = False
    """Whether all agents of a world draw the same numbers."""
    arrival_delay: int | None = None
    """The delay of every message that arrives [steps]; None if it varies."""

    def __init__(self, longest: int, loses: bool = True, loss: float = 0.0) -> None:
        super().__init__()
        checks.in_range("loss", loss, 0.0, 1.0)
        self.longest = longest
        self.loss = loss
        self.lost = longest + 1
        """Delay value that marks a message that never arrives."""
        self.loses = loses or loss > 0
        """Whether messages can be lost."""

    @property
    def constant_delay(self) -> int | None:
        """The delay [steps] if it is always the same and no message is lost, else None."""
        return None if self.loses else self.arrival_delay

    @property
    def late(self) -> bool:
        """Whether a message can be late or lost."""
        return self.constant_delay != 0

    def initial_state(self, streams: Tensor) -> Tensor:
        """The state of each sender before its first message [M, ...], from its random stream
        [M]."""
        return torch.zeros_like(streams)

    def begin_episode(self, state: Tensor, mask: Tensor) -> Tensor:
        """The states [M, ...] after a reset of the senders of the mask [M]."""
        return state

    @abstractmethod
    def forward(
        self, streams: Tensor, clock: Tensor, state: Tensor, context: Context = None
    ) -> Drawn:
        """Draw the delays of the messages sent at ``clock``, and the next states; pure."""

    def lose(self, delay: Tensor, streams: Tensor, clock: Tensor) -> Tensor:
        """The delays [M], of which a share ``loss`` is lost, by a draw of its own."""
        if not self.loss:
            return delay
        draw = counter_rng.uniform(streams, clock, _LOSS_DRAW)
        return torch.where(draw < self.loss, self.lost, delay)


class TableSampler(Sampler):
    """Draws delays from a table of probabilities.

    Args:
        states: for the one state of a sender, or a good and a bad one, the probabilities of the
            delays 0, 1,
            ... [steps]; if they sum to less than 1, the rest is the probability that the message is lost.
        transitions: probabilities of the transitions between two states per step, [2, 2]; None for
            one state.
        loss: probability that a message is lost, whatever its delay.
    """

    chances: Tensor
    """Probabilities of the delays 0, 1, ... and, last, of a loss, [S, longest + 2]."""
    _boundaries: Tensor

    def __init__(
        self,
        states: list[list[float]],
        transitions: list[list[float]] | None = None,
        loss: float = 0.0,
    ) -> None:
        given = [torch.tensor(chances, dtype=torch.float64) for chances in states]
        arrive = pad_sequence(given, batch_first=True) * (1 - loss)
        super().__init__(arrive.shape[1] - 1, loses=False, loss=loss)
        rest = 1 - arrive.sum(-1, keepdim=True)
        lost = rest.where(rest > _ROUNDING, 0.0)
        chances = torch.cat([arrive, lost], -1)
        self.register_buffer("chances", chances, persistent=False)
        self.loses = bool((lost > 0).any())
        likeliest = int(arrive[0].argmax())
        if (arrive[:, likeliest] == arrive.sum(-1)).all():
            self.arrival_delay = likeliest
        change = torch.tensor(transitions or [[1.0]], dtype=torch.float64)
        # The next state and the delay are one outcome, so that a message takes a single draw.
        joint = (change.unsqueeze(-1) * chances).flatten(1)
        upper = joint.cumsum(-1)[:, :-1]
        boundaries = (upper * 2**32).round().long()
        self.register_buffer("_boundaries", boundaries, persistent=False)
        self._bad_share = 0.0
        if transitions:
            worsens = change[0, 1]
            improves = change[1, 0]
            self._bad_share = (worsens / (worsens + improves)).item()

    def initial_state(self, streams: Tensor) -> Tensor:
        is_bad = counter_rng.uniform(streams) < self._bad_share
        return is_bad.long()

    def forward(
        self, streams: Tensor, clock: Tensor, state: Tensor, context: Context = None
    ) -> Drawn:
        if self.constant_delay is not None:
            return torch.full_like(streams, self.constant_delay), state
        draw = counter_rng.bits(streams, clock)
        if len(self.chances) == 1:
            return torch.bucketize(draw, self._boundaries[0], right=True), state
        below = self._boundaries[state]
        outcome = (draw.unsqueeze(-1) >= below).sum(-1)
        n = self.longest + 2
        return outcome % n, outcome // n


_ROUNDING = 1e-10
"""Probability below which a loss is a rounding error: draws have 32 bits."""


class Recorded(Sampler):
    """Plays back recorded delays [steps], -1 if lost, from a random one on; the state is the next
    one."""

    _delays: Tensor

    def __init__(self, delays: list[int], loss: float = 0.0) -> None:
        shortest = min(delays)
        super().__init__(max(*delays, 0), loses=shortest < 0, loss=loss)
        if shortest == self.longest:
            self.arrival_delay = self.longest
        codes = torch.tensor([self.lost if delay < 0 else delay for delay in delays])
        self.register_buffer("_delays", codes, persistent=False)

    def initial_state(self, streams: Tensor) -> Tensor:
        return counter_rng.bits(streams) % len(self._delays)

    def forward(
        self, streams: Tensor, clock: Tensor, state: Tensor, context: Context = None
    ) -> Drawn:
        delay = self._delays[state]
        if self.loss:
            draw = counter_rng.uniform(streams, clock)
            delay = torch.where(draw < self.loss, self.lost, delay)
        return delay, (state + 1) % len(self._delays)


class HeldSampler(Sampler):
    """Holds every message back until the longest delay of another sampler, which loses the same
    messages.

    Methods for constant delays then work with random ones.
    """

    def __init__(self, drawn: Sampler) -> None:
        super().__init__(drawn.longest, drawn.loses)
        self.drawn = drawn
        self.sees_context = drawn.sees_context
        self.reads = drawn.reads
        self.same_draws_for_all_agents = drawn.same_draws_for_all_agents
        self.arrival_delay = self.longest

    def initial_state(self, streams: Tensor) -> Tensor:
        return self.drawn.initial_state(streams)

    def begin_episode(self, state: Tensor, mask: Tensor) -> Tensor:
        return self.drawn.begin_episode(state, mask)

    def forward(
        self, streams: Tensor, clock: Tensor, state: Tensor, context: Context = None
    ) -> Drawn:
        delay, state = self.drawn(streams, clock, state, context)
        return torch.where(delay < self.lost, self.longest, self.lost), state


class LossSampler(HeldSampler):
    """Loses messages of another sampler with the probability that the entry ``loss`` of each world
    tells."""

    def __init__(self, drawn: Sampler) -> None:
        super().__init__(drawn)
        self.loses = True
        self.arrival_delay = drawn.arrival_delay
        self.sees_context = True
        self.reads = (*drawn.reads, "loss")

    def forward(
        self, streams: Tensor, clock: Tensor, state: Tensor, context: Context = None
    ) -> Drawn:
        delay, state = self.drawn(streams, clock, state, context)
        draw = counter_rng.uniform(streams, clock, _LOSS_DRAW)
        chance = cast(MessageContext, context).entries["loss"].view_as(draw)
        delay = torch.where(draw < chance, self.lost, delay)
        return delay, state


class LagSampler(Sampler):
    """Draws a delay (a lag) from a table, and holds it for a period (None: an episode); losses are
    not held.

    The state is [M, 2] long: the lag, -1 before the first message of an episode, and the number of
    steps that it is still held.
    """

    def __init__(self, law: Any, chances: list[float], loss: float, period: int | None) -> None:
        table = TableSampler([chances], loss=loss)
        arrives = sum(chances)
        loss = table.chances[0, -1].item()
        super().__init__(table.longest, loses=False, loss=loss)
        self.arrival_delay = table.arrival_delay
        lags = [chance / arrives for chance in chances] if arrives else [1.0]
        self._lags = TableSampler([lags])
        self._period = period or _NEVER
        self._hold_probability = law.hold_probability
        self.same_draws_for_all_agents = law.shared
        self._stagger = law.stagger

    def initial_state(self, streams: Tensor) -> Tensor:
        lag = torch.full_like(streams, -1)
        wait = torch.zeros_like(streams)
        return torch.stack([lag, wait], -1)

    def begin_episode(self, state: Tensor, mask: Tensor) -> Tensor:
        return where_rows(mask, self.initial_state(state[:, 0]), state)

    def forward(
        self, streams: Tensor, clock: Tensor, state: Tensor, context: Context = None
    ) -> Drawn:
        lag, wait = state.unbind(-1)
        first = lag < 0
        due = wait == 0
        renewed = due
        interval = torch.full_like(streams, self._period)
        if self._hold_probability:
            draw = counter_rng.uniform(streams, clock, _HOLD_DRAW)
            released = draw >= self._hold_probability
            renewed = first | (due & released)
        if self._stagger:
            phase = counter_rng.bits(streams, clock, _PHASE_DRAW) % self._period
            interval = torch.where(first, 1 + phase, interval)
        drawn, _ = self._lags(streams, clock, lag)
        lag = torch.where(renewed, drawn, lag)
        wait = torch.where(due, interval, wait) - 1
        state = torch.stack([lag, wait], -1)
        return self.lose(lag, streams, clock), state


_NEVER = 2**40
"""Steps that no episode lasts."""


class ContextSampler(Sampler):
    """Computes each delay from the context of the message, by a function.

    Args:
        delay_fn: pure function of a ``MessageContext``, without branches on data, that returns the
            delays [steps], [M]; they are rounded up and cut to ``longest``, and a message of
            negative delay is lost.
        longest: longest delay [steps].
        loss: probability that a message is lost, whatever its delay.
        loses: whether ``delay_fn`` can lose a message. With False, negative delays count as 0, as
            rewards need it.
        reads: names of the entries that ``delay_fn`` must get, such as ``position``; it gets all
            those for which the transform has a key.

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
    ) -> None:
        super().__init__(longest, loses, loss)
        self.sees_context = True
        self.reads = tuple(reads)
        self._delay_fn = delay_fn
        self._lost_if_negative = loses

    def forward(
        self, streams: Tensor, clock: Tensor, state: Tensor, context: Context = None
    ) -> Drawn:
        delay = self._delay_fn(cast(MessageContext, context)).view_as(streams)
        arrives = delay >= 0  # false for nan too
        steps = torch.where(arrives, delay, 0)
        if steps.dtype.is_floating_point:  # 21.000002 steps are 21
            steps = steps - 1e-5 * steps.clamp(1, self.longest)
        steps = steps.ceil().clamp(max=self.longest).long()
        if self._lost_if_negative:
            steps = torch.where(arrives, steps, self.lost)
        return self.lose(steps, streams, clock), state


class LinkSampler(Sampler):
    """Draws the delays of messages on the links between N agents, by a law and a loss for each
    link.

    Links are numbered receiver * N + sender; message m of the M of a step belongs to link m modulo
    N * N. Every distinct law has one sampler, which draws for all links. The states of all samplers
    lie side by side, [M, S].
    """

    _law_index: Tensor
    _loss: Tensor

    def __init__(self, samplers: Sequence[Sampler], law_index: Tensor, loss: Tensor) -> None:
        loses_on_links = bool((loss > 0).any())
        loses = loses_on_links or any(sampler.loses for sampler in samplers)
        super().__init__(max(sampler.longest for sampler in samplers), loses)
        self.n_agents = math.isqrt(len(law_index))
        self.samplers: Any = nn.ModuleList(samplers)
        self.sees_context = any(sampler.sees_context for sampler in samplers)
        reads = (name for sampler in samplers for name in sampler.reads)
        self.reads = tuple(dict.fromkeys(reads))
        self._loses_on_links = loses_on_links
        example = torch.zeros(1, dtype=torch.long)
        states = [sampler.initial_state(example)[0] for sampler in samplers]
        self._state_forms = [(state.numel(), state.shape, state.dtype) for state in states]
        self.register_buffer("_law_index", law_index, persistent=False)
        self.register_buffer("_loss", loss, persistent=False)

    def initial_state(self, streams: Tensor) -> Tensor:
        return _packed([sampler.initial_state(streams) for sampler in self.samplers])

    def begin_episode(self, state: Tensor, mask: Tensor) -> Tensor:
        pairs = zip(self.samplers, self._split(state), strict=True)
        return _packed([sampler.begin_episode(part, mask) for sampler, part in pairs])

    def forward(
        self, streams: Tensor, clock: Tensor, state: Tensor, context: Context = None
    ) -> Drawn:
        n_links = len(self._law_index)
        n_worlds = len(streams) // n_links
        delay = torch.zeros_like(streams)
        states = []
        index = self._law_index.repeat(n_worlds)
        pairs = zip(self.samplers, self._split(state), strict=True)
        for k, (sampler, part) in enumerate(pairs):
            own_streams = streams_for(sampler, streams, n_links)
            drawn, new_state = sampler(own_streams, clock, part, context)
            drawn = torch.where(drawn < sampler.lost, drawn, self.lost)
            delay = torch.where(index == k, drawn, delay)
            states.append(new_state)
        if self._loses_on_links:
            draw = counter_rng.uniform(streams, clock, _LINK_LOSS_DRAW)
            loss = self._loss.repeat(n_worlds)
            delay = torch.where(draw < loss, self.lost, delay)
        return delay, _packed(states)

    def _split(self, state: Tensor) -> list[Tensor]:
        """The state of each sampler, [M, ...]."""
        sizes = [size for size, _, _ in self._state_forms]
        parts = state.split(sizes, -1)
        states = []
        for part, (_, shape, dtype) in zip(parts, self._state_forms, strict=True):
            number = part.view(torch.double) if dtype.is_floating_point else part
            states.append(number.to(dtype).reshape(len(part), *shape))
        return states


def _packed(states: list[Tensor]) -> Tensor:
    """States [M, ...] side by side, [M, S] long; those that are floats keep their bits."""
    flat = [state.reshape(len(state), -1) for state in states]
    return torch.cat(
        [s.double().view(torch.long) if s.is_floating_point() else s.long() for s in flat], -1
    )


def streams_for(sampler: Sampler, streams: Tensor, n_rows: int) -> Tensor:
    """The random streams [M] from which a sampler draws: for ``n_rows`` rows of a world, maybe
    one."""
    if not sampler.same_draws_for_all_agents:
        return streams
    return streams.view(-1, n_rows)[:, :1].expand(-1, n_rows).reshape(-1)
