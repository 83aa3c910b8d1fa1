"""Finds the newest message that the server can use for each past step (back-updating; paper, section 3.4).

Pure functions of T consecutive steps. A message that is generated at step g with a delay of d steps is
available from step g + d on, even if its episode has ended meanwhile.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from damian.common.tensors import expand_mask


class MessageLog(NamedTuple):
    """Messages sent and held at T consecutive steps."""

    sent: Tensor
    """The message sent after each step, [T, *, M]; arbitrary numbers if none was sent."""
    delay: Tensor
    """Delay of the message sent [steps], [T, *]; -1 if it never arrives, or if none was sent."""
    held: Tensor
    """The message that the server held after each step, [T, *, M]."""
    age: Tensor
    """Age of the message held [steps], [T, *]."""


def latest_arrived(log: MessageLog, now: int | None = None) -> tuple[Tensor, Tensor]:
    """For each step, the newest message sent in its episode that has arrived by step ``now`` (the last).

    It returns the messages, [T, *, M], and the age of each at its step [steps], [T, *]. To miss none, the log
    must begin earlier than the first step of interest, by the longest delay.
    """
    steps = _steps(log.delay)
    arrived = arrived_by_now(log.delay, (len(steps) - 1 if now is None else now) - steps)
    none = torch.iinfo(steps.dtype).min  # older than any held message, even one older than these steps
    newest = torch.where(arrived, steps, none).cummax(0).values
    # With ``order=arrival`` the server may have held a newer message at an earlier step.
    newest_held, held_at = (steps - log.age).cummax(0)
    # A message of an earlier episode is never newer than the held one.
    came_late = newest > newest_held
    latest = torch.where(came_late.unsqueeze(-1), _at(log.sent, newest.clamp(min=0)), _at(log.held, held_at))
    return latest, steps - torch.maximum(newest, newest_held)


def arrived_by_now(delay: Tensor, since: Tensor) -> Tensor:
    """Whether messages of delays [K, ...] (-1: never), sent ``since`` [K, ...] steps ago, have arrived."""
    return (delay >= 0) & (delay <= expand_mask(since, delay))


def ended_before(ended: Tensor, begins: Tensor, already: Tensor) -> Tensor:
    """Whether each step's episode had ended earlier, [T, *]; that of the first step ``already`` [*]."""
    ends = torch.where(ended, _steps(ended), -1)
    before = torch.cat([already.unsqueeze(0).long() - 1, ends[:-1]]).cummax(0).values
    return before >= torch.where(begins, _steps(begins), 0).cummax(0).values  # the first step of each episode


def _steps(like: Tensor) -> Tensor:
    """Index of each step, 0, 1, ..., T - 1, expanded to [T, *]."""
    steps = torch.arange(len(like), device=like.device)
    return steps.view(-1, *[1] * (like.dim() - 1)).expand(like.shape)


def _at(rows: Tensor, step: Tensor) -> Tensor:
    """``rows[step[t, *], *]`` for every t and *, [T, *, M]."""
    return rows.gather(0, step.unsqueeze(-1).expand_as(rows))
