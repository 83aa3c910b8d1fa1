"""What the service holds to, whatever the policy chooses."""

from dataclasses import dataclass

from damian.common import checks
from damian.common.fields import Settings, setting


@dataclass
class FieldRules(Settings):
    """What a service of real UAVs holds to, whatever the policy chooses."""

    answer_time: float = setting(
        10.0, "How long an answer holds; it must be accepted by then.", unit="s", above=0
    )
    reserve: float = setting(
        20.0,
        "Battery level below which a UAV holds or returns; 0 needs no reported battery.",
        unit="%",
        high=100,
    )
    oldest_report: float = setting(
        60.0, "Age of its newest report above which a UAV holds.", unit="s", above=0
    )
    lowest_level: float = setting(20.0, "Lowest flight level above ground.", unit="m", above=0)
    highest_level: float = setting(
        120.0, "Highest flight level; UAVs share levels if there are too few.", unit="m", above=0
    )
    level_step: float = setting(5.0, "Vertical distance between two flight levels.", unit="m", above=0)
    clearance: float = setting(
        10.0,
        "Distance that paths of UAVs at the same level keep from each other; else one holds.",
        unit="m",
        low=0,
    )
    instant: bool = setting(
        False, "Whether to serve a policy whose UAVs were at their targets at once in training."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.in_range("highest_level", self.highest_level, self.lowest_level, unit="m")

    @property
    def levels(self) -> list[float]:
        """The flight levels [m], from the lowest upward."""
        n_levels = int((self.highest_level - self.lowest_level) / self.level_step + 1e-9) + 1
        return [self.lowest_level + i * self.level_step for i in range(n_levels)]
