"""Periods of the four clocks: simulation, agents, server node and learner (paper, section 3.6)."""

import itertools
import math
from dataclasses import dataclass

from damian.common import checks


@dataclass
class ClockConfig:
    """Periods of the clocks, such as ``1s``, ``0.5m`` or ``1h``."""

    simulation: str = "1s"
    """Length of a simulation step, ``dt``."""
    agents: str | None = None
    """Period at which an agent observes and decides; that of the simulation if not given."""
    server: str | None = None
    """Period at which the server node broadcasts observations; that of the simulation if not given."""
    system: str | None = None
    """Period at which the learner receives a batch of steps; ``learner.steps`` if not given."""
    trigger: str | None = None
    """Change of the system clock's period at each tick: the period shrinks if, in half of the worlds or more,
    a UAV spots the source, and grows otherwise. The period is fixed if this is not given."""
    shortest: str | None = None
    """Shortest period of a triggered system clock; ``trigger`` if not given."""
    longest: str | None = None
    """Longest period of a triggered system clock; twice its first period if not given."""
    skip: bool = False
    """Let a step of the environment last until some UAV of its world can choose again, or the episode ends;
    ``duration`` counts the simulation steps that it lasted (``SkipUntilReady``). A training log then counts
    these longer steps and frames, and its returns are discounted within each step. The learner gets a batch
    every ``system`` / ``simulation`` of these longer steps."""
    skip_discount: float = 1.0
    """Discount per simulation step of the rewards within a step that ``skip`` makes longer."""

    def __post_init__(self) -> None:
        checks.convert_types("clock", self)
        fast, triggered = ("simulation", "agents", "server"), ("trigger", "shortest", "longest")
        given = [name for name in triggered if getattr(self, name) is not None]
        pairs = [*itertools.permutations((*fast, "system"), 2), *itertools.product(given, fast)]
        for slower, faster in pairs:
            # Of two clocks, the slower one ticks only when the faster one does.
            if slower in given or faster == "simulation" or self._seconds(slower) >= self._seconds(faster):
                ratio = self._seconds(slower) / self._seconds(faster)
                whole = math.isclose(ratio, max(round(ratio), 1), rel_tol=1e-9)
                problem = f"is not a multiple of clock.{faster}={self._period(faster)}"
                checks.require(whole, f"clock.{slower}", self._period(slower), problem)
        checks.in_range("clock.simulation", self.dt, 1e-3, 86_400, "s")  # a millisecond to a day
        checks.in_range("clock.skip_discount", self.skip_discount, 0.0, 1.0)
        problem, discount = "means nothing without clock.skip=true", self.skip_discount
        checks.require(self.skip or discount == 1, "clock.skip_discount", discount, problem)
        for name in given:
            problem = "means nothing without clock.trigger: the system clock is fixed"
            checks.require(self.trigger is not None, f"clock.{name}", getattr(self, name), problem)

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
