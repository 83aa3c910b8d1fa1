"""The state of B worlds: named fields for the physics, one row per world for resets and
compilers."""

from typing import NamedTuple

import torch
from torch import Tensor

from damian.world.messages import ONE_SOURCE, Messages, Widths


class State(NamedTuple):
    """All variables of B worlds with N UAVs that change during an episode."""

    seed: Tensor
    """Seed of the world's random numbers, [B]."""
    episode: Tensor
    """Number of episodes begun, [B]."""
    initial_condition: Tensor
    """Number of the initial condition of the episode, [B]."""
    region: Tensor
    """Index of the region, [B]."""
    steps: Tensor
    """Simulation steps since the episode began, [B]."""
    origin: Tensor
    """Flat id of the landing point of departure, [B, N]."""
    goal: Tensor
    """Flat id of the landing point on which the UAV stands or to which it flies, [B, N]."""
    elapsed: Tensor
    """Simulation steps since the latest decision, [B, N]."""
    vertical: Tensor
    """Duration of takeoff, and of landing [s]; 0 if the UAV holds, [B, N]."""
    cruise: Tensor
    """Duration of the cruise [s]; 0 if the UAV holds, [B, N]."""
    cruise_before: Tensor
    """Duration of the cruise to where it was commanded [s], of a flight that then ends elsewhere;
    else 0, [B, N]."""
    air: Tensor
    """Way of the cruise through the air [m]; its length if there is no wind, [B, N]."""
    battery_before: Tensor
    """Battery level at the latest decision [%], [B, N]."""
    position: Tensor
    """Position of the UAV, east, north, up [m], [B, N, 3]."""
    track: Tensor
    """Heading of the latest flight, clockwise from north [rad], [B, N]."""
    battery: Tensor
    """Battery level, not rounded [%], [B, N]."""
    failed: Tensor
    """Whether the UAV has failed, [B, N]."""
    motions: Tensor
    """Motions (holding included) since the UAV last spotted the source, [B, N]."""
    source: Tensor
    """Positions of the sources, east, north [m], [B, K, 2]."""
    source_over: Tensor
    """Whether all sources have finished their walks, [B]."""
    requests: Tensor
    """The latest request of each slot, east, north [m], and when it appeared [s], [B, M, 3]."""
    drawn: Tensor
    """Values of the settings that are drawn for the episode, [B, D]."""
    message_sent: Tensor
    """Whether the UAV sent a message in this step, [B, N]."""
    sent: Messages
    """The latest message of each UAV, [B, N]."""


class Truth(NamedTuple):
    """What the environments' entry ``state`` tells, with any leading dimensions: the simulator's
    truth."""

    position: Tensor
    """Positions of the UAVs, east, north, up [m], [*, N, 3]."""
    battery: Tensor
    """Their battery levels [%], [*, N]."""
    emits: Tensor
    """Whether each source emits, [*, K] bool."""
    source: Tensor
    """Their positions, east, north [m], [*, K, 2]."""
    requests: Tensor
    """The latest request of each slot, east, north [m], and 1 while nobody has served it,
    [*, M, 3]."""
    drawn: Tensor
    """Values of the settings that are drawn for the episode (``randomise``), [*, D]."""

    def pack(self) -> Tensor:
        """One row for each world, [*, 4 N + 3 K + 3 M + D]."""
        parts = self.position.flatten(-2), self.battery, self.emits, self.source.flatten(-2)
        return torch.cat([*parts, self.requests.flatten(-2), self.drawn], -1)

    @classmethod
    def unpack(cls, rows: Tensor, widths: Widths = ONE_SOURCE, n_drawn: int = 0) -> "Truth":
        """The truth in rows [*, 4 N + 3 K + 3 M + D], with K sources and M requests as messages
        have."""
        k = widths.sources
        m = widths.requests
        n = (rows.shape[-1] - 3 * k - 3 * m - n_drawn) // 4
        parts = rows.split([3 * n, n, k, 2 * k, 3 * m, n_drawn], -1)
        position, battery, emits, source, requests, drawn = parts
        place = position.unflatten(-1, (n, 3))
        at = source.unflatten(-1, (k, 2))
        return cls(place, battery, emits > 0, at, requests.unflatten(-1, (m, 3)), drawn)


SEED, EPISODE, INITIAL_CONDITION = 0, 1, 2
"""Columns of these fields in ``PackedState.integers``; they are the first fields of ``State``."""


class PackedState(NamedTuple):
    """A state as one row per world and dtype, so that only three tensors are copied, compiled and
    saved."""

    floats: Tensor
    """All float32 fields, [B, F]."""
    integers: Tensor
    """All int64 fields, [B, I]."""
    flags: Tensor
    """All bool fields, [B, K]."""


class StateLayout:
    """The layout of a state's fields in its packed rows, read from an example of any number of
    worlds."""

    def __init__(self, example: State) -> None:
        self._fields = [(leaf.dtype, leaf.shape[1:]) for leaf in _leaves(example)]

    def pack(self, state: State) -> PackedState:
        """Pack a state into rows."""
        leaves = [leaf.flatten(1) if leaf.dim() > 1 else leaf[:, None] for leaf in _leaves(state)]
        return PackedState(*[torch.cat([x for x in leaves if x.dtype == t], 1) for t in _TYPES])

    def unpack(self, rows: PackedState) -> State:
        """Unpack a state from its rows; the fields are views of the rows."""
        columns = {
            dtype: iter(table.split([shape.numel() for t, shape in self._fields if t == dtype], 1))
            for dtype, table in zip(_TYPES, rows, strict=True)
        }
        parts = ((next(columns[dtype]), shape) for dtype, shape in self._fields)
        leaves = [part.unflatten(1, shape) if shape else part.squeeze(1) for part, shape in parts]
        n = len(State._fields) - 1  # the last field is the message
        return State._make([*leaves[:n], Messages._make(leaves[n:])])


_TYPES = (torch.float32, torch.int64, torch.bool)


def _leaves(state: State) -> list[Tensor]:
    """The tensors of a state; those of the message come last."""
    return [*state[:-1], *state.sent]
