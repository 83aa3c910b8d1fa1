"""The system clock: how many steps are collected between two updates (paper, section 3.6)."""

import math
from typing import Any

from torch import Tensor

from damian.common import checks
from damian.envs.clocks import ClockConfig


class SystemClock:
    """Period between two updates of the learner [steps], fixed or triggered (paper, sections 3.6 and 4.3).

    Args:
        config: settings of the clocks.
        period: the first period [steps].

    Raises:
        InputError: the first period is out of its bounds.
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
        """Largest number of steps that divides every possible period."""
        return math.gcd(self.period, self.change, self.shortest, self.longest)

    def tick(self, spotting: Tensor) -> None:
        """Set the next period: shorter if a UAV spots the source in half of the worlds or more, else longer.

        Args:
            spotting: whether each UAV spots the source, as the server knows, [B, N] bool.
        """
        in_half_of_worlds = spotting.any(-1).float().mean() >= 0.5
        changed = self.period - self.change if in_half_of_worlds else self.period + self.change
        self.period = min(max(changed, self.shortest), self.longest)

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a checkpoint stores."""
        return {"period": self.period}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state that a checkpoint has stored."""
        self.period = int(state["period"])
