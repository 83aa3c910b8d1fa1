"""Delay laws: probability distributions of message delays, in steps (``3``) or time (``"3s"``, ``"0.5m"``).

``Law.sampler`` turns a law into a table from which delays are drawn, with one hash and one search per
message, or into a function of the message's context (``ContextSampler``). The transforms that delay
observations, actions and rewards are in ``damian.transforms``.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from damian.common import checks
from damian.common.errors import InputError, naming_errors
from damian.common.registry import Registry
from damian.common.text_files import named, parse_table, read_text, show
from damian.delays.lag_sampler import LagSampler
from damian.delays.samplers import ContextSampler, HeldSampler, MessageContext, Recorded, Sampler
from damian.delays.times import LONGEST, Delay, check_dt, in_steps, seconds  # noqa: F401 (others import all of them here)

LOSES = "loses messages, but no reward may be lost"

LOST = "lost"
"""Entry of a trace for a message that never arrives."""


@dataclass(frozen=True)
class Law(ABC):
    """Distribution of message delays.

    A delay may depend on the circumstances under which the message is sent (``ContextSampler``).
    """

    @abstractmethod
    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        """Build the sampler that draws delays from this law.

        Args:
            dt: length of a step [s].
            loss: probability that a message is lost, whatever its delay.
            key: config key of the law, for error messages.

        Raises:
            InputError: a parameter of the law is invalid.
        """


def law_name(law: Law) -> str:
    """The path of a law's class, such as ``lab:Satellite``, for errors."""
    return f"{type(law).__module__}:{type(law).__qualname__}"


def sampler_of(law: Law, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
    """Build the sampler of a law, which may be one's own; the arguments are those of ``Law.sampler``.

    Raises:
        InputError: a parameter is invalid, or a law of one's own raises an error or returns no ``Sampler``.
    """
    check_dt(dt)
    name = f"law {law_name(law)}"
    with naming_errors(f"{key}: {name}"):
        sampler = law.sampler(dt, loss, key)
    problem = f"returns a {type(sampler).__name__} from sampler(dt, loss, key), not a Sampler"
    checks.require(isinstance(sampler, Sampler), key, name, problem)
    return sampler


def _is_no_law(found: Any) -> str | None:
    good = isinstance(found, type) and issubclass(found, Law) and is_dataclass(found)
    return None if good else "is no dataclass derived from damian.Law"


LAWS = Registry[type[Law]]("law", _is_no_law)
"""Laws by name; ``law_of`` also takes one's own as ``package.module:Class``."""


@LAWS.register("constant")
@dataclass(frozen=True)
class Constant(Law):
    """Every message has the same delay."""

    delay: Delay = 0

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        return Sampler([_certain(in_steps(key, self.delay, dt))], loss=loss)


@LAWS.register("uniform")
@dataclass(frozen=True)
class Uniform(Law):
    """With a probability, a uniform delay between ``low`` and ``high``; otherwise none (paper, section 5).

    Delays in steps are equally likely whole numbers, both ends included. Delays in time are continuous and
    rounded up to whole steps, so that 3 to 7 s are 4, 5, 6 or 7 steps of 1 s.
    """

    low: Delay = 0
    high: Delay = 0
    probability: float = 1.0

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        checks.in_range(f"{key}.probability", self.probability, 0.0, 1.0)
        low, high = in_steps(f"{key}.low", self.low, dt), in_steps(f"{key}.high", self.high, dt)
        in_time = isinstance(self.low, str), isinstance(self.high, str)
        first, last = low, high
        if all(in_time):
            first, last = seconds(f"{key}.low", self.low), seconds(f"{key}.high", self.high)
        problem = f"and high={self.high} are not two steps or two times in order"
        checks.require(first <= last and in_time[0] == in_time[1], f"{key}.low", self.low, problem)
        if all(in_time):
            chances = _rounded_up(first / dt, last / dt)
        else:
            chances = [float(low <= k) / (high - low + 1) for k in range(high + 1)]
        weighted = [self.probability * chance for chance in chances]
        return Sampler([[weighted[0] + 1 - self.probability, *weighted[1:]]], loss=loss)


@LAWS.register("geometric")
@dataclass(frozen=True)
class Geometric(Law):
    """A message arrives in each step with the same probability, as if it were retransmitted until received.

    Delays above ``longest`` are cut to ``longest``; ``mean`` is the mean before this cut.
    """

    mean: Delay = 1
    longest: Delay = 20

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        longest = in_steps(f"{key}.longest", self.longest, dt)
        mean = seconds(f"{key}.mean", self.mean) / dt if isinstance(self.mean, str) else self.mean
        checks.in_range(f"{key}.mean", mean, 0.0, unit="steps")
        failure = mean / (1 + mean)
        chances = [(1 - failure) * failure**k for k in range(longest)]
        return Sampler([[*chances, failure**longest]], loss=loss)


@LAWS.register("burst")
@dataclass(frozen=True)
class Burst(Law):
    """Gilbert-Elliott channel of each sender, a Markov chain of a good and a bad state (1960, 1963).

    ``Burst(enter, leave, good=0, bad=0, bad_loss=1)`` loses runs of messages, ``1 / leave`` in the mean.
    """

    enter: float = 0.05
    """Probability that a good channel turns bad, per step."""
    leave: float = 0.25
    """Probability that a bad channel turns good, per step."""
    good: Any = 0
    """Law of the delays while the channel is good; it must be memoryless."""
    bad: Any = 5
    """Law of the delays while the channel is bad; it must be memoryless."""
    good_loss: float = 0.0
    """Probability that a message is lost while the channel is good."""
    bad_loss: float = 0.5
    """Probability that a message is lost while the channel is bad."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        for name in ("enter", "leave", "good_loss", "bad_loss"):
            checks.in_range(f"{key}.{name}", getattr(self, name), 0.0, 1.0)
        checks.above(f"{key}.enter + leave", self.enter + self.leave, 0.0)
        states = []
        for name in ("good", "bad"):
            inner_loss = getattr(self, f"{name}_loss")
            states.append(_memoryless("burst", getattr(self, name), dt, inner_loss, f"{key}.{name}"))
        transitions = [[1 - self.enter, self.enter], [self.leave, 1 - self.leave]]
        return Sampler(states, transitions, loss)


@LAWS.register("trace")
@dataclass(frozen=True)
class Trace(Law):
    """Recorded delays of a file, one per step in its order; each sender starts at a random row.

    The file is a CSV table with a column ``delay``: steps, times with their unit, or ``lost``.
    """

    path: str = ""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        checks.require(bool(self.path), f"{key}.path", "it", "is missing: the file with the delays")
        with named(self.path):
            table = parse_table(read_text(Path(self.path)), ["delay"])
            delays = [self._read(row.cells["delay"], f"line {row.line}: delay", dt) for row in table]
            if not delays:
                raise InputError("line 2: there is no delay under the header")
        return Recorded(delays, loss)

    def _read(self, written: str, key: str, dt: float) -> int:
        return -1 if written == LOST else in_steps(key, _number(written), dt)


@LAWS.register("lag")
@dataclass(frozen=True)
class Lag(Law):
    """A sender draws a delay, the lag, from another law, and all its messages have it until the next draw.

    The first message of an episode always draws a lag. Losses (also those of the other law) are not held, but
    drawn for each message. When the lag shrinks, messages overtake each other.
    """

    lag: Any = 0
    """Law from which the lags are drawn; it must be memoryless."""
    update_period: Delay = 1
    """Time between two draws: steps, a time, or ``episode``: a lag is held until the end of the episode."""
    hold_probability: float = 0.0
    """Probability that an update keeps the lag instead of drawing another one."""
    shared: bool = False
    """All agents of a world have the same lags and losses."""
    stagger: bool = False
    """Each sender has its own time until its second draw, random and at most a period, so that senders do not
    all update in the same step."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        checks.in_range(f"{key}.hold_probability", self.hold_probability, 0.0, 1.0)
        for name in ("shared", "stagger"):
            checks.one_of(f"{key}.{name}", getattr(self, name), (True, False))
        period = self._period(dt, f"{key}.update_period")
        for name in ("hold_probability", "stagger"):
            problem = "has no effect with update_period=episode, which draws one lag per episode"
            value = getattr(self, name)
            checks.require(period is not None or not value, f"{key}.{name}", value, problem)
        chances = _memoryless("lag", self.lag, dt, 0.0, f"{key}.lag")
        return LagSampler(
            chances,
            loss,
            period=period,
            hold_probability=self.hold_probability,
            shared=self.shared,
            stagger=self.stagger,
        )

    def _period(self, dt: float, key: str) -> int | None:
        """Steps between two draws, None for a whole episode."""
        written = self.update_period
        if written == "episode":
            return None
        is_word = isinstance(written, str) and written[:1].isalpha()
        problem = "is neither whole steps such as 3, nor a time such as 3s, nor episode"
        checks.require(not is_word, key, written, problem)
        period = in_steps(key, written, dt)
        checks.require(period > 0, key, written, "is not above 0")
        return period


@LAWS.register("distance")
@dataclass(frozen=True)
class Distance(Law):
    """Delays and losses that grow with the distance d between sender and receiver.

    The delay is ``base + d / speed``. The path loss grows with log d, with log-normal shadowing, so that a
    message is received with probability Q(10 n log10(d / range) / sigma), where Q is the tail of the standard
    normal distribution (Rappaport, Wireless Communications, 2nd ed., 2002, section 4.9).

    The law reads the sender's ``position``, and ``receiver_position`` where it is given, [m], [M, 2].
    """

    base: Delay = 0
    """Delay at distance 0, of processing and transmission: steps, or a time."""
    speed: float = math.inf
    """Propagation speed [m/s]."""
    range: float = math.inf
    """Distance at which half of the messages are lost [m]."""
    path_loss_exponent: float = 2.0
    """Exponent n of the path loss; 2 in free space, 3 to 5 in cities."""
    shadowing: float = 6.0
    """Standard deviation sigma of the path loss around its mean [dB]; a small one makes the range sharp."""
    receiver: Any = (0.0, 0.0)
    """Place of the receiver, east and north [m], if messages have no ``receiver_position``."""
    longest: Delay = 20
    """Longest delay, to which longer ones are cut: steps, or a time."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        for name, unit in (("speed", "m/s"), ("range", "m")):
            value = getattr(self, name)
            above = isinstance(value, int | float) and value > 0  # infinity is allowed
            checks.require(above, f"{key}.{name}", f"{value} {unit}", f"is not above 0 {unit}")
        checks.above(f"{key}.path_loss_exponent", self.path_loss_exponent, 0.0)
        checks.above(f"{key}.shadowing", self.shadowing, 0.0, "dB")
        checks.place(f"{key}.receiver", self.receiver)
        longest = in_steps(f"{key}.longest", self.longest, dt)
        problem = f"is longer than longest={self.longest}"
        checks.require(in_steps(f"{key}.base", self.base, dt) <= longest, f"{key}.base", self.base, problem)
        base = seconds(f"{key}.base", self.base) / dt if isinstance(self.base, str) else self.base
        return ContextSampler(
            partial(self.delays, base),
            longest,
            loss,
            loses=math.isfinite(self.range),
            reads=["position"],
            optional_reads=["receiver_position"],
        )

    def delays(self, base: float, context: MessageContext) -> Tensor:
        """Delay of each of M messages [steps], [M], -1 if it is lost; ``base`` is in steps, too."""
        entries, position = context.entries, context.entries["position"]
        given = "receiver_position" in entries
        receiver = entries["receiver_position"] if given else position.new_tensor(self.receiver)
        distance = torch.linalg.vector_norm(position - receiver, dim=-1)
        steps = base + distance / (self.speed * context.dt)
        margin = 10 * self.path_loss_exponent * (self.range / distance).log10()  # [dB]
        loss = torch.special.erfc(margin / (self.shadowing * math.sqrt(2))) / 2
        return torch.where(context.uniform < loss, -1.0, steps)


@dataclass(frozen=True)
class Held(Law):
    """Every message is held until the longest delay of another law has passed, so that the delay is constant.

    It lets methods for constant delays work with random ones. The same messages are lost.
    """

    law: Law

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        return HeldSampler(sampler_of(self.law, dt, loss, key))


def law_of(written: Any, key: str = "delay") -> Law:
    """Convert a setting to a law: a law, steps, a time, or a mapping.

    ``{law: uniform, low: 3s, high: 7s}`` names a registered law and its settings; ``{law:
    my_lab.delays:Satellite, mean: 2s}`` one of one's own, a frozen dataclass derived from ``Law`` in a module
    that can be imported.

    Raises:
        InputError: the law or one of its parameters does not exist.
    """
    if isinstance(written, Law):
        return written
    if isinstance(written, str) and (written in LAWS or ":" in written):
        own = "a law of one's own" if ":" in written else "that law"
        raise InputError(f"{key}: {written} is no delay; {own} is written {{law: {written}}}")
    if not isinstance(written, Mapping):
        return Constant(_number(written))
    kind = written.get("law")
    law = LAWS.get(kind, f"{key}.law")
    values = {k: str(v) if k == "path" else _plain(v) for k, v in written.items() if k != "law"}
    names = [field.name for field in fields(law)]
    for name, value in values.items():
        problem = f"is no setting of the law {kind}, which has {', '.join(names) or 'none'}"
        checks.require(name in names, f"{key}.{name}", value, problem)
    with naming_errors(f"{key}: law {kind}"):
        return law(**values)


def _memoryless(user: str, written: Any, dt: float, loss: float, key: str) -> list[float]:
    """Probabilities of the delays 0, 1, ... of a law that another law, the user, draws from.

    Raises:
        InputError: it is no law, or one with memory or context.
    """
    inner = sampler_of(law_of(written, key), dt, loss, key)
    problem = f"depends on the context of the message, which a {user} does not know"
    checks.require(not inner.sees_context, key, show(written), problem)
    checks.require(inner.memoryless, key, show(written), "is not a memoryless law")
    return inner.chances[0].tolist()[:-1]


def _number(written: Any) -> Any:
    """Convert a string of digits to an int: Hydra and CSV files may pass whole steps as strings."""
    text = written.strip() if isinstance(written, str) else ""
    return int(text) if text.isdecimal() and len(text) < 10 else written


def _plain(written: Any) -> Any:
    """Convert the strings of digits in a setting, and any kind of list to a ``list``."""
    is_list = isinstance(written, Sequence) and not isinstance(written, str)
    return [_plain(value) for value in written] if is_list else _number(written)


def _certain(steps: int) -> list[float]:
    return [0.0] * steps + [1.0]


def _rounded_up(low: float, high: float) -> list[float]:
    """Probabilities of 0, 1, ... steps for a time uniform in [low, high] steps and rounded up."""
    last = math.ceil(high - 1e-9)
    if high - low < 1e-9:
        return _certain(last)
    return [max(0.0, min(k, high) - max(k - 1, low)) / (high - low) for k in range(last + 1)]
