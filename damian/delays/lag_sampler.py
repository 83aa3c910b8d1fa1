"""A sampler that holds the delays that it draws, so that successive messages of a sender are equally late."""

import torch
from torch import Tensor

from damian.common import counter_rng
from damian.delays.samplers import MessageContext, Sampler


class LagSampler(Sampler):
    """Draws a delay (a lag) from a table, and holds it; losses are drawn for each message.

    The state of a channel is [M, 2] long: the lag, -1 before the first message of an episode, and the number
    of steps that it is still held.

    Args:
        chances: probabilities of the lags 0, 1, ... [steps]; if they sum to less than 1, the rest is the
            probability that a message is lost.
        loss: probability that a message is lost in addition, whatever its delay.
        period: steps between two updates; None: one lag per episode.
        hold_probability: probability that an update keeps the lag.
        shared: all agents of a world draw the same numbers.
        stagger: the second update of an episode comes after a random time, from one step to ``period``.
    """

    def __init__(
        self,
        chances: list[float],
        loss: float,
        *,
        period: int | None,
        hold_probability: float,
        shared: bool,
        stagger: bool,
    ) -> None:
        super().__init__([chances], loss=loss)
        arrives = sum(chances)
        self._lags = Sampler([[chance / arrives for chance in chances]] if arrives else [[1.0]])
        self._loss = self.chances[0, -1].item() if self.loses else 0.0
        self._period, self._hold_probability = period or _FOREVER, hold_probability
        self.shared, self._stagger = shared, stagger

    def initial_state(self, streams: Tensor) -> Tensor:
        return torch.stack([torch.full_like(streams, -1), torch.zeros_like(streams)], -1)

    def begin_episode(self, memory: Tensor, mask: Tensor) -> Tensor:
        return torch.where(mask.unsqueeze(-1), self.initial_state(memory[:, 0]), memory)

    def forward(
        self, streams: Tensor, clock: Tensor, memory: Tensor, context: MessageContext | None = None
    ) -> tuple[Tensor, Tensor]:
        if self.certain is not None:
            return torch.full_like(streams, self.certain), memory
        lag, wait = memory.unbind(-1)
        first, due = lag < 0, wait == 0
        renewed, interval = due, torch.full_like(streams, self._period)
        if self._hold_probability:
            keeps = counter_rng.uniform(streams, clock, torch.full_like(clock, 1)) < self._hold_probability
            renewed = first | (due & ~keeps)
        if self._stagger:
            phase = counter_rng.bits(streams, clock, torch.full_like(clock, 2)) % self._period
            interval = torch.where(first, 1 + phase, interval)
        drawn, _ = self._lags(streams, clock, memory)
        lag = torch.where(renewed, drawn, lag)
        memory = torch.stack([lag, torch.where(due, interval, wait) - 1], -1)
        if not self._loss:
            return lag, memory
        lost = counter_rng.uniform(streams, clock, torch.zeros_like(clock)) < self._loss
        return torch.where(lost, self.lost, lag), memory


_FOREVER = 2**40
"""Steps that no episode lasts."""
