"""What UAVs are told to do: an order is offered, and moves the UAV in the books once it is acknowledged.

Worked timeline, an answer that holds for 10 s: at 100 s the UAV asks and is offered a landing point until
110 s; if it asks again before, it gets the same answer. At 103 s it says ``accepted``, and from then on the
service takes it to fly to that landing point. Without an acceptance by 110 s, it is taken to stay.
"""

from dataclasses import dataclass
from typing import Any

GRACE = 60.0
"""A landing point stays booked for so long after a late arrival [s], unless the UAV reports to be there."""
TOLD = 64
"""Decisions of a UAV that are kept: a late report in flight was of one of them."""
OFFERED, ACCEPTED, TAKEN_OFF, LANDED = "offered", "accepted", "taken off", "landed"
"""How far an order has come; it never goes back."""
REFUSED, ABORTED, LAPSED = "refused", "aborted", "lapsed"
"""How an order ends that is not flown: by the UAV, in flight, or because nobody accepted it in time."""
_COUNTED = (ACCEPTED, TAKEN_OFF, LANDED, ABORTED)
"""States of an order that a UAV has followed."""


@dataclass
class Decision:
    """What a UAV was told to do."""

    step: int
    """The step in which it chose."""
    time: float
    """When it was told [s]."""
    action: Any
    """The action: a number, or distance and heading in [0, 1]; None if the policy has not chosen it."""
    origin: int
    """Landing point from which it flies."""
    goal: int
    """Landing point to which it flies; the same if it holds."""
    duration: float
    """Expected duration of the flight [s]."""
    answer: str = ""
    """ID of the answer."""
    until: float = 0.0
    """By when it must be accepted [s]."""
    reason: str | None = None
    """Why the policy was not followed, one of ``damian_fleet.answers.REASONS``; None if it was."""
    status: str = OFFERED
    """How far it has come."""
    since: int = 0
    """Step up to which reports are older than what is known of this order."""

    @property
    def moves(self) -> bool:
        """Whether it is a flight."""
        return self.goal != self.origin

    @property
    def expires(self) -> float:
        """Until when the landing point stays booked after an acceptance [s]."""
        return self.time + 2 * self.duration + GRACE

    def is_live(self, now: float) -> bool:
        """Whether it may be accepted at an instant [s]."""
        return self.status == OFFERED and now <= self.until

    def is_open(self, now: float) -> bool:
        """Whether the UAV is taken to be on its way at an instant [s]."""
        return self.moves and self.status in (ACCEPTED, TAKEN_OFF) and now <= self.expires

    @property
    def kind(self) -> str:
        """``fly``, ``hold``, or ``return``: a flight that the policy has not chosen."""
        return "hold" if not self.moves else "return" if self.action is None else "fly"

    def acknowledge(self, said: str, now: float, step: int) -> bool:
        """Note what a UAV says of the order at an instant [s]; returns whether it follows it from now on.

        What has happened (taken off, landed) counts whenever it is said, an acceptance only in time. Nothing
        undoes an end.
        """
        if self.status == OFFERED and not self.is_live(now):
            self.status = LAPSED
        before, in_time = self.status, self.status == OFFERED
        if said == ACCEPTED and in_time:
            self.status = ACCEPTED if self.moves else LANDED
        elif said == REFUSED and in_time:
            self.status = REFUSED
        elif said == ABORTED and before in (ACCEPTED, TAKEN_OFF):
            self.status, self.since = ABORTED, step
        elif said == TAKEN_OFF and before in (OFFERED, LAPSED, ACCEPTED):
            self.status = TAKEN_OFF
        elif said == LANDED and before in (OFFERED, LAPSED, ACCEPTED, TAKEN_OFF):
            self.status, self.since = LANDED, step
        return before not in _COUNTED and self.status in _COUNTED
