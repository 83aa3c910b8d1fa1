"""What a delay may be."""

import copy
from collections.abc import Callable
from typing import cast

from damian.common import checks
from damian.delays.samplers import ContextSampler, Sampler, TableSampler


def sampler_of(delay: object, dt: float = 1.0, loss: float = 0.0) -> Sampler:
    """The sampler of a number of steps, of the shortest and the longest, of a function, or a copy
    of one.

    All numbers of steps between the shortest and the longest are equally likely. A function gets a
    ``MessageContext`` and returns at most 20 steps. Transforms share no sampler, because each may
    move to a device of its own.
    """
    checks.above("dt", dt, 0.0, "s")
    if isinstance(delay, Sampler):
        checks.require(
            loss == 0, "loss", loss, "does not go with a sampler, which has the losses of its own"
        )
        return copy.deepcopy(delay)
    if callable(delay):
        return ContextSampler(cast(Callable, delay), 20, loss, loses=False)
    low, high = (delay, delay) if isinstance(delay, int) else cast(tuple[int, int], delay)
    checks.whole("delay", low, 0)
    checks.whole("delay", high, low)
    return TableSampler([[0.0] * low + [1 / (high - low + 1)] * (high - low + 1)], loss=loss)
