"""The four clocks: of the simulation, the agents, the server node, and the learner (paper, section 3.6)."""

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
    """How often an agent observes and decides; as the simulation if not given."""
    server: str | None = None
    """How often the server node broadcasts; as the simulation if not given."""
    system: str | None = None
    """How often the learner takes what has been collected; every ``steps`` of the algorithm if not given."""
    trigger: str | None = None
    """By how much the system clock's period shrinks at a tick while a UAV spots the source (in half of the
    worlds or more), and grows otherwise; it is fixed if not given."""
    shortest: str | None = None
    """Least period of a triggered system clock; ``trigger``, if not given."""
    longest: str | None = None
    """Largest period of a triggered system clock; twice its first, if not given."""
    skip: bool = False
    """A step of the environment lasts until some UAV of its world can choose again, or the episode ends;
    ``duration`` says how many ``simulation`` steps that took (``damian.fast_forward``). The steps and frames
    of a training log are such steps then, and its returns are discounted within them."""
    skip_discount: float = 1.0
    """Discount of the rewards within such a step, for each ``simulation`` step of it."""

    def __post_init__(self) -> None:
        fast, slow = ("simulation", "agents", "server"), ("trigger", "shortest", "longest")
        for one, other in itertools.permutations((*fast, "system"), 2):
            if self._seconds(one) >= self._seconds(other) or other == "simulation":
                self._check_multiple(one, other)
        given = [name for name in slow if getattr(self, name) is not None]
        for one, other in itertools.product(given, fast):
            checks.seconds(f"clock.{one}", getattr(self, one))
            self._check_multiple(one, other)
        checks.in_range("clock.skip_discount", self.skip_discount, 0.0, 1.0)
        told = "means nothing without clock.skip=true"
        checks.require(self.skip or self.skip_discount == 1, "clock.skip_discount", self.skip_discount, told)
        should = "means nothing without clock.trigger: the system clock is fixed"
        alone = given[0] if given and self.trigger is None else None
        checks.require(alone is None, f"clock.{alone}", getattr(self, alone or "trigger"), should)

    def _check_multiple(self, slow: str, fast: str) -> None:
        ratio = self._seconds(slow) / self._seconds(fast)
        whole = math.isclose(ratio, max(round(ratio), 1), rel_tol=1e-9)
        should = f"is not a multiple of clock.{fast}={self._written(fast)}"
        checks.require(whole, f"clock.{slow}", self._written(slow), should)

    def _written(self, name: str) -> str:
        return getattr(self, name) or self.simulation

    def _seconds(self, name: str) -> float:
        return checks.seconds(f"clock.{name}", self._written(name))

    @property
    def dt(self) -> float:
        """Simulation step [s]."""
        return self._seconds("simulation")

    def steps(self, name: str) -> int:
        """Period of a clock, in simulation steps."""
        return round(self._seconds(name) / self.dt)
