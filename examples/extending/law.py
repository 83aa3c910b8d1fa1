"""Your own distributions of delays: a satellite link with more hops at times, and a radio link to antennas.

    cd examples/extending
    damian train "delay.obs={law: law:Satellite, hop: 2s, extra: 0.2}" aware=both
    damian train "delay.obs={law: law:Distance, antenna: [0, 0], speed: 40, reach: 300}" aware=both

A law is a frozen dataclass derived from ``damian.Law``. ``sampler`` returns the probability of each delay in
steps (``Satellite``), or a function of the circumstances under which messages are sent (``Distance``).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from damian import ContextSampler, Law, MessageContext
from damian.common import checks
from damian.delays.laws import Delay, in_steps
from damian.delays.samplers import Sampler
from damian.settings.fields import setting


@dataclass(frozen=True)
class Satellite(Law):
    """Every message takes one hop; with a probability it takes two."""

    hop: Delay = 2
    """Delay of a hop: steps, or a time such as ``2s``."""
    extra: float = setting(0.1, low=0, high=1)
    """Probability of a second hop."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        hop = in_steps(f"{key}.hop", self.hop, dt)
        chances = [0.0] * (2 * hop + 1)
        chances[hop] += 1 - self.extra
        chances[2 * hop] += self.extra
        return Sampler([chances], loss=loss)


@dataclass(frozen=True)
class Distance(Law):
    """A delay grows with the distance to an antenna, and with the number of UAVs that send in this step."""

    antenna: Sequence[float] = (0.0, 0.0)
    """Place of the antenna, east and north [m]."""
    speed: float = setting(50.0, above=0, unit="m/s")
    """Distance over which a message is relayed per second [m/s]."""
    capacity: int = setting(4, low=1, unit="messages")
    """As many messages at once delay each other by one step."""
    reach: float = setting(1000.0, above=0, unit="m")
    """Distance beyond which half of the messages are lost [m]."""
    longest: Delay = 20
    """Longest delay: steps, or a time such as ``20s``."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        checks.place(f"{key}.antenna", self.antenna)
        return ContextSampler(
            self.delays, in_steps(f"{key}.longest", self.longest, dt), loss, reads=["position"]
        )

    def delays(self, context: MessageContext) -> Tensor:
        """Delay of each of M messages [steps], [M]; it is rounded up, and a negative one is a loss."""
        position = context.entries["position"]
        distance = torch.linalg.vector_norm(position - position.new_tensor(self.antenna), dim=-1)
        steps = distance / (self.speed * context.dt) + context.n_sending // self.capacity
        lost = (distance > self.reach) & (context.uniform < 0.5)
        return torch.where(lost, -1.0, steps)
