"""Settings of what is late, and when: delays, links and clocks."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from damian.common import checks
from damian.settings.fields import Settings, constant, setting

LONGEST = 10_000
"""Longest delay allowed [steps], because every message in transit takes memory."""


@dataclass
class DelayConfig(Settings):
    """Delays and how they are handled. A law is a number of steps, a time, or a mapping (``law_of``)."""

    section: ClassVar[str] = "delay"

    obs: Any = setting(
        0,
        "Delay of each UAV's messages to the server node (paper, section 3.4): steps such as 3, a time "
        "such as 3s, or a law such as {law: uniform, low: 3s, high: 7s}; there are constant, uniform, "
        "geometric, burst, trace, lag and distance (docs/concepts.md has their parameters), and your own "
        "(docs/extending.md).",
    )
    act: Any = setting(
        0,
        "Delay of each action (section 3.3), written as ``obs``; a UAV holds until the first one arrives.",
    )
    rew: Any = setting(
        0,
        "Delay of the rewards, written as ``obs``; the law must not lose any (section 3.5).",
    )
    loss: float = setting(0.0, "Probability that a message to the server node is lost.", low=0, high=1)
    hold: str = setting(
        "none",
        "``max``: the server holds every message back until the longest delay of ``obs`` has passed, so "
        "that the delay is constant.",
        choices=("none", "max"),
    )
    order: str = setting(
        "generation",
        "Which received message the server holds: the one generated last (``generation``; the age of "
        "information then grows by at most one step per step) or the one that arrived last (``arrival``).",
        choices=("generation", "arrival"),
    )
    history: int = setting(
        0,
        "Number of its own latest actions that a UAV observes (section 3.3).",
        low=0,
        high=1000,
        unit="actions",
    )
    messages: int = setting(
        0,
        "Number of latest steps whose messages a UAV gets beside its observation, as far as they have "
        "arrived (``MessageHistory``), for ``learner=predictive_mappo``.",
        low=0,
        high=1000,
        unit="steps",
    )
    reward_window: int = setting(
        1, "Number of steps over which rewards are summed (eq. 4).", low=1, high=LONGEST, unit="steps"
    )
    reward_discount: float = setting(0.9, "Discount factor gamma of that sum (eq. 4).", above=0, high=1)


@dataclass
class LinkConfig(Settings):
    """How observations reach the UAVs. Rewards and the critic always follow from what the server holds."""

    section: ClassVar[str] = "links"

    kind: str = setting(
        "server",
        "``server``: the server computes every UAV's observation and broadcasts it at once. ``updown``: "
        "this broadcast reaches each UAV by a delay and loss of its own. ``matrix``: UAVs send their "
        "messages to each other too, and each computes its observation from those that have reached it; "
        "it knows its own at once.",
        choices=("server", "updown", "matrix"),
    )
    delay: Any = setting(
        0,
        "Law of the delay from the server to a UAV (``updown``) or from a UAV to a UAV (``matrix``); with "
        "``matrix`` also a list of laws for each receiver, with one for each sender.",
        kinds=("updown", "matrix"),
    )
    loss: Any = setting(
        0.0,
        "Probability that such a message is lost; with ``matrix`` also a list for each receiver.",
        kinds=("updown", "matrix"),
    )
    range: float | None = setting(
        None,
        "With ``matrix``: a UAV hears only UAVs within this distance when they send [m].",
        above=0,
        unit="m",
        kinds=("matrix",),
    )
    hears: Any = setting(
        None,
        "With ``matrix``: whom each UAV hears, a list of true and false (per sender) for each receiver.",
        kinds=("matrix",),
    )
    limit: int | None = setting(
        None,
        "With ``matrix``: at most so many UAVs of a world send in a step; chance decides which.",
        low=1,
        high=1000,
        unit="UAVs",
        kinds=("matrix",),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse_unread()
        if self.kind == "updown" or not is_matrix(self.loss):
            checks.in_range("links.loss", self.loss, 0.0, 1.0)
        problem = "does not go with links.hears: leave out one of them"
        checks.require(self.range is None or self.hears is None, "links.range", self.range, problem)

    def check(self, n_agents: int) -> None:
        """Check what is given for each pair of UAVs.

        Raises:
            InputError: there is not one entry for each receiver and sender, a loss is no probability, or
                ``hears`` is not of bools.
        """
        bools = "is not a list of true and false for each receiver"
        for name in ("delay", "loss", "hears"):
            matrix = getattr(self, name)
            if not is_matrix(matrix):
                checks.require(name != "hears" or matrix is None, "links.hears", matrix, bools)
                continue
            good = len(matrix) == n_agents and all(is_matrix(row) and len(row) == n_agents for row in matrix)
            problem = f"is not {n_agents} lists (receivers) of {n_agents} entries (senders)"
            checks.require(good, f"links.{name}", "it", problem)
            for i, j in itertools.product(range(n_agents), range(n_agents)):
                if name == "loss":
                    checks.in_range(f"links.loss[{i}][{j}]", matrix[i][j], 0.0, 1.0)
                good = name != "hears" or isinstance(matrix[i][j], bool)
                checks.require(good, f"links.hears[{i}][{j}]", matrix[i][j], bools)


def is_matrix(written: Any) -> bool:
    """Is a setting of the links given for each pair of UAVs?"""
    return isinstance(written, Sequence) and not isinstance(written, str)


@dataclass
class ClockConfig(Settings):
    """Periods of the clocks, such as ``1s``, ``0.5m`` or ``1h``."""

    section: ClassVar[str] = "clock"

    simulation: str = setting(
        "1s",
        "Length of a simulation step, ``dt``.",
    )
    agents: str | None = setting(
        None,
        "Period at which an agent observes and decides; that of the simulation if not given.",
    )
    server: str | None = setting(
        None,
        "Period at which the server node broadcasts observations; that of the simulation if not given.",
    )
    system: str | None = setting(
        None,
        "Period at which the learner receives a batch of steps; ``learner.steps`` if not given.",
    )
    trigger: str | None = setting(
        None,
        "Change of the system clock's period at each tick: the period shrinks if, in half of the worlds "
        "or more, a UAV spots the source, and grows otherwise. The period is fixed if this is not given.",
    )
    shortest: str | None = setting(
        None,
        "Shortest period of a triggered system clock; ``trigger`` if not given.",
    )
    longest: str | None = setting(
        None,
        "Longest period of a triggered system clock; twice its first period if not given.",
    )
    skip: bool = setting(
        False,
        "Let a step of the environment last until some UAV of its world can choose again, or the episode "
        "ends; ``duration`` counts the simulation steps that it lasted (``SkipUntilReady``). A training "
        "log then counts these longer steps and frames, and its returns are discounted within each step. "
        "The learner gets a batch every ``system`` / ``simulation`` of these longer steps.",
    )
    skip_discount: float = constant(
        1.0,
        "Discount per simulation step of the rewards within a step that ``skip`` makes longer. A training "
        "sets it to ``learner.gamma``.",
        low=0,
        high=1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        fast, triggered = ("simulation", "agents", "server"), ("trigger", "shortest", "longest")
        for slower, faster in itertools.permutations((*fast, "system"), 2):
            if self._seconds(slower) >= self._seconds(faster) or faster == "simulation":
                self._check_multiple(slower, faster)
        given = [name for name in triggered if getattr(self, name) is not None]
        for name, faster in itertools.product(given, fast):
            checks.seconds(f"clock.{name}", getattr(self, name))
            self._check_multiple(name, faster)
        checks.in_range("clock.simulation", self.dt, 1e-3, 86_400, "s")  # a millisecond to a day
        problem = "means nothing without clock.skip=true"
        checks.require(
            self.skip or self.skip_discount == 1, "clock.skip_discount", self.skip_discount, problem
        )
        problem = "means nothing without clock.trigger: the system clock is fixed"
        unused = given[0] if given and self.trigger is None else None
        checks.require(unused is None, f"clock.{unused}", getattr(self, unused or "trigger"), problem)

    def _check_multiple(self, slow: str, fast: str) -> None:
        ratio = self._seconds(slow) / self._seconds(fast)
        whole = math.isclose(ratio, max(round(ratio), 1), rel_tol=1e-9)
        problem = f"is not a multiple of clock.{fast}={self._period(fast)}"
        checks.require(whole, f"clock.{slow}", self._period(slow), problem)

    def _period(self, name: str) -> str:
        return getattr(self, name) or self.simulation

    def _seconds(self, name: str) -> float:
        return checks.seconds(f"clock.{name}", self._period(name))

    @property
    def dt(self) -> float:
        """Length of a simulation step [s]."""
        return self._seconds("simulation")

    def steps(self, name: str) -> int:
        """Period of the clock of this name [simulation steps]."""
        return round(self._seconds(name) / self.dt)
