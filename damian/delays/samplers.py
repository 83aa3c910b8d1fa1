"""Samplers that draw one delay per message, from a table or by a function of the message's context."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from damian.common import checks, counter_rng
from damian.common.errors import InputError
from damian.common.text_files import show


class MessageContext(NamedTuple):
    """Circumstances of M messages at the instant at which they are sent; nothing in it lies in the future.

    Fields: ``sender``, ``receiver`` and ``n_sending`` [M] long, ``time`` [s], [M], ``uniform`` [M] in [0, 1),
    ``dt`` [s], and ``entries``, a dict of what the law reads, such as ``position`` [m], [M, 2].
    """

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
    """Draws delays from a table of probabilities. Drawing is a pure function, so it can be compiled.

    Args:
        states: for each of S channel states, the probabilities of the delays 0, 1, ... [steps]; if they sum
            to less than 1, the rest is the probability that the message is lost.
        turns: transition probabilities between the channel states per step, [S, S]; one state if not given.
        loss: probability that a message is lost, whatever its delay.
    """

    sees_context: bool = False
    """Whether a delay depends on the message's context."""
    reads: tuple[str, ...] = ()
    """Names of the entries that the context must contain."""
    optional_reads: tuple[str, ...] = ()
    """Names of the entries that the context contains where the transform has a key for them."""
    shared: bool = False
    """Whether all agents of a world draw the same numbers."""
    chances: Tensor
    _boundaries: Tensor

    def __init__(
        self, states: list[list[float]], turns: list[list[float]] | None = None, loss: float = 0.0
    ) -> None:
        super().__init__()
        checks.in_range("loss", loss, 0.0, 1.0)
        self.longest = max(map(len, states)) - 1
        for chances in states:
            proper = sum(chances) <= 1 + 1e-6 and all(chance >= 0 for chance in chances)
            checks.require(
                proper, "chances of the delays", show(chances), "are not at least 0 and at most 1 in all"
            )
        arrive = torch.zeros(len(states), self.longest + 1, dtype=torch.float64)
        for row, chances in zip(arrive, states, strict=True):
            row[: len(chances)] = torch.tensor(chances, dtype=torch.float64) * (1 - loss)
        chances = torch.cat([arrive, (1 - arrive.sum(-1, keepdim=True)).clamp(min=0)], -1)
        self.register_buffer("chances", chances, persistent=False)
        turn = torch.tensor(turns or [[1.0]], dtype=torch.float64)
        joint = (turn.unsqueeze(-1) * chances.unsqueeze(0)).flatten(1)  # of next state and delay, one draw
        boundaries = (joint.cumsum(-1)[:, :-1] * 2**32).round().long()
        self.register_buffer("_boundaries", boundaries, persistent=False)
        self._bad_share = (turn[0, 1] / (turn[0, 1] + turn[1, 0])).item() if turns else 0.0
        likeliest = int(chances[0].argmax())
        self.certain = likeliest if bool((chances[:, likeliest] == 1).all()) else None
        """The delay [steps] if it is always the same, else None."""

    @property
    def lost(self) -> int:
        """Delay value that marks a message that never arrives: ``longest + 1``."""
        return self.longest + 1

    @property
    def loses(self) -> bool:
        """Whether messages can be lost."""
        return bool((self.chances[:, -1] > 1e-9).any())

    @property
    def memoryless(self) -> bool:
        """Whether all delays are drawn independently from the same table, by this class's ``forward``."""
        return len(self.chances) == 1 and type(self).forward is Sampler.forward

    def initial_state(self, streams: Tensor) -> Tensor:
        """Draw the initial state of each sender's channel [M, ...] from its random stream [M]."""
        return (counter_rng.uniform(streams) < self._bad_share).long()

    def begin_episode(self, memory: Tensor, mask: Tensor) -> Tensor:
        """The states [M, ...] of the channels before the first message of an episode.

        Args:
            memory: the states before, [M, ...].
            mask: senders of which an episode begins, [M] bool.
        """
        return memory

    def try_context(self, context: MessageContext) -> None:
        """Try what computes delays from contexts once, before the first step.

        Raises:
            InputError: it does not return a finite number of steps for each message.
        """

    def forward(
        self, streams: Tensor, clock: Tensor, memory: Tensor, context: MessageContext | None = None
    ) -> tuple[Tensor, Tensor]:
        """Draw the delays [M] of the messages sent at ``clock``, and the channels' next states [M, ...].

        Args:
            streams: random stream of each sender, [M].
            clock: step, [M] or a scalar.
            memory: state of each channel, [M, ...].
            context: circumstances of the messages; needed only if ``sees_context``.
        """
        if self.certain is not None:
            return torch.full_like(streams, self.certain), memory
        draw = counter_rng.bits(streams, clock)
        if len(self.chances) == 1:
            return torch.bucketize(draw, self._boundaries[0], right=True), memory
        outcome = (draw.unsqueeze(-1) >= self._boundaries[memory]).sum(-1)
        n = self.longest + 2
        return outcome % n, outcome // n


class Recorded(Sampler):
    """Plays back recorded delays; each sender starts at a random position, which is its channel state.

    Args:
        delays: recorded delays [steps], -1 for a lost message.
        loss: probability that a message is lost in addition.
    """

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
    """Gives every message the longest delay of another sampler; the same messages are lost.

    Args:
        drawn: the other sampler.
    """

    def __init__(self, drawn: Sampler) -> None:
        arrival_chances = (1 - drawn.chances[:, -1]).tolist()
        super().__init__([[0.0] * drawn.longest + [chance] for chance in arrival_chances])
        self.drawn = drawn
        self.sees_context, self.shared = drawn.sees_context, drawn.shared
        self.reads, self.optional_reads = drawn.reads, drawn.optional_reads
        self.certain = None if self.loses else self.longest

    @property
    def memoryless(self) -> bool:
        return self.drawn.memoryless

    def initial_state(self, streams: Tensor) -> Tensor:
        return self.drawn.initial_state(streams)

    def begin_episode(self, memory: Tensor, mask: Tensor) -> Tensor:
        return self.drawn.begin_episode(memory, mask)

    def try_context(self, context: MessageContext) -> None:
        self.drawn.try_context(context)

    def forward(
        self, streams: Tensor, clock: Tensor, memory: Tensor, context: MessageContext | None = None
    ) -> tuple[Tensor, Tensor]:
        delay, memory = self.drawn(streams, clock, memory, context)
        return torch.where(delay < self.lost, self.longest, self.lost), memory


class ContextSampler(Sampler):
    """Computes each delay from the context of the message, by a function of one's own.

    Args:
        delay_fn: pure function of a ``MessageContext`` that returns the delays [steps], [M]; they are rounded
            up and cut to ``longest``, and a message of negative delay is lost. So that rounding errors cost
            no step, 1e-5 steps (or of a longer delay, its share 1e-5) are taken from a delay that is a float
            before it is rounded up. A method of the law can be pickled, as worker processes need; it must
            have no branches on data.
        longest: longest delay [steps].
        loss: probability that a message is lost, whatever its delay.
        loses: whether ``delay_fn`` can lose a message. With False, negative delays count as 0, so that the
            sampler can delay rewards, none of which may be lost.
        reads: names of the entries that ``delay_fn`` reads, such as ``position``.
        optional_reads: names of the entries that it reads if the transform has a key for them.

    Raises:
        InputError: an argument is invalid.

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
        checks.whole("longest", longest, 0, unit="steps")
        for name, names in (("reads", reads), ("optional_reads", optional_reads)):
            checks.require(not isinstance(names, str), name, names, "is not a list of names")
        # The table holds the worst case, because the true chances depend on the contexts: it serves only to
        # tell the longest delay, and whether messages can be lost.
        super().__init__([[0.0] * longest + [float(not loses)]], loss=loss)
        self.certain = None
        self.sees_context, self.reads, self.optional_reads = True, tuple(reads), tuple(optional_reads)
        self._delay_fn, self._loss, self._loses = delay_fn, loss, loses

    def forward(
        self, streams: Tensor, clock: Tensor, memory: Tensor, context: MessageContext | None = None
    ) -> tuple[Tensor, Tensor]:
        if context is None:
            raise ValueError("context: it is missing, but the delays of a ContextSampler depend on it")
        delay = self._delay_fn(context)
        self._check(delay, streams.shape)
        arrives = delay >= 0  # false for nan too
        steps = torch.where(arrives, delay, 0)
        if steps.dtype.is_floating_point:  # 21.000002 steps are 21
            steps = steps - 1e-5 * steps.clamp(1, self.longest)
        steps = steps.ceil().clamp(max=self.longest).long()
        if self._loses:
            steps = torch.where(arrives, steps, self.lost)
        if self._loss:  # by a draw that is independent of ``context.uniform``
            draw = counter_rng.uniform(streams, clock, torch.zeros_like(clock))
            steps = torch.where(draw < self._loss, self.lost, steps)
        return steps, memory

    def try_context(self, context: MessageContext) -> None:
        delay = self._delay_fn(context)
        self._check(delay, context.sender.shape)
        bad = delay[~delay.isfinite()].tolist()
        problem = "is not a finite number of steps; a negative one means that the message is lost"
        checks.require(not bad, self._name, bad[:1], problem)

    @property
    def _name(self) -> str:
        """Name of the function."""
        return getattr(self._delay_fn, "__qualname__", type(self._delay_fn).__name__)

    def _check(self, delay: Any, shape: torch.Size) -> None:
        """Require a number of steps for each message."""
        found = type(delay).__name__
        if isinstance(delay, Tensor):
            if delay.shape == shape and delay.dtype != torch.bool:
                return
            found = f"a tensor of {delay.dtype} and shape {tuple(delay.shape)}"
        raise InputError(
            f"{self._name}: {found} is not one number of steps per message, shape {tuple(shape)}"
        )
