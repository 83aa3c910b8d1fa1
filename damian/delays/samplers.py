"""Samplers that draw one delay per message: a hash and a table search, without a random generator."""

import torch
from torch import Tensor, nn

from damian.common import checks, counter_rng


class Sampler(nn.Module):
    """Draws delays from a table of probabilities. Drawing is a pure function, so it can be compiled.

    Args:
        states: for each of S channel states, the probabilities of the delays 0, 1, ... [steps]; if they sum
            to less than 1, the rest is the probability that the message is lost.
        turns: transition probabilities between the channel states per step, [S, S]; one state if not given.
        loss: probability that a message is lost, whatever its delay.
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
        joint = (turn.unsqueeze(-1) * chances.unsqueeze(0)).flatten(1)  # of next state and delay, one draw
        boundaries = (joint.cumsum(-1)[:, :-1] * 2**32).round().long()
        self.register_buffer("_boundaries", boundaries, persistent=False)
        self._bad_share = (turn[0, 1] / (turn[0, 1] + turn[1, 0])).item() if turns else 0.0
        likeliest = int(chances[0].argmax())
        self.certain = likeliest if len(states) == 1 and chances[0, likeliest] == 1 else None
        """The delay [steps] if it is always the same, else None."""

    @property
    def lost(self) -> int:
        """Delay value that marks a message that never arrives: ``longest + 1``."""
        return self.longest + 1

    @property
    def loses(self) -> bool:
        """Whether messages can be lost."""
        return bool((self.chances[:, -1] > 1e-9).any())

    def initial_state(self, streams: Tensor) -> Tensor:
        """Draw the initial state of each sender's channel [M] from its random stream [M]."""
        return (counter_rng.uniform(streams) < self._bad_share).long()

    def forward(self, streams: Tensor, clock: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Draw the delays [M] of the messages sent at ``clock``, and the channels' next states [M].

        Args:
            streams: random stream of each sender, [M].
            clock: step, [M] or a scalar.
            memory: state of each channel, [M].
        """
        if self.certain is not None:
            return torch.full_like(streams, self.certain), memory
        draw = counter_rng.bits(streams, clock)
        if len(self.chances) == 1:
            return torch.bucketize(draw, self._boundaries[0], right=True), memory
        outcome = (draw.unsqueeze(-1) >= self._boundaries[memory]).sum(-1)
        n = self.longest + 2
        return outcome % n, outcome // n


class Recorded(Sampler):
    """Plays back recorded delays; each sender starts at a random position, which is its channel state.

    Args:
        delays: recorded delays [steps], -1 for a lost message.
        loss: probability that a message is lost in addition.
    """

    _delays: Tensor

    def __init__(self, delays: list[int], loss: float) -> None:
        longest = max(*delays, 0)
        frequencies = [delays.count(k) / len(delays) for k in range(longest + 1)]
        super().__init__([frequencies], loss=loss)
        self._loss = loss
        codes = [longest + 1 if delay < 0 else delay for delay in delays]
        self.register_buffer("_delays", torch.tensor(codes), persistent=False)

    def initial_state(self, streams: Tensor) -> Tensor:
        return counter_rng.bits(streams) % len(self._delays)

    def forward(self, streams: Tensor, clock: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        delay = self._delays[memory]
        if self._loss:
            delay = torch.where(counter_rng.uniform(streams, clock) < self._loss, self.lost, delay)
        return delay, (memory + 1) % len(self._delays)


class HeldSampler(Sampler):
    """Gives every message the longest delay of another sampler; the same messages are lost.

    Args:
        drawn: the other sampler.
    """

    def __init__(self, drawn: Sampler) -> None:
        arrival_chances = (1 - drawn.chances[:, -1]).tolist()
        super().__init__([[0.0] * drawn.longest + [chance] for chance in arrival_chances])
        self.drawn = drawn
        self.certain = None if self.loses else self.longest

    def initial_state(self, streams: Tensor) -> Tensor:
        return self.drawn.initial_state(streams)

    def forward(self, streams: Tensor, clock: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        delay, memory = self.drawn(streams, clock, memory)
        return torch.where(delay < self.lost, self.longest, self.lost), memory
