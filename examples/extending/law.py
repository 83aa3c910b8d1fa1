"""A delay law of one's own: a satellite link that now and then needs one more hop.

    cd examples/extending
    damian train "delay.obs={law: law:Satellite, hop: 2s, extra: 0.2}" aware=both

A law is a frozen dataclass derived from ``damian.Law``. ``sampler`` returns the probability of each delay in
steps.
"""

from dataclasses import dataclass

from damian import Law
from damian.common import checks
from damian.delays.laws import Delay, in_steps
from damian.delays.samplers import Sampler


@dataclass(frozen=True)
class Satellite(Law):
    """Every message takes one hop; with a probability it takes two."""

    hop: Delay = 2
    """Delay of a hop: steps, or a time such as ``2s``."""
    extra: float = 0.1
    """Probability of a second hop."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        checks.in_range(f"{key}.extra", self.extra, 0.0, 1.0)
        hop = in_steps(f"{key}.hop", self.hop, dt)
        chances = [0.0] * (2 * hop + 1)
        chances[hop] += 1 - self.extra
        chances[2 * hop] += self.extra
        return Sampler([chances], loss=loss)
