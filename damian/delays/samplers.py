"""Draws delays, one per message: a hash and a search in a table, without a generator."""

import torch
from torch import Tensor, nn

from damian.common import checks, counter_rng


class Sampler(nn.Module):
    """Draws delays from a table of chances; pure, so that it compiles.

    Args:
        states: chance of each delay 0, 1, ... [steps] in each state of the channel; what is missing to 1
            is the chance of a loss.
        turns: chances to pass from state to state in a step; a single state if not given.
        loss: further probability of a loss.
    """

    chances: Tensor
    _boundaries: Tensor

    def __init__(
        self, states: list[list[float]], turns: list[list[float]] | None = None, loss: float = 0.0
    ) -> None:
        super().__init__()
        checks.in_range("loss", loss, 0.0, 1.0)
        self.longest = max(map(len, states)) - 1
        arrive = torch.zeros(len(states), self.longest + 1, dtype=torch.float64)
        for row, chances in zip(arrive, states, strict=True):
            row[: len(chances)] = torch.tensor(chances, dtype=torch.float64) * (1 - loss)
        chances = torch.cat([arrive, (1 - arrive.sum(-1, keepdim=True)).clamp(min=0)], -1)
        self.register_buffer("chances", chances, persistent=False)
        turn = torch.tensor(turns or [[1.0]], dtype=torch.float64)
        joint = (turn.unsqueeze(-1) * chances.unsqueeze(0)).flatten(1)  # next state and delay at once
        boundaries = (joint.cumsum(-1)[:, :-1] * 2**32).round().long()
        self.register_buffer("_boundaries", boundaries, persistent=False)
        self._bad = (turn[0, 1] / (turn[0, 1] + turn[1, 0])).item() if turns else 0.0
        likely = int(chances[0].argmax())
        self.certain = likely if len(states) == 1 and chances[0, likely] == 1 else None
        """The only delay there is, if it is one."""

    @property
    def lost(self) -> int:
        """The "delay" of a message that never arrives."""
        return self.longest + 1

    @property
    def loses(self) -> bool:
        """May a message never arrive."""
        return bool((self.chances[:, -1] > 1e-9).any())

    def initial_state(self, streams: Tensor) -> Tensor:
        """State of each channel at first, from its stream of random numbers [M]."""
        return (counter_rng.uniform(streams) < self._bad).long()

    def forward(self, streams: Tensor, clock: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Delays [M] of the messages sent at ``clock``, and the channels' next states [M]."""
        if self.certain is not None:
            return torch.full_like(streams, self.certain), memory
        chance = counter_rng.bits(streams, clock)
        if len(self.chances) == 1:
            return torch.bucketize(chance, self._boundaries[0], right=True), memory
        outcome = (chance.unsqueeze(-1) >= self._boundaries[memory]).sum(-1)
        n = self.longest + 2
        return outcome % n, outcome // n


class Recorded(Sampler):
    """Plays delays back [steps], -1 for lost; each sender from a place of its own."""

    _delays: Tensor

    def __init__(self, delays: list[int], loss: float) -> None:
        longest = max(*delays, 0)
        found = [delays.count(k) / len(delays) for k in range(longest + 1)]
        super().__init__([found], loss=loss)
        self._loss = loss
        code = [longest + 1 if delay < 0 else delay for delay in delays]
        self.register_buffer("_delays", torch.tensor(code), persistent=False)

    def initial_state(self, streams: Tensor) -> Tensor:
        return counter_rng.bits(streams) % len(self._delays)

    def forward(self, streams: Tensor, clock: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        delay = self._delays[memory]
        if self._loss:
            delay = torch.where(counter_rng.uniform(streams, clock) < self._loss, self.lost, delay)
        return delay, (memory + 1) % len(self._delays)


class HeldSampler(Sampler):
    """Draws what another sampler draws, and lets it take the longest."""

    def __init__(self, drawn: Sampler) -> None:
        arrive = (1 - drawn.chances[:, -1]).tolist()
        super().__init__([[0.0] * drawn.longest + [chance] for chance in arrive])
        self.drawn = drawn
        self.certain = None if self.loses else self.longest

    def initial_state(self, streams: Tensor) -> Tensor:
        return self.drawn.initial_state(streams)

    def forward(self, streams: Tensor, clock: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        delay, memory = self.drawn(streams, clock, memory)
        return torch.where(delay < self.lost, self.longest, self.lost), memory
