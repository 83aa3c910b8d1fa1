"""The time of a service: that of the system when it started, and from then on by the monotonic clock.

Worked timeline: the service starts at 12:00:00; at 12:10:00 somebody sets the system clock to 13:10:00. The
service goes on at 12:10:00, and notes that the system clock is 3600 s ahead from now on.
"""

import logging
import time
from collections.abc import Callable

JUMP = 1.0
"""By how much the system clock must change against the monotonic one for a jump [s]."""
_LOG = logging.getLogger("damian_fleet")


class Clock:
    """Seconds since 1970 that never jump.

    Args:
        least: it does not start before this time [s], such as the end of a journal.
        system: clock of the system [s since 1970].
        monotonic: clock that only goes forward [s].
    """

    def __init__(
        self,
        least: float = 0.0,
        system: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._system, self._monotonic = system, monotonic
        self._base = max(system(), least) - monotonic()
        self.ahead = 0.0
        """How far the system clock is ahead [s], when it was looked at last."""
        self.jumps = 0
        """How many times it has jumped."""
        self.watch()

    def __call__(self) -> float:
        return self._base + self._monotonic()

    def watch(self) -> None:
        """Look at the system clock, and note it if it has jumped."""
        ahead = self._system() - self()
        if abs(ahead - self.ahead) > JUMP:
            self.jumps += 1
            _LOG.warning("the system clock is now %.1f s ahead of the service, which keeps its time", ahead)
        self.ahead = ahead
