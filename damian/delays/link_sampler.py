"""Delay laws and losses for each link between N agents."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from damian.common import checks, counter_rng
from damian.common.errors import InputError
from damian.delays.laws import Law, law_of, sampler_of
from damian.delays.samplers import MessageContext, Sampler

_LOSS_DRAW = 3
"""Counter that tells the draw of a link's loss from those of its delay."""


class LinkSampler(Sampler):
    """Draws the delays of messages on the links between N agents, by a law and a loss for each link.

    Links are numbered receiver * N + sender; of the M messages of a step, message m belongs to link m modulo
    N * N. Every distinct law has one sampler, which draws for all links. The state of a channel is that of
    all samplers, side by side, [M, S].

    Args:
        samplers: one for each distinct law.
        law_index: index of each link's sampler, [N * N] long.
        loss: probability that a message of each link is lost, beside what its sampler loses, [N * N].
    """

    _law_index: Tensor
    _loss: Tensor

    def __init__(self, samplers: Sequence[Sampler], law_index: Tensor, loss: Tensor) -> None:
        longest = max(sampler.longest for sampler in samplers)
        super().__init__([[0.0] * (longest + 1)])  # the worst case: every message may be lost
        self.certain = None
        self.samplers = nn.ModuleList(samplers)
        self.sees_context = any(sampler.sees_context for sampler in samplers)
        self.reads = tuple(dict.fromkeys(name for sampler in samplers for name in sampler.reads))
        self._loses = bool((loss > 0).any())
        example = torch.zeros(1, dtype=torch.long)
        self._state_shapes = [sampler.initial_state(example).shape[1:] for sampler in samplers]
        self.register_buffer("_law_index", law_index, persistent=False)
        self.register_buffer("_loss", loss, persistent=False)

    def initial_state(self, streams: Tensor) -> Tensor:
        return _side_by_side([sampler.initial_state(streams) for sampler in self._samplers])

    def begin_episode(self, memory: Tensor, mask: Tensor) -> Tensor:
        """The states [M, S] of channels, before the first message of an episode where the mask is true."""
        pairs = zip(self._samplers, self._states(memory), strict=True)
        return _side_by_side([sampler.begin_episode(state, mask) for sampler, state in pairs])

    def try_context(self, context: MessageContext) -> None:
        for sampler in self._samplers:
            sampler.try_context(context)

    def forward(
        self, streams: Tensor, clock: Tensor, memory: Tensor, context: MessageContext | None = None
    ) -> tuple[Tensor, Tensor]:
        index, delay, states = self._of_links(self._law_index, streams), torch.zeros_like(streams), []
        for k, (sampler, state) in enumerate(zip(self._samplers, self._states(memory), strict=True)):
            own = streams_for(sampler, streams, len(self._law_index))
            drawn, turned = sampler(own, clock, state, context)
            drawn = torch.where(drawn < sampler.lost, drawn, self.lost)
            delay = torch.where(index == k, drawn, delay)
            states.append(turned)
        if self._loses:
            draw = counter_rng.uniform(streams, clock, torch.full_like(clock, _LOSS_DRAW))
            delay = torch.where(draw < self._of_links(self._loss, streams), self.lost, delay)
        return delay, _side_by_side(states)

    @property
    def _samplers(self) -> list[Any]:
        return list(self.samplers)

    def _states(self, memory: Tensor) -> list[Tensor]:
        """The state of each sampler, [M, ...]."""
        parts = memory.split([shape.numel() for shape in self._state_shapes], -1)
        pairs = zip(parts, self._state_shapes, strict=True)
        return [part.reshape(len(part), *shape) for part, shape in pairs]

    def _of_links(self, values: Tensor, streams: Tensor) -> Tensor:
        """Repeat values of links [N * N] for M messages."""
        return values.repeat(len(streams) // len(values))


def _side_by_side(states: list[Tensor]) -> Tensor:
    return torch.cat([state.reshape(len(state), -1) for state in states], -1)


def link_sampler(delay: Any, loss: Any, dt: float = 1.0, key: str = "delay") -> Sampler:
    """Build the sampler of a law for all links, or of a law or a loss for each link.

    Args:
        delay: what ``law_of`` takes, or an N x N nested list of it (receiver, sender); its diagonal is not
            used.
        loss: probability that a message is lost, or an N x N nested list or tensor of it.
        dt: length of a step [s].
        key: name of the delay, for errors.

    Raises:
        InputError: a law or a probability is invalid, or the two are of different sizes.
    """
    n = same_size({key: delay, "loss": loss})
    if n is None:
        return sampler_of(law_of(delay, key), dt, loss, key)
    laws = _laws_of_links(delay, n, key)
    distinct: list[Law] = []
    samplers: list[Sampler] = []
    for name, law in laws:
        if law not in distinct:
            distinct.append(law)
            samplers.append(sampler_of(law, dt, key=name))
    index = torch.tensor([distinct.index(law) for _, law in laws])
    check_losses("loss", loss)
    losses = torch.as_tensor(loss, dtype=torch.float64).expand(n, n)
    return LinkSampler(samplers, index, losses.flatten().clone())


def check_losses(key: str, loss: Any) -> None:
    """Require a probability, or a nested list or tensor of one for each link.

    Raises:
        InputError: one is not between 0 and 1; the error names the link, as ``links.loss[0][1]``.
    """
    if not is_matrix(loss):
        checks.in_range(key, loss, 0.0, 1.0)
        return
    for i, row in enumerate(loss.tolist() if isinstance(loss, Tensor) else loss):
        for j, probability in enumerate(row):
            checks.in_range(f"{key}[{i}][{j}]", probability, 0.0, 1.0)


def same_size(settings: Mapping[str, Any]) -> int | None:
    """The number N of agents of those settings that are N x N, by name; None if none is.

    Raises:
        InputError: one is not square, or they are of different sizes.
    """
    sizes = {key: _matrix_size(key, value) for key, value in settings.items() if is_matrix(value)}
    if len(set(sizes.values())) > 1:
        found = ", ".join(f"{key} {n} x {n}" for key, n in sizes.items())
        raise InputError(f"{found}: these are of different numbers of agents")
    return next(iter(sizes.values()), None)


def streams_for(sampler: Sampler, streams: Tensor, n_rows: int) -> Tensor:
    """The random streams [M] from which a sampler draws, if a world has so many rows.

    A sampler whose draws are ``shared`` draws the same numbers for all rows of a world.
    """
    if not sampler.shared:
        return streams
    return streams.view(-1, n_rows)[:, :1].expand(-1, n_rows).reshape(-1)


def is_matrix(value: Any) -> bool:
    """Is a setting given for each link."""
    if isinstance(value, Tensor):
        return value.dim() > 0
    return isinstance(value, Sequence) and not isinstance(value, str)


def _matrix_size(key: str, matrix: Any) -> int:
    lengths = [len(row) if is_matrix(row) else 0 for row in matrix]
    problem = "is not N x N: a list for each receiver, with an entry for each sender"
    checks.require(bool(lengths) and set(lengths) == {len(lengths)}, key, matrix, problem)
    return len(lengths)


def _laws_of_links(delay: Any, n: int, key: str) -> list[tuple[str, Law]]:
    """Name and law of each of the n * n links, of a law or an n x n nested list of laws."""
    if not is_matrix(delay):
        return [(key, law_of(delay, key))] * (n * n)
    links = {(i, j): f"{key}[{i}][{j}]" for i in range(n) for j in range(n)}
    return [(name, law_of(0 if i == j else delay[i][j], name)) for (i, j), name in links.items()]
