"""The state of B worlds: by name for the physics, as one row per world for resets and compilers."""

from typing import NamedTuple

import torch
from torch import Tensor

from damian.world.messages import Messages


class State(NamedTuple):
    """Everything that changes; B worlds, N UAVs."""

    seed: Tensor
    """The world's random stream, [B]."""
    episode: Tensor
    """Episodes begun, [B]."""
    initial_condition: Tensor
    """Number of the initial condition of the episode, [B]."""
    region: Tensor
    """[B]."""
    steps: Tensor
    """Elapsed in this episode, [B]."""
    origin: Tensor
    """Flat id of the landing point of departure, [B, N]."""
    goal: Tensor
    """Flat id of the landing point that the UAV stands on or is bound for, [B, N]."""
    elapsed: Tensor
    """Since the latest decision [s], [B, N]."""
    vertical: Tensor
    """Duration of takeoff, and of landing [s]; 0 if it holds, [B, N]."""
    cruise: Tensor
    """Duration of the level flight [s], [B, N]."""
    used: Tensor
    """Battery used so far on this flight [%], [B, N]."""
    position: Tensor
    """East, north, up [m], [B, N, 3]."""
    track: Tensor
    """Heading of the latest flight, clockwise from north [rad], [B, N]."""
    battery: Tensor
    """[%], [B, N]."""
    motions: Tensor
    """Motions since the UAV last spotted the source, holding included, [B, N]."""
    source: Tensor
    """East, north [m], [B, 2]."""
    source_over: Tensor
    """Has the source finished its walk, [B]."""
    message_sent: Tensor
    """Did the UAV send a message in this step, [B, N]."""
    sent: Messages
    """The latest message of each UAV, [B, N]."""


SEED, EPISODE, INITIAL_CONDITION = 0, 1, 2
"""Columns of these fields among a world's integers: the first of ``State``."""


class PackedState(NamedTuple):
    """A state as one row per world and type: few tensors to copy, to guard and to save."""

    floats: Tensor
    """[B, F]."""
    integers: Tensor
    """[B, I]."""
    flags: Tensor
    """[B, K]."""


class StateLayout:
    """Where each field of a state lies in its rows.

    Args:
        example: a state with the fields' shapes and types, for any number of worlds.
    """

    def __init__(self, example: State) -> None:
        self._fields = [(leaf.dtype, leaf.shape[1:]) for leaf in _leaves(example)]

    def pack(self, state: State) -> PackedState:
        """A state as rows."""
        leaves = [leaf.flatten(1) if leaf.dim() > 1 else leaf[:, None] for leaf in _leaves(state)]
        return PackedState(*[torch.cat([x for x in leaves if x.dtype == t], 1) for t in _TYPES])

    def unpack(self, rows: PackedState) -> State:
        """The state that the rows hold; its fields are views of them."""
        columns = {
            dtype: iter(table.split([shape.numel() for t, shape in self._fields if t == dtype], 1))
            for dtype, table in zip(_TYPES, rows, strict=True)
        }
        leaves = [
            next(columns[dtype]).unflatten(1, shape) if shape else next(columns[dtype]).squeeze(1)
            for dtype, shape in self._fields
        ]
        n = len(State._fields) - 1  # the message comes last
        return State._make([*leaves[:n], Messages._make(leaves[n:])])


_TYPES = (torch.float32, torch.int64, torch.bool)


def _leaves(state: State) -> list[Tensor]:
    """The tensors of a state, the message's last."""
    return [*state[:-1], *state.sent]
