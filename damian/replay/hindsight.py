"""Finds the newest message that the server can use for each past step
(back-updating; paper, section 3.4).

Pure functions of T consecutive steps. A message that is generated at step g with a delay of d steps
is available from step g + d on, even if its episode has ended meanwhile.
"""

import torch
from torch import Tensor

from damian.common.tensors import expand_mask, gather_rows


def latest_arrived(sent: Tensor, delay: Tensor, held: Tensor, age: Tensor) -> tuple[Tensor, Tensor]:
    """For each of T steps, the newest message sent in its episode that has arrived by the last
    step.

    It returns the messages, [T, *, M], and the age of each at its step [steps], [T, *]. To miss
    none, the steps must begin earlier than the first one of interest, by the longest delay.

    Args:
        sent: the message sent after each step, [T, *, M]; arbitrary numbers if none was sent.
        delay: of the message sent [steps], [T, *]; -1 if it never arrives, or if none was sent.
        held: the message that the server held after each step, [T, *, M].
        age: of the message held [steps], [T, *].
    """
    steps = _steps(delay)
    arrived = arrived_by_now(delay, len(steps) - 1 - steps)
    none = torch.iinfo(
        steps.dtype
    ).min  # older than any held message, even one older than these steps
    newest = torch.where(arrived, steps, none).cummax(0).values
    # With ``order=arrival`` the server may have held a newer message at an earlier step.
    newest_held, held_at = (steps - age).cummax(0)
    # A message of an earlier episode is never newer than the held one.
    came_late = newest > newest_held
    latest = torch.where(
        came_late.unsqueeze(-1), _at(sent, newest.clamp(min=0)), _at(held, held_at)
    )
    return latest, steps - torch.maximum(newest, newest_held)


def arrived_by_now(delay: Tensor, since: Tensor) -> Tensor:
    """Whether messages of delays [K, ...] (-1: never), sent ``since`` [K, ...] steps ago, have
    arrived."""
    return (delay >= 0) & (delay <= expand_mask(since, delay))


def ended_before(ended: Tensor, begins: Tensor, already: Tensor) -> Tensor:
    """Whether each step's episode had ended earlier, [T, *]; that of the first step ``already``
    [*]."""
    ends = torch.where(ended, _steps(ended), -1)
    before = torch.cat([already.unsqueeze(0).long() - 1, ends[:-1]]).cummax(0).values
    return (
        before >= torch.where(begins, _steps(begins), 0).cummax(0).values
    )  # the first step of each episode


def _steps(like: Tensor) -> Tensor:
    """Index of each step, 0, 1, ..., T - 1, expanded to [T, *]."""
    steps = torch.arange(len(like), device=like.device)
    return steps.view(-1, *[1] * (like.dim() - 1)).expand(like.shape)


def _at(rows: Tensor, step: Tensor) -> Tensor:
    """``rows[step[t, *], *]`` for every t and *, [T, *, M]."""
    column = torch.arange(step[0].numel(), device=step.device).view_as(step[0])
    return gather_rows(rows.flatten(0, -2), step * column.numel() + column)
