"""What the UAVs of a fleet were told to do."""

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

from torch import Tensor

GRACE = 60.0
"""A landing point stays booked for so long after a late arrival [s], unless the UAV reports to be there."""
TOLD = 64
"""Decisions of a UAV that are kept: a late report in flight was of one of them."""


@dataclass(frozen=True)
class Decision:
    """What a UAV was told to do."""

    step: int
    """The step in which it chose."""
    time: float
    """When it was told [s]."""
    action: Any
    """The action: a number, or distance and heading in [0, 1]."""
    origin: int
    """Landing point from which it flies."""
    goal: int
    """Landing point to which it flies; the same if it holds."""
    duration: float
    """Expected duration of the flight [s]."""

    @property
    def expires(self) -> float:
        """When the landing point is no longer booked, unless the UAV reports to be there [s]."""
        return self.time + 2 * self.duration + GRACE


Told = list[deque[Decision]]
"""The latest decisions of each UAV, oldest first."""


class Choices(NamedTuple):
    """All that changes where UAVs choose, as it was before."""

    told: Told
    action: Tensor
    """Actions of the step, [1, N, ...]."""
    chosen: Tensor
    """Which UAVs have chosen in the step, [1, N] bool."""
    hidden: Tensor | None
    """Hidden states after the step, [1, N, H]."""
