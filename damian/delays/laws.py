"""Delay laws: distributions of message delays, in steps (``3``) or as a time
(``"3s"``, ``"133ms"``)."""

import copy
import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from damian.common import checks
from damian.common.errors import InputError
from damian.common.fields import chance, metres, rules, setting
from damian.common.registry import Registry
from damian.common.text_files import data_file, named, parse_table, read_text
from damian.delays.config import LONGEST, is_matrix
from damian.delays.samplers import (
    ContextSampler,
    LagSampler,
    LinkSampler,
    MessageContext,
    Recorded,
    Sampler,
    TableSampler,
)

Delay = int | str
"""Whole steps (``3``), or a time with its unit (``"3s"``)."""

LOSES = "loses messages, but no reward may be lost"
LONGEST_OF_FUNCTION = 20
"""Delay to which those of a function are cut [steps]; a ``ContextSampler`` may have another one."""

LOST = "lost"
"""Entry of a trace for a message that never arrives."""


@dataclass(frozen=True)
class Law(ABC):
    """Distribution of message delays; bounds of its parameters may stand in its fields
    (``setting``)."""

    @abstractmethod
    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        """Build the sampler of this law, for steps of ``dt`` seconds; ``key`` names the law in
        errors.

        It is a ``TableSampler``, a ``ContextSampler``, or one derived from ``Sampler`` that may
        have a state of its own (docs/extending.md). A share ``loss`` of the messages is lost,
        whatever the law.
        """


def sampler_of(written: Any, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
    """Build the sampler of a law, a range, a function, or of what ``law_of`` takes.

    The arguments are those of ``Law.sampler``. A range of steps (``1..7``) or of times, each
    rounded up to whole steps (``3s..7s``), is uniform over these steps. A function is that of a
    ``ContextSampler`` that
    loses nothing. A sampler is copied: transforms share none, because each may move to a device of
    its own.
    """
    checks.above("dt", dt, 0.0, "s")
    if isinstance(written, Sampler):
        checks.require(
            loss == 0, "loss", loss, "does not go with a sampler, which has the losses of its own"
        )
        return copy.deepcopy(written)
    if callable(written) and not isinstance(written, type):
        return ContextSampler(cast(Any, written), LONGEST_OF_FUNCTION, loss, loses=False)
    if isinstance(written, str) and ".." in written:
        ends = [_number(each) for each in written.split("..", 1)]
        low, high = (in_steps(key, each, dt, _NO_DELAY) for each in ends)
        alike = isinstance(ends[0], str) == isinstance(ends[1], str)
        checks.require(
            alike and low <= high,
            key,
            written,
            "is not a range of two numbers of steps (1..7) or two times (3s..7s) in order",
        )
        written = Uniform(low, high)
    law = law_of(written, key)
    for name, rule in rules(type(law)).items():
        value = getattr(law, name)
        if rule.above is not None and value != math.inf:  # an infinite speed or range is meant so
            checks.above(f"{key}.{name}", value, rule.above, rule.unit)
        if rule.low is not None:
            checks.in_range(f"{key}.{name}", value, rule.low, rule.high, rule.unit)
    sampler = law.sampler(dt, loss, key)
    checks.require(
        sampler.loses or loss == 0,
        key,
        type(law).__name__,
        f"loses no message, but loss={loss}: its sampler has to lose that share",
    )
    return sampler


_NO_STEPS = "is neither a number of steps >= 0 (3) nor a time (3s, 2min)"
_NO_DELAY = (
    "is not a delay, which is a number of steps >= 0 (3), a time (3s, 2min), a range (1..7, "
    "3s..7s), a distribution ({law: geometric, mean: 2}; in Python Geometric(2)) or a function"
)


def in_steps(key: str, delay: Delay, dt: float, problem: str = _NO_STEPS) -> int:
    """Convert a delay to whole steps of ``dt`` seconds; a time is rounded up."""
    if isinstance(delay, str):
        checks.require(delay.endswith(tuple(checks.UNITS_OF_TIME)), key, delay, problem)
        steps = math.ceil(_exact_steps(key, delay, dt) - 1e-9)
    else:
        is_steps = (
            isinstance(delay, Real)
            and not isinstance(delay, bool)
            and delay >= 0
            and delay % 1 == 0
        )
        checks.require(is_steps, key, delay, problem)
        steps = int(delay)
    checks.require(steps <= LONGEST, key, delay, f"is more than {LONGEST} steps")
    return steps


def _exact_steps(key: str, delay: Any, dt: float) -> float:
    """Convert a delay to steps of ``dt`` seconds, whole or not; a time may be zero (``0s``)."""
    return checks.seconds(key, delay, zero=True) / dt if isinstance(delay, str) else delay


LAWS = Registry[type[Law]](
    "law",
    lambda found: isinstance(found, type) and issubclass(found, Law) and is_dataclass(found),
    "is not a dataclass derived from damian.Law",
)
"""Laws by name; ``law_of`` also takes the path of a class outside the package,
``package.module:Class``."""


@LAWS.register("constant")
@dataclass(frozen=True)
class Constant(Law):
    """Every message has the same delay."""

    delay: Delay = 0
    """Delay: steps, or a time."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        return TableSampler([[0.0] * in_steps(key, self.delay, dt, _NO_DELAY) + [1.0]], loss=loss)


@LAWS.register("uniform")
@dataclass(frozen=True)
class Uniform(Law):
    """With a probability, a uniform delay between ``low`` and ``high``; otherwise none
    (paper, section 5).

    Delays in steps are equally likely whole numbers, both ends included. Delays in time are
    continuous and rounded up to whole steps, so that 3 to 7 s are 4, 5, 6 or 7 steps of 1 s.
    """

    low: Delay = 0
    """Shortest delay: steps, or a time."""
    high: Delay = 0
    """Longest delay, written as ``low`` is."""
    probability: float = chance(1.0)
    """Probability that a message is late at all."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        for name in ("low", "high"):
            in_steps(f"{key}.{name}", getattr(self, name), dt)  # refuses what is not a delay
        low = _exact_steps(f"{key}.low", self.low, dt)
        high = _exact_steps(f"{key}.high", self.high, dt)
        in_time = isinstance(self.low, str), isinstance(self.high, str)
        checks.require(
            low <= high and in_time[0] == in_time[1],
            f"{key}.low",
            self.low,
            f"and high={self.high} are not two steps or two times in order",
        )
        if all(in_time):
            chances = _rounded_up(low, high)
        else:
            chances = [float(low <= k) / (high - low + 1) for k in range(int(high) + 1)]
        weighted = [self.probability * chance for chance in chances]
        return TableSampler([[weighted[0] + 1 - self.probability, *weighted[1:]]], loss=loss)


@LAWS.register("geometric")
@dataclass(frozen=True)
class Geometric(Law):
    """A message arrives in each step with the same probability, as if retransmitted until
    received."""

    mean: Delay = 1
    """Mean delay before the cut at ``longest``: steps, which may be a fraction, or a time."""
    longest: Delay = 20
    """Longest delay, to which longer ones are cut: steps, or a time."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        longest = in_steps(f"{key}.longest", self.longest, dt)
        mean = _exact_steps(f"{key}.mean", self.mean, dt)
        checks.in_range(f"{key}.mean", mean, 0.0, unit="steps")
        failure = mean / (1 + mean)
        chances = [(1 - failure) * failure**k for k in range(longest)]
        return TableSampler([[*chances, failure**longest]], loss=loss)


@LAWS.register("burst")
@dataclass(frozen=True)
class Burst(Law):
    """Gilbert-Elliott channel of each sender, a Markov chain of a good and a bad state
    (1960, 1963).

    ``Burst(enter, leave, good=0, bad=0, bad_loss=1)`` loses runs of messages, ``1 / leave`` in the
    mean.

    A worked timeline of ``Burst(good=0, bad=3, bad_loss=0)``, whose channel is bad at t = 0 and t =
    1 and good from t = 2 on: messages sent at t = 0, 1 and 2 arrive at t = 3, 4 and 2.
    """

    enter: float = chance(0.05)
    """Probability that a good channel turns bad, per step."""
    leave: float = chance(0.25)
    """Probability that a bad channel turns good, per step."""
    good: Any = 0
    """Law of the delays while the channel is good; it must be memoryless."""
    bad: Any = 5
    """Law of the delays while the channel is bad; it must be memoryless."""
    good_loss: float = chance(0.0)
    """Probability that a message is lost while the channel is good."""
    bad_loss: float = chance(0.5)
    """Probability that a message is lost while the channel is bad."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        checks.above(f"{key}.enter + leave", self.enter + self.leave, 0.0)
        good = _memoryless(self.good, dt, self.good_loss, f"{key}.good")
        bad = _memoryless(self.bad, dt, self.bad_loss, f"{key}.bad")
        transitions = [[1 - self.enter, self.enter], [self.leave, 1 - self.leave]]
        return TableSampler([good, bad], transitions, loss)


@LAWS.register("trace")
@dataclass(frozen=True)
class Trace(Law):
    """Recorded delays of a file, one per step in its order; each sender starts at a random row."""

    path: str = ""
    """CSV table with a column ``delay``: steps, times with their unit, or ``lost``. That of the
    package is ``damian:queue_trace.csv``."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        checks.require(bool(self.path), f"{key}.path", "it", "is missing: the file with the delays")
        file = Path(data_file(str(self.path), f"{key}.path"))
        with named(str(self.path)):
            rows = parse_table(read_text(file), ["delay"])
            checks.require(bool(rows), "delay", "the column", "is empty")
            written = {f"line {row.line}: delay": row.cells["delay"] for row in rows}
            delays = [
                -1 if d == LOST else in_steps(at, _number(d), dt) for at, d in written.items()
            ]
        return Recorded(delays, loss)


@LAWS.register("lag")
@dataclass(frozen=True)
class Lag(Law):
    """A sender draws a delay, the lag, from another law, and all its messages have it until the
    next draw.

    The first message of an episode always draws a lag. Losses (also those of the other law) are not
    held, but drawn for each message. When the lag shrinks, messages overtake each other.

    A worked timeline of ``Lag(Uniform(0, 3), update_period=2)``: at t = 0 a sender draws 3, so that
    messages sent at t = 0 and t = 1 arrive at t = 3 and t = 4. At t = 2 it draws 0: that message
    arrives at once.
    """

    lag: Any = 0
    """Law from which the lags are drawn; it must be memoryless."""
    update_period: Delay = 1
    """Time between two draws: steps, a time, or ``episode``: a lag is held until the end of the
    episode."""
    hold_probability: float = chance(0.0)
    """Probability that an update keeps the lag instead of drawing another one."""
    shared: bool = False
    """All agents of a world have the same lags and losses."""
    stagger: bool = False
    """Each sender has its own time until its second draw, random and at most a period."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        period = None
        draws_again = bool(self.hold_probability) or self.stagger
        if self.update_period == "episode":
            checks.require(
                not draws_again,
                f"{key}.update_period",
                "episode",
                "draws one lag: hold_probability and stagger have no effect",
            )
        else:
            period = in_steps(f"{key}.update_period", self.update_period, dt)
            checks.require(
                period > 0,
                f"{key}.update_period",
                self.update_period,
                "is not above 0; or write episode",
            )
        lags = _memoryless(self.lag, dt, 0.0, f"{key}.lag")
        return LagSampler(self, lags, loss, period)


@LAWS.register("distance")
@dataclass(frozen=True)
class Distance(Law):
    """Delays and losses that grow with the distance d between sender and receiver.

    The delay is ``base + d / speed``. The path loss grows with log d, with log-normal shadowing, so
    that a message is received with probability Q(10 n log10(d / range) / sigma), where Q is the
    tail of the standard normal distribution (Rappaport, Wireless Communications, 2nd ed., 2002,
    section 4.9).

    The law reads the sender's ``position``, and ``receiver_position`` where it is given, [m],
    [M, 2].
    """

    base: Delay = 0
    """Delay at distance 0, of processing and transmission: steps, or a time."""
    speed: float = setting(math.inf, above=0, unit="m/s")
    """Propagation speed [m/s]."""
    range: float = metres(math.inf)
    """Distance at which half of the messages are lost [m]."""
    path_loss_exponent: float = setting(2.0, above=0)
    """Exponent n of the path loss; 2 in free space, 3 to 5 in cities."""
    shadowing: float = setting(6.0, above=0, unit="dB")
    """Standard deviation sigma of the path loss around its mean [dB]; a small one makes the range
    sharp."""
    receiver: Any = (0.0, 0.0)
    """Place of the receiver, east and north [m], if messages have no ``receiver_position``."""
    longest: Delay = 20
    """Longest delay, to which longer ones are cut: steps, or a time."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        checks.place(f"{key}.receiver", self.receiver)
        longest = in_steps(f"{key}.longest", self.longest, dt)
        in_steps(f"{key}.base", self.base, dt)  # refuses what is not a delay
        base = _exact_steps(f"{key}.base", self.base, dt)
        loses = math.isfinite(self.range)
        compute = partial(self.delays, base)
        return ContextSampler(compute, longest, loss, loses=loses, reads=["position"])

    def delays(self, base: float, context: MessageContext) -> Tensor:
        """Delay of each of M messages [steps], [M], -1 if it is lost; ``base`` is in steps, too."""
        entries = context.entries
        position = context.entries["position"]
        given = "receiver_position" in entries
        receiver = entries["receiver_position"] if given else position.new_tensor(self.receiver)
        distance = torch.linalg.vector_norm(position - receiver, dim=-1)
        steps = base + distance / (self.speed * context.dt)
        margin = 10 * self.path_loss_exponent * (self.range / distance).log10()  # [dB]
        loss = torch.special.erfc(margin / (self.shadowing * math.sqrt(2))) / 2
        return torch.where(context.uniform < loss, -1.0, steps)


def law_of(written: Any, key: str = "delay") -> Law:
    """Convert a setting to a law: a law, steps, a time, or a mapping.

    ``{law: uniform, low: 3s, high: 7s}`` names a registered law and its settings; ``{law:
    my_lab.delays:Satellite, mean: 2s}`` a frozen dataclass derived from ``Law`` in a module that
    can be imported.
    """
    if isinstance(written, Law):
        return written
    if isinstance(written, str) and (written in LAWS or ":" in written):
        raise InputError(f"{key}: {written} is not a delay; that law is written {{law: {written}}}")
    if not isinstance(written, Mapping):
        return Constant(_number(written))
    kind = written.get("law")
    law = LAWS.get(kind, f"{key}.law")
    values = {name: _number(value) for name, value in written.items() if name != "law"}
    names = [field.name for field in fields(law)]
    for name, value in values.items():
        checks.require(
            name in names,
            f"{key}.{name}",
            value,
            f"is not a setting of the law {kind}, which has {', '.join(names) or 'none'}",
        )
    return law(**values)


def _memoryless(written: Any, dt: float, loss: float, key: str) -> list[float]:
    """Probabilities of the delays 0, 1, ... of a law from which another law draws."""
    inner = sampler_of(written, dt, loss, key)
    if not isinstance(inner, TableSampler) or len(inner.chances) > 1:
        raise InputError(f"{key}: {written} is not a memoryless law")
    return inner.chances[0].tolist()[:-1]


def _number(written: Any) -> Any:
    """Convert a string of digits to an int: Hydra and CSV files may pass whole steps as strings."""
    return int(written) if isinstance(written, str) and written.strip().isdecimal() else written


def _rounded_up(low: float, high: float) -> list[float]:
    """Probabilities of 0, 1, ... steps for a time uniform in [low, high] steps and rounded up."""
    last = math.ceil(high - 1e-9)
    if high - low < 1e-9:
        return [0.0] * last + [1.0]
    return [max(0.0, min(k, high) - max(k - 1, low)) / (high - low) for k in range(last + 1)]


# Links between N agents, each with a law and a loss.


def link_sampler(delay: Any, loss: Any, dt: float = 1.0, key: str = "delay") -> Sampler:
    """Build the sampler of one law for all links, or of N x N nested lists of laws or losses.

    ``delay[receiver][sender]`` is the law of a link; the diagonal is not used.
    """
    loss_key = f"{key.removesuffix('delay')}loss"
    matrices = {
        name: each for name, each in {key: delay, loss_key: loss}.items() if is_matrix(each)
    }
    if not matrices or isinstance(delay, Sampler):
        return sampler_of(delay, dt, loss, key)
    n = len(next(iter(matrices.values())))
    for name, matrix in matrices.items():
        good = [len(row) if is_matrix(row) else 0 for row in matrix] == [n] * n
        checks.require(
            good,
            name,
            matrix,
            f"is not N x N, {n} x {n}: a list for each receiver, with an entry for each sender",
        )
    distinct: list = []
    samplers: list[Sampler] = []
    index = []
    for i, j in itertools.product(range(n), range(n)):
        law = delay
        name = key
        if is_matrix(delay):
            law = 0 if i == j else delay[i][j]
            name = f"{key}[{i}][{j}]"
        if law not in distinct:
            distinct.append(law)
            samplers.append(sampler_of(law, dt, key=name))
        index.append(distinct.index(law))
    losses = torch.as_tensor(loss, dtype=torch.float64).expand(n, n)
    for probability in losses.flatten().tolist():
        checks.in_range(loss_key, probability, 0.0, 1.0)
    return LinkSampler(samplers, torch.tensor(index), losses.flatten().clone())
