"""Settings of the delays of a scenario, of its links, of its cumulative rewards and of the action history."""

from dataclasses import dataclass, fields
from typing import Any

from damian import keys
from damian.common import checks
from damian.delays.laws import (
    LONGEST,
    LOSES,
    Held,
    Law,
    check_losses,
    is_matrix,
    law_of,
    same_size,
    sampler_of,
)
from damian.delays.line import ORDERS
from damian.delays.samplers import Sampler

CONTEXT_KEYS = {"position": keys.POSITION}
"""TensorDict keys of the entries that a delay law of a scenario may read, by the name in ``reads``."""


@dataclass
class DelayConfig:
    """Delays and how they are handled. A law is a number of steps, a time, or a mapping (``law_of``)."""

    obs: Any = 0
    """Delay of each UAV's messages to the server node (paper, section 3.4): steps such as 3, a time such as
    3s, or a law such as {law: uniform, low: 3s, high: 7s}; there are constant, uniform, geometric, burst,
    trace, lag and distance (docs/concepts.md has their parameters), and your own (docs/extending.md)."""
    act: Any = 0
    """Delay of each action (section 3.3), written as ``obs``; a UAV holds until the first one arrives."""
    rew: Any = 0
    """Delay of the rewards, written as ``obs``; the law must not lose any (section 3.5)."""
    loss: float = 0.0
    """Probability that a message to the server node is lost."""
    hold: str = "none"
    """``max``: the server holds every message back until the longest delay of ``obs`` has passed, so that the
    delay is constant."""
    order: str = "generation"
    """Which received message the server holds: the one generated last (``generation``; the age of information
    then grows by at most one step per step) or the one that arrived last (``arrival``)."""
    history: int = 0
    """Number of its own latest actions that a UAV observes (section 3.3)."""
    messages: int = 0
    """Number of latest steps whose messages a UAV gets beside its observation, as far as they have arrived
    (``MessageHistory``), for ``learner=predictive_mappo``."""
    reward_window: int = 1
    """Number of steps over which rewards are summed (eq. 4)."""
    reward_discount: float = 0.9
    """Discount factor gamma of that sum (eq. 4)."""

    def __post_init__(self) -> None:
        checks.convert_types("delay", self)
        checks.in_range("delay.loss", self.loss, 0.0, 1.0)
        checks.one_of("delay.hold", self.hold, ("none", "max"))
        checks.one_of("delay.order", self.order, ORDERS)
        checks.whole("delay.history", self.history, 0, 1000, "actions")
        checks.whole("delay.messages", self.messages, 0, 1000, "steps")
        checks.whole("delay.reward_window", self.reward_window, 1, LONGEST, "steps")
        checks.above("delay.reward_discount", self.reward_discount, 0.0)
        checks.in_range("delay.reward_discount", self.reward_discount, 0.0, 1.0)

        # Each law is parsed once here, and its sampler built once for each ``dt``, since many places ask.
        self._laws = {name: law_of(getattr(self, name), f"delay.{name}") for name in ("obs", "act", "rew")}
        if self.hold == "max":
            self._laws["obs"] = Held(self._laws["obs"])
        self._samplers: dict[tuple[str, float], Sampler] = {}

    def __getstate__(self) -> dict[str, Any]:
        """The settings alone, because a worker process finds classes outside the package by their paths."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.__post_init__()

    def law(self, name: str) -> Law:
        """The law of ``act``, of ``rew``, or of ``obs`` with ``hold`` applied."""
        return self._laws[name]

    def sampler(self, name: str, dt: float) -> Sampler:
        """The sampler of this law for steps of ``dt`` seconds, without the losses of ``loss``.

        Raises:
            InputError: a parameter of the law is invalid.
        """
        if (name, dt) not in self._samplers:
            self._samplers[name, dt] = sampler_of(self._laws[name], dt, key=f"delay.{name}")
        return self._samplers[name, dt]

    def reads(self, dt: float) -> set[str]:
        """Names of the entries that the laws read in the contexts of messages."""
        return {read for name in self._laws for read in self.sampler(name, dt).reads}

    def check(self, dt: float) -> None:
        """Check that every law is valid for steps of ``dt`` seconds.

        Raises:
            InputError: a law is invalid or reads what there is not, or the reward delay loses rewards.
        """
        for name in self._laws:
            for read in self.sampler(name, dt).reads:
                should = f"reads {read}, but a law can read only {', '.join(CONTEXT_KEYS)}"
                checks.require(read in CONTEXT_KEYS, f"delay.{name}", getattr(self, name), should)
        checks.require(not self.sampler("rew", dt).loses, "delay.rew", self.rew, LOSES)

    def settings_longer_than(self, n_steps: int, dt: float) -> list[str]:
        """Names of the settings whose delay is always at least ``n_steps``: in so many, nothing arrives."""
        shortest = {name: self.sampler(name, dt).constant_delay or 0 for name in self._laws}
        return [f"delay.{name}" for name, delay in shortest.items() if delay >= n_steps]


@dataclass
class LinkConfig:
    """How observations reach the UAVs. Rewards and the critic always follow from what the server holds."""

    kind: str = "server"
    """``server``: the server computes every UAV's observation and broadcasts it at once. ``updown``: this
    broadcast reaches each UAV by a delay and loss of its own. ``matrix``: UAVs send their messages to each
    other too, and each computes its observation from those that have reached it; it knows its own at once."""
    delay: Any = 0
    """Law of the delay from the server to a UAV (``updown``) or from a UAV to a UAV (``matrix``); with
    ``matrix`` also a list of laws for each receiver, with one for each sender."""
    loss: Any = 0.0
    """Probability that such a message is lost; with ``matrix`` also a list for each receiver."""
    range: float | None = None
    """With ``matrix``: a UAV hears only UAVs within this distance when they send [m]."""
    hears: Any = None
    """With ``matrix``: whom each UAV hears, a list of true and false (per sender) for each receiver."""
    limit: int | None = None
    """With ``matrix``: at most so many UAVs of a world send in a step; chance decides which."""

    def __post_init__(self) -> None:
        checks.convert_types("links", self)
        checks.one_of("links.kind", self.kind, ("server", "updown", "matrix"))
        meant = {"server": [], "updown": ["delay", "loss"]}.get(self.kind)
        for field in fields(self)[1:]:
            value = getattr(self, field.name)
            idle = meant is not None and field.name not in meant and value != field.default
            problem = f"means nothing with links={self.kind}"
            checks.require(not idle, f"links.{field.name}", value, problem)
        if self.kind == "updown":
            checks.in_range("links.loss", self.loss, 0.0, 1.0)
        check_losses("links.loss", self.loss)
        if self.range is not None:
            checks.above("links.range", self.range, 0.0, "m")
        if self.limit is not None:
            checks.whole("links.limit", self.limit, 1, 1000, "UAVs")
        should = "does not go with links.hears: leave out one of them"
        checks.require(self.range is None or self.hears is None, "links.range", self.range, should)

    def check(self, n_agents: int) -> None:
        """Check what is given for each pair of UAVs.

        Raises:
            InputError: there is not one entry for each receiver and sender, or ``hears`` is not of bools.
        """
        for name in ("delay", "loss", "hears"):
            n = same_size({f"links.{name}": getattr(self, name)})
            should = f"is not {n_agents} x {n_agents}, a list for each receiver with an entry for each sender"
            checks.require(n in (None, n_agents), f"links.{name}", f"{n} x {n}", should)
        hears = [] if self.hears is None else self.hears
        good = is_matrix(hears) and all(isinstance(each, bool) for row in hears for each in row)
        should = "is not a list of true and false for each receiver"
        checks.require(good, "links.hears", self.hears, should)

    def reads(self, dt: float) -> set[str]:
        """Names of the entries that the links read: what their laws do, and positions for a range."""
        written = {"links.delay": self.delay}
        if is_matrix(self.delay):
            rows = [enumerate(row) for row in self.delay]
            written = {f"links.delay[{i}][{j}]": law for i, row in enumerate(rows) for j, law in row}
        read = {name for key, law in written.items() for name in sampler_of(law, dt, key=key).reads}
        return read | ({"position"} if self.range is not None else set())
