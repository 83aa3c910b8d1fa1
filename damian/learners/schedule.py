"""The system clock: the period between two updates (paper, section 3.6)."""

import math
from typing import Any

from torch import Tensor

from damian.common import checks
from damian.envs.config import ClockConfig


class SystemClock:
    """Period between two updates of the learner [steps], fixed or triggered
    (paper, sections 3.6 and 4.3)."""

    def __init__(self, config: ClockConfig, period: int) -> None:
        self.period = period
        self.change = 0
        self.shortest = self.longest = period
        if config.trigger is not None:
            self.change = config.steps("trigger")
            self.shortest = config.steps("shortest") if config.shortest else self.change
            self.longest = config.steps("longest") if config.longest else 2 * period
            steps = f"{period} steps"
            should = (
                f"is out of clock.shortest, clock.longest = {self.shortest}, {self.longest} steps"
            )
            checks.require(self.shortest <= period <= self.longest, "clock.system", steps, should)

    @property
    def unit(self) -> int:
        """Largest number of steps that divides every possible period."""
        return math.gcd(self.period, self.change, self.shortest, self.longest)

    def tick(self, spotting: Tensor) -> None:
        """Shorten the period if a UAV spots the source, [B, N], in half of the worlds; else
        lengthen it."""
        in_half_of_worlds = spotting.any(-1).float().mean() >= 0.5
        changed = self.period - self.change if in_half_of_worlds else self.period + self.change
        self.period = min(max(changed, self.shortest), self.longest)

    def state_dict(self) -> dict[str, Any]:
        return {"period": self.period}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.period = int(state["period"])
