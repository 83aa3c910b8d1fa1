"""Delays as they are written: in steps (``3``) or as a time with its unit (``"3s"``, ``"0.5m"``)."""

import math
from numbers import Integral

from damian.common import checks

Delay = int | str
"""Whole steps (``3``), or a time with its unit (``"3s"``)."""

LONGEST = 10_000
"""Longest delay allowed [steps], because every message in transit takes memory."""


def check_dt(dt: float) -> None:
    """Require the length of a step: a number of seconds above 0."""
    good = isinstance(dt, int | float) and not isinstance(dt, bool)
    checks.require(good, "dt", repr(dt), "is not the length of a step in seconds, such as 0.5")
    checks.above("dt", dt, 0.0, "s")


def in_steps(key: str, delay: Delay, dt: float) -> int:
    """Convert a delay to whole steps of ``dt`` seconds; a time is rounded up.

    Raises:
        InputError: the delay is neither steps nor a time, or longer than ``LONGEST``.
    """
    if isinstance(delay, str):
        steps = math.ceil(min(seconds(key, delay) / dt, LONGEST + 1) - 1e-9)
    else:
        is_steps = isinstance(delay, Integral) and not isinstance(delay, bool) and delay >= 0
        checks.require(is_steps, key, delay, "is neither whole steps such as 3 nor a time such as 3s or 0.5m")
        steps = int(delay)
    checks.require(steps <= LONGEST, key, delay, f"is more than {LONGEST} steps")
    return steps


def seconds(key: str, delay: Delay) -> float:
    """Convert a time with its unit to seconds; it may be zero (``0s``).

    Raises:
        InputError: the delay is no time.
    """
    problem = "is neither whole steps such as 3 nor a time such as 3s or 0.5m"
    checks.require(str(delay)[-1:] in ("s", "m", "h"), key, delay, problem)
    return checks.seconds(key, str(delay), zero=True)
