"""Where the source is, as far as messages tell: a Bayes filter over the cells of a ``SourceGrid``.

All functions are pure and batched. One step of the filter moves the probability as the source may have moved,
and weighs it with how likely each cell makes what the UAVs have reported of that step. Messages may arrive
late, out of order or never: a belief is exact for the messages that have arrived, if the filter runs again
over all steps since the oldest of those that came in late (``damian.transforms.Belief``).
"""

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag, one_hot

from damian.common.tensors import gather_rows
from damian.server.source_grid import SourceGrid
from damian.world.messages import Messages

_LEAST = 1e-20
"""Added to every likelihood, so that reports which no cell makes possible change nothing."""


def repeated(grid: SourceGrid, rows: Tensor, before: Tensor) -> Tensor:
    """The rows, with those that are as in the step before marked as repeated, [*, N].

    Args:
        grid: cells and tables.
        rows: rows of ``SourceGrid.log_reports``, [*, N].
        before: the rows of the same UAVs one step before, [*, N].
    """
    same = (rows == before) & (rows != grid.no_report)
    return torch.add(rows, same, alpha=grid.no_report // 2)  # takes a third of the time of ``where``


def report_rows(grid: SourceGrid, messages: Messages, sent: Tensor) -> Tensor:
    """Rows of ``SourceGrid.log_reports`` for messages, [*, N]; a UAV in flight detects nothing.

    Args:
        grid: cells and tables.
        messages: the latest message of each UAV, [*, N].
        sent: which of them were sent in this step, [*, N] bool.
    """
    row = 2 * messages.trail[..., 0] + messages.spotted
    return torch.where(sent & ~messages.in_flight, row, grid.no_report)


def likelihood(grid: SourceGrid, rows: Tensor) -> Tensor:
    """Probability of N reports of one step by the cell of the source, [*, K].

    Args:
        grid: cells and tables.
        rows: rows of ``SourceGrid.log_reports``, [*, N].
    """
    log = embedding_bag(rows.flatten(0, -2), grid.log_reports, mode="sum")  # gathers and sums at once
    match = log.exp_().view(*rows.shape[:-1], log.shape[-1])
    if grid.emits < 1:
        silent = ~(rows % 2 == 1).any(-1, keepdim=True)  # the row of no report is even
        match = grid.emits * match + (1 - grid.emits) * silent
    return match.add_(_LEAST)


def predict(grid: SourceGrid, belief: Tensor, region: Tensor) -> Tensor:
    """The belief one step later, before any message of that step, [*, K].

    Args:
        grid: cells and tables.
        belief: probability of each cell, [*, K].
        region: index of the region, [*].
    """
    if grid.moves is None:
        return belief
    if len(grid.prior) == 1:  # the moves are probabilities
        return belief @ grid.moves
    moved = (belief / gather_rows(grid.staying, region)) @ grid.moves
    return moved * (gather_rows(grid.prior, region) > 0)


def weigh(predicted: Tensor, likely: Tensor) -> Tensor:
    """The belief after the messages of a step, [*, K].

    Args:
        predicted: the belief before them, [*, K].
        likely: their ``likelihood``, [*, K].
    """
    weighed = predicted * likely
    return weighed.div_(weighed.sum(-1, keepdim=True))


def first_belief(grid: SourceGrid, rows: Tensor, region: Tensor) -> Tensor:
    """The belief at the beginning of an episode, when everyone's first message is known, [*, K].

    Args:
        grid: cells and tables.
        rows: rows of ``SourceGrid.log_reports`` for the first messages (``report_rows``), [*, N].
        region: index of the region, [*].
    """
    return weigh(gather_rows(grid.prior, region), likelihood(grid, rows))


def certain_belief(grid: SourceGrid, source: Tensor) -> Tensor:
    """The belief of somebody who knows the cell in which the source is, [*, K].

    Args:
        grid: cells and tables.
        source: position of the source, east, north [m], [*, 2].
    """
    return one_hot(torch.cdist(source, grid.centres).argmin(-1), len(grid.centres)).to(source.dtype)


def detection_chance(grid: SourceGrid, belief: Tensor, region: Tensor) -> Tensor:
    """Probability that a UAV which lands on a landing point of the region next detects the source, [*, L].

    Args:
        grid: cells and tables.
        belief: probability of each cell now, one step before the landing, [*, K].
        region: index of the region, [*].
    """
    if len(grid.prior) == 1:
        return belief @ grid.next_detection.T
    here = gather_rows(grid.next_detection.view(len(grid.prior), -1, belief.shape[-1]), region)
    return (here @ belief.unsqueeze(-1)).squeeze(-1)


def chance_of_staying(grid: SourceGrid, belief: Tensor, rows: Tensor) -> Tensor:
    """Probability that a UAV which stays where it is detects the source in the next step, [*, N].

    That is less than for a UAV which lands there, if it has just detected nothing; and 0 for one in flight.

    Args:
        grid: cells and tables.
        belief: probability of each cell now, [*, K].
        rows: rows of ``SourceGrid.log_reports`` for what the UAVs report now, not marked as repeated, [*, N].
    """
    chance = gather_rows(grid.next_staying, rows.clamp(max=len(grid.next_staying) - 1))
    return chance.mul_(belief.unsqueeze(-2)).sum(-1)


@torch.library.custom_op("damian::entropy", mutates_args=())
def entropy(belief: Tensor) -> Tensor:
    """The entropy of each belief [*, K], in nats, [*]."""
    return belief.clamp(min=1e-12).log_().mul_(belief).sum(-1).neg_()


@entropy.register_fake
def _(belief: Tensor) -> Tensor:
    return belief.new_empty(belief.shape[:-1])
