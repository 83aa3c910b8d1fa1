"""When the learner takes what has been collected (paper, section 3.6)."""

import math
from typing import Any

from torch import Tensor

from damian.common import checks
from damian.envs.clocks import ClockConfig


class SystemClock:
    """When the learner takes what has been collected: fixed, or triggered (paper, section 3.6).

    Args:
        config: of the clocks.
        period: the first one [steps].

    Raises:
        InputError: the first period is out of the bounds.
    """

    def __init__(self, config: ClockConfig, period: int) -> None:
        self.period, self.change = period, 0
        self.shortest = self.longest = period
        if config.trigger is not None:
            self.change = config.steps("trigger")
            self.shortest = config.steps("shortest") if config.shortest else self.change
            self.longest = config.steps("longest") if config.longest else 2 * period
            steps = f"{period} steps"
            should = f"is out of clock.shortest, clock.longest = {self.shortest}, {self.longest} steps"
            checks.require(self.shortest <= period <= self.longest, "clock.system", steps, should)

    @property
    def unit(self) -> int:
        """Steps that every period is a multiple of."""
        return math.gcd(self.period, self.change, self.shortest, self.longest)

    def tick(self, spotting: Tensor) -> None:
        """The next period follows from which UAVs spot the source, as the server knows, [B, N] bool."""
        often = spotting.any(-1).float().mean() >= 0.5
        changed = self.period - self.change if often else self.period + self.change
        self.period = min(max(changed, self.shortest), self.longest)

    def state_dict(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"period": self.period}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self.period = int(state["period"])
