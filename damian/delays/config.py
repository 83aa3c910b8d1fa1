"""Settings of what is late: delays and links."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from damian.common import checks
from damian.common.fields import Settings, chance, metres, setting

LONGEST = 10_000
"""Longest delay allowed [steps], because every message in transit takes memory."""
_EXAMPLE = "{law: uniform, low: 3s, high: 7s}"


@dataclass
class DelayConfig(Settings):
    """Delays and how they are handled (paper, sections 3.3 to 3.5).

    A delay is written as steps such as 3, as a time such as 3s, or as a distribution such as
    {law: uniform, low: 3s, high: 7s}: constant, uniform, geometric, burst, trace, lag, distance
    (docs/concepts.md), or one of your own (docs/extending.md).
    """

    section = "delay"

    obs: Any = setting(0, f"Delay of messages to the server: 3 (steps), 3s, or {_EXAMPLE}.")
    act: Any = setting(
        0, "Delay of actions, written as ``obs``; a UAV holds until the first one arrives."
    )
    act_loss: float = chance(0.0, "Probability that an action never arrives.")
    act_hold: str = setting(
        "none",
        "``max``: an action is executed when the longest delay of ``act`` has passed; else as it "
        "arrives, unless a newer one has.",
        choices=("none", "max"),
    )
    rew: Any = setting(0, "Delay of rewards, written as ``obs``; none may be lost.")
    loss: float = chance(0.0, "Probability that a message to the server node is lost.")
    hold: str = setting(
        "none",
        "``max``: the server holds messages back until the longest delay of ``obs`` has passed.",
        choices=("none", "max"),
    )
    order: str = setting(
        "generation",
        "Which message the server holds: that generated last (generation), or arrived last "
        "(arrival).",
        choices=("generation", "arrival"),
    )
    history: int = setting(0, "Number of its latest actions that a UAV observes.", low=0, high=1000)
    messages: int = setting(
        0, "Number of latest steps whose messages a learner gets, as a timeline.", low=0, high=1000
    )
    reward_window: int = setting(
        1, "Steps over which rewards are summed (eq. 4).", unit="steps", low=1, high=LONGEST
    )
    reward_discount: float = setting(0.9, "Discount factor of that sum (eq. 4).", above=0, high=1)


@dataclass
class LinkConfig(Settings):
    """How observations reach the UAVs. Rewards and the critic always follow from what the server
    holds."""

    section = "links"

    kind: str = setting(
        "server",
        "Observations come from the server at once (server), with a delay (updown), or from UAVs "
        "(matrix).",
        choices=("server", "updown", "matrix"),
    )
    delay: Any = setting(
        0,
        "Delay of a link, as delay.obs; for matrix also a list per receiver.",
        kinds=("updown", "matrix"),
    )
    loss: Any = setting(
        0.0, "Probability of a loss; or a list per receiver.", kinds=("updown", "matrix")
    )
    range: float | None = metres(
        None, "A UAV hears only UAVs within this distance.", kinds=("matrix",)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse_unread()
        if self.kind == "updown" or not is_matrix(self.loss):
            checks.in_range("links.loss", self.loss, 0.0, 1.0)


def is_matrix(written: Any) -> bool:
    """Is a setting of the links given for each pair of UAVs, as a list or a tensor?"""
    return getattr(written, "ndim", 0) > 0 or (
        isinstance(written, Sequence) and not isinstance(written, str)
    )
