"""Your own distributions of delays: a satellite link, a radio link to antennas, and a route that
drifts.

    cd examples/extending
    damian train "delay.obs={law: law:Satellite, hop: 2s, extra: 0.2}" aware=backupdate+history
    damian train "delay.obs={law: law:Distance, antenna: [0, 0], speed: 40, reach: 300}" aware=backupdate
    damian train "delay.obs={law: law:Route, longest: 6s, change: 0.3}" aware=backupdate+history

A law is a frozen dataclass derived from ``damian.Law``. ``sampler`` returns the probability of each
delay in steps (``Satellite``), a function of the circumstances under which messages are sent
(``Distance``), or a sampler of your own, whose senders have a state (``Route``).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from damian import ContextSampler, Law, MessageContext, Sampler, TableSampler
from damian.common import checks, counter_rng
from damian.common.fields import setting
from damian.delays.laws import Delay, in_steps


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
        return TableSampler([chances], loss=loss)


@dataclass(frozen=True)
class Distance(Law):
    """A delay grows with the distance to an antenna, and with the number of UAVs that send in this
    step."""

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
        """Delay of each of M messages [steps], [M]; it is rounded up, and a negative one is a
        loss."""
        position = context.entries["position"]
        distance = torch.linalg.vector_norm(position - position.new_tensor(self.antenna), dim=-1)
        steps = distance / (self.speed * context.dt) + context.n_sending // self.capacity
        lost = (distance > self.reach) & (context.uniform < 0.5)
        return torch.where(lost, -1.0, steps)


@dataclass(frozen=True)
class Route(Law):
    """The delay of a sender is a random walk: from one message to the next it changes by one step
    at most."""

    longest: Delay = 6
    """Longest delay: steps, or a time such as ``6s``."""
    change: float = setting(0.3, low=0, high=1)
    """Probability that the delay grows or shrinks by a step, each as likely, between 0 and
    ``longest``."""

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        return Walk(in_steps(f"{key}.longest", self.longest, dt), self.change, loss)


class Walk(Sampler):
    """Draws the delays of ``Route``; the state of a sender is the delay of its latest message
    [steps], [M].

    It goes on from one episode to the next; ``begin_episode`` could change that.
    """

    def __init__(self, longest: int, change: float, loss: float) -> None:
        super().__init__(longest, loses=False, loss=loss)
        self.change = change

    def initial_state(self, streams: Tensor) -> Tensor:
        return counter_rng.bits(streams) % (self.longest + 1)

    def forward(
        self, streams: Tensor, clock: Tensor, state: Tensor, context: MessageContext | None = None
    ) -> tuple[Tensor, Tensor]:
        draw = counter_rng.uniform(streams, clock)
        move = (draw < self.change / 2).long() - (draw >= 1 - self.change / 2).long()
        delay = (state + move).clamp(0, self.longest)
        return self.lose(delay, streams, clock), delay
