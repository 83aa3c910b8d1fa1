"""How late the messages of a vehicle are, by its own clock and count, whatever way they took.

Some messages tell the time since the boot of the vehicle; the others are placed between those by
the number that each message has, which begins again after 255. A late message is no restart: that
is told by the answer to a request of the time (TIMESYNC), which is behind what was heard before the
request was made. Until the clock is known, each message counts as ``LATEST`` late.
"""

import bisect
import math
from typing import Any

LATEST = 5.2
"""No message is later than this [s]; where one is, it may count as new."""
LATE = 2.0
"""After messages as late as this [s], a number that may be of two messages is of the older one."""
_KEPT = 8.0  # how long messages with a time are remembered, by the vehicle's clock [s]
_DRIFT = 1e-4  # how much clocks may differ, as a share of the time


class Order:
    """The order in which a vehicle has sent its messages; times are in seconds."""

    def __init__(self) -> None:
        self.boots = 0
        """How often it has booted since the first message."""
        self._asked: dict[
            int, tuple[float, float]
        ] = {}  # requests of the time: when, and the newest time then
        self._begin()

    def _begin(self) -> None:
        self._times: list[float] = []  # of messages with a time, ascending ...
        self._numbers: list[int] = []  # ... and their numbers, counted on beyond 255
        self._newest: dict[
            Any, tuple[float, float]
        ] = {}  # by kind: time or number of it, when it came
        self._number = 0  # of the newest message
        self._rate = math.nan  # messages in a second
        self._upper, self._lower = (
            math.inf,
            -math.inf,
        )  # of how far our clock is ahead of the vehicle's
        self._bounded_at = self._mixed_until = -math.inf

    @property
    def _ahead(self) -> float:
        """How far our clock is ahead of that of the vehicle at least, so that nothing seems too
        new."""
        return self._upper if self._lower == -math.inf else min(self._lower, self._upper)

    @property
    def _is_known(self) -> bool:
        """Whether the clock of the vehicle is known: by an answer, or by its messages for so
        long."""
        long = self._times[-1] - self._times[0] if self._times else 0.0
        return self._lower > -math.inf or long > LATEST

    def ask_time(self, now: float) -> int:
        """The mark of a request of the time [ns]."""
        mark = round(now * 1e9)
        self._asked[mark] = now, self._times[-1] if self._times else -math.inf
        self._asked.pop(next(iter(self._asked)) if len(self._asked) > 60 else None, None)
        return mark

    def hear_time(self, mark: int, vehicle: float) -> None:
        """Take the answer to a request of the time, of which it has the mark."""
        asked, before = self._asked.pop(mark, (None, -math.inf))
        if asked is None:
            return
        if vehicle < before - 0.5:
            self.boots += 1
            self._asked.clear()
            self._begin()
        self._lower = max(self._lower, asked - vehicle)

    def lateness(self, kind: Any, message: Any, now: float) -> float | None:
        """How long a message was on its way; None if it, or a newer one of its kind, has come
        before."""
        drift = _DRIFT * max(now - self._bounded_at, 0.0) if self._bounded_at > -math.inf else 0.0
        self._upper = self._upper + drift
        self._lower = self._lower - drift
        self._bounded_at = now
        boot = getattr(message, "time_boot_ms", None)
        number = message.get_seq()
        if boot is not None:
            if not self._clock(boot / 1e3, number, now):
                return None
            place = boot / 1e3
            sent = boot / 1e3
        else:
            place, sent = self._place(number, now)
        late = max(now - self._ahead - sent, 0.0) if self._is_known else LATEST
        if boot is not None and late > LATE:
            self._mixed_until = (
                now + LATEST
            )  # others may come so late that their count has begun again
        newest, came = self._newest.get(kind, (-math.inf, -math.inf))
        if now > came + LATEST:  # none is that late: it has counted anew
            self._number = self._number if boot is not None else round(place)
        elif place <= newest:
            return None
        self._newest[kind] = place, now
        return late

    def _clock(self, boot: float, number: int, now: float) -> bool:
        """Take the time of a message, unless it is of an earlier boot."""
        if boot > now - self._lower + 1.0:
            return False
        self._upper = min(self._upper, now - boot)
        at = bisect.bisect_left(self._times, boot)
        if at < len(self._times) and self._times[at] == boot:
            return True
        near = min(max(at, 1), len(self._times)) - 1
        if self._times:
            rate = 0.0 if math.isnan(self._rate) else self._rate
            expected = self._numbers[near] + rate * (boot - self._times[near])
            if math.isnan(self._rate):
                expected += math.copysign(128, boot - self._times[near])
            number = round((expected - number) / 256) * 256 + number
        self._times.insert(at, boot)
        self._numbers.insert(at, number)
        self._number = max(self._number, number)
        while self._times[0] < self._times[-1] - _KEPT:
            del self._times[0], self._numbers[0]
        if (long := self._times[-1] - self._times[0]) >= 0.5:
            self._rate = max((self._numbers[-1] - self._numbers[0]) / long, 0.5)
        return True

    def _place(self, number: int, now: float) -> tuple[float, float]:
        """The number of a message without a time, counted on, and when it was sent by the vehicle's
        clock."""
        vehicle = now - self._ahead
        if (
            math.isnan(self._rate) or vehicle > self._times[-1] + LATEST
        ):  # nothing tells but the count
            place = self._number + (number - self._number + 128) % 256 - 128
            self._number = max(self._number, place)
            return place, vehicle - LATEST
        newest = self._numbers[-1] + self._rate * (vehicle - self._times[-1]) + 8 + 0.2 * self._rate
        place = number + math.floor((newest - number) / 256) * 256
        if now < self._mixed_until and vehicle - self._time_at(place - 256) < LATEST + 0.5:
            place -= 256  # it may be as old as that
        self._number = max(self._number, place)
        return place, self._time_at(place)

    def _time_at(self, place: int) -> float:
        """When a message of a number was sent, by the vehicle's clock, between those that tell
        their time."""
        after = bisect.bisect_left(self._numbers, place)
        if after in (0, len(self._numbers)):
            near = min(after, len(self._numbers) - 1)
            return self._times[near] + (place - self._numbers[near]) / self._rate
        (one, other), (t, u) = (
            self._numbers[after - 1 : after + 1],
            self._times[after - 1 : after + 1],
        )
        return t + (u - t) * (place - one) / max(other - one, 1)
