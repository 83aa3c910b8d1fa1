"""The Bayes filter of the source again, plainly: one world, one receiver, from the start at every
step."""

from collections.abc import Sequence

import torch

Steps = Sequence[tuple[list[int], list[int]]]
"""For each step the rows of ``SourceGrid.log_reports`` that UAVs send, and the delays of these
messages."""


def belief(
    grid,
    place,
    first,
    steps,
    now,
    viewer=None,
):
    """Probability of each cell after the last of the steps, knowing what has arrived by step
    ``now``.

    ``place`` is the index of the tables of the source for its region.
    ``viewer`` is the UAV that knows its own messages at once; None is the server.
    """
    moves = moves_of(grid, place)
    probable = _weighed(grid, place, grid.prior[place].tolist(), first)
    before = first
    for sent_at, (rows, delays) in enumerate(steps, 1):
        moved = _moved(moves, probable)
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


def moves_of(grid, place):
    """Probabilities of the moves of a source from cell to cell, [C][C]; it stays in its region."""
    if grid.moves is None:
        return torch.eye(len(grid.centres)).tolist()
    inside = grid.moves[place * len(grid.moves) // len(grid.prior)] * (grid.prior[place] > 0)
    return (inside / inside.sum(-1, keepdim=True)).nan_to_num().tolist()


def _moved(moves, probable):
    return [
        sum(chance * to for chance, to in zip(probable, column, strict=True))
        for column in zip(*moves, strict=True)
    ]


def emission_of(grid, place):
    """Probability that a source emits in a step."""
    return 1.0 if grid.emits is None else float(grid.emits[place])


def _weighed(grid, place, probable, rows):
    emits = emission_of(grid, place)
    alarm = float(grid.false_alarm[place])
    reports = [grid.log_reports[row].exp().tolist() for row in rows]
    silent = 1.0
    for row in rows:
        silent *= alarm if row % 2 == 1 else 1.0 if row == grid.no_report else 1 - alarm
    weighed = []
    for cell, chance in enumerate(probable):
        heard = 1.0
        for report in reports:
            heard *= report[cell]
        weighed.append(chance * (emits * heard + (1 - emits) * silent))
    return [each / sum(weighed) for each in weighed]


def chance_at(grid, place, probable, point):
    """Probability of detecting the source in the next step from a landing point, by its flat id."""
    emits = emission_of(grid, place)
    detects = grid.log_reports[1 : grid.no_report // 2 : 2].exp()[point].tolist()
    moved = _moved(moves_of(grid, place), probable.tolist())
    total = sum(chance * found for chance, found in zip(moved, detects, strict=True))
    return emits * total + (1 - emits) * float(grid.false_alarm[place])
