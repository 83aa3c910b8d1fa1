"""The settings of the service, beside those of the scenario."""

import os
import secrets
from dataclasses import dataclass

from damian.common.checks import require
from damian.common.fields import Settings, setting


@dataclass
class FleetConfig(Settings):
    """How the service is reached, who advises, and what holds whatever the policy chooses."""

    checkpoint: str | None = setting(
        None,
        "Run folder, or the best.pt in it, of the policy that advises; the script does if not "
        "given.",
    )
    instant: bool = setting(
        False, "Whether to serve a policy whose UAVs were at their targets at once in training."
    )
    seed: int = setting(0, "Seed of random regions.", low=0)
    trust: bool = setting(
        False, "Import the components package.module:Name that the checkpoint's run names."
    )
    port: int = setting(8000, "Port of the service over HTTP; 0: a free one.", low=0, high=65535)
    host: str = setting(
        "127.0.0.1", "Address of the service; other machines do not reach the default one."
    )
    token: str | None = setting(
        None, "Password; DAMIAN_TOKEN of the environment, or made and printed, if not given."
    )
    database: str = setting("fleets.db", "File of the database with all fleets.")
    answer_time: float = setting(
        10.0, "How long an answer holds; it must be accepted by then.", unit="s", above=0
    )
    reserve: float = setting(
        20.0,
        "Battery below which a UAV holds or returns; 0 needs no reported one.",
        unit="%",
        high=100,
    )
    oldest_report: float = setting(
        60.0, "Age of its newest report above which a UAV on the ground holds.", unit="s", above=0
    )
    levels: list[float] = setting(
        [20.0 + 5 * i for i in range(21)],
        "Flight levels; UAVs share them if too few.",
        unit="m",
        above=0,
    )
    clearance: float = setting(
        10.0, "Least distance between paths at one level; else a UAV holds.", unit="m", low=0
    )
    margin: float = setting(
        10.0,
        "Least distance of a way to zones and the edge of the region, but where it ends.",
        unit="m",
        low=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse(not self.levels, "levels", "names no flight level")
        self.is_made = not (token := self.token or os.environ.get("DAMIAN_TOKEN"))
        self.token = token or secrets.token_urlsafe(24)
        good = len(self.token) >= 16 and self.token.isascii() and self.token.isprintable()
        require(good, "token", "it", "is not a password of at least 16 printable ASCII characters")
