"""A delay law that depends on everything that it sees, and its twin in plain Python."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from damian.delays.laws import Law
from damian.delays.samplers import ContextSampler, MessageContext, Sampler

LONGEST = 6
LOST = 0.875
"""Random number from which on a message is lost."""


@dataclass(frozen=True)
class Crowd(Law):
    """Delays by sender, number of senders, time, a random number, and a column of an entry."""

    entry: str = "position"
    """Name of the entry."""
    column: int = 0
    """Column of the entry that the law looks at."""
    loses: bool = True

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        return ContextSampler(self.delays, LONGEST, loss, loses=self.loses, reads=[self.entry])

    def delays(self, context: MessageContext) -> Tensor:
        """Every part is a whole number, apart from a quarter that is to be rounded up."""
        place = (context.entries[self.entry][:, self.column] / 32).floor().abs() % 3
        parity = (context.time / context.dt) % 2
        steps = place + context.n_sending + context.sender + parity + (4 * context.uniform).floor() - 0.25
        return torch.where(context.uniform >= LOST, -1.0, steps)


def twin_delay(value: float, n_sending: int, sender: int, elapsed: int, uniform: float) -> int | None:
    """The delay of ``Crowd`` for one message; None if it is lost."""
    if uniform >= LOST:
        return None
    place = abs(math.floor(value / 32)) % 3
    return min(math.ceil(place + n_sending + sender + elapsed % 2 + math.floor(4 * uniform) - 0.25), LONGEST)
