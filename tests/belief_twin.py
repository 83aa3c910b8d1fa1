"""The Bayes filter of the source again, plainly: one world, one receiver, from the start at every
step."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from damian.server.belief import SourceGrid

Steps = Sequence[tuple[list[int], list[int]]]
"""For each step the rows of ``SourceGrid.log_reports`` that UAVs send, and the delays of these
messages."""


def belief(
    grid: SourceGrid,
    place: int,
    first: list[int],
    steps: Steps,
    now: int,
    viewer: int | None = None,
) -> list[float]:
    """Probability of each cell after the last of the steps, knowing what has arrived by step
    ``now``.

    ``place`` is the index of the tables of the source for its region.
    ``viewer`` is the UAV that knows its own messages at once; None is the server.
    """
    prior = grid.prior[place].tolist()
    moves = moves_of(grid, place)
    cells = range(len(prior))
    probable = _weighed(grid, place, prior, first)
    before = first
    for sent_at, (rows, delays) in enumerate(steps, 1):
        moved = [0.0] * len(prior)
        for a in cells:
            inside = [float(moves[a, b]) if prior[b] > 0 else 0.0 for b in cells]
            for b in cells:
                moved[b] += probable[a] * inside[b] / sum(inside) if probable[a] else 0.0
        known = [
            row if uav == viewer or (delay >= 0 and sent_at + delay <= now) else grid.no_report
            for uav, (row, delay) in enumerate(zip(rows, delays, strict=True))
        ]
        again = [
            row + grid.no_report // 2 if row == earlier != grid.no_report else row
            for row, earlier in zip(known, before, strict=True)
        ]
        probable = _weighed(grid, place, moved, again)
        before = known
    return probable


def moves_of(grid: SourceGrid, place: int) -> Tensor:
    """Weights of the moves of a source from cell to cell, [C, C]."""
    if grid.moves is None:
        return torch.eye(len(grid.centres))
    return grid.moves[place * len(grid.moves) // len(grid.prior)]


def emission_of(grid: SourceGrid, place: int) -> float:
    """Probability that a source emits in a step."""
    return 1.0 if grid.emits is None else float(grid.emits[place])


def _weighed(grid: SourceGrid, place: int, probable: list[float], rows: list[int]) -> list[float]:
    weighed = []
    emits = emission_of(grid, place)
    alarm = float(grid.false_alarm[place])
    for cell, chance in enumerate(probable):
        heard = 1.0
        silent = 1.0
        for row in rows:
            heard *= math.exp(float(grid.log_reports[row, cell]))
            silent *= alarm if row % 2 == 1 else 1.0 if row == grid.no_report else 1 - alarm
        weighed.append(chance * (emits * heard + (1 - emits) * silent))
    return [each / sum(weighed) for each in weighed]


def detection_table(grid: SourceGrid) -> Tensor:
    """Probability that a UAV on a landing point detects a source that emits in a cell, [P*L, C]."""
    return grid.log_reports[1 : grid.no_report // 2 : 2].exp()


def chance_at(grid: SourceGrid, place: int, probable: Tensor, point: int) -> float:
    """Probability of detecting the source in the next step from a landing point, by its flat id."""
    prior = grid.prior[place].tolist()
    total = 0.0
    detects = detection_table(grid)[point]
    moves = moves_of(grid, place)
    emits = emission_of(grid, place)
    for a, chance in enumerate(probable.tolist()):
        inside = {b: float(moves[a, b]) for b in range(len(prior)) if prior[b] > 0}
        if chance:
            total += sum(
                chance * w / sum(inside.values()) * float(detects[b]) for b, w in inside.items()
            )
    return emits * total + (1 - emits) * float(grid.false_alarm[place])
