"""Which messages the server can know of at past steps, once late ones have arrived (back-updating).

Pure functions over time: T steps, with any batch dimensions behind them. A message that is generated at step
g and takes d steps is known from step g + d on, even if its episode has ended meanwhile.
"""

from typing import NamedTuple

import torch
from torch import Tensor


class MessageLog(NamedTuple):
    """Messages of T consecutive steps."""

    sent: Tensor
    """The message sent after each step, [T, *, M]; arbitrary numbers if there was none."""
    delay: Tensor
    """Its delay [steps], [T, *]; -1 if it never arrives, or if there is none."""
    held: Tensor
    """The message that the server held after each step, [T, *, M]."""
    age: Tensor
    """Steps since that one was generated, [T, *]."""


def latest_arrived(log: MessageLog, now: int | None = None) -> Tensor:
    """For each step, the newest message of its episode up to it that has arrived by ``now``, [T, *, M].

    The messages that have arrived are those held at some step, and those sent within these steps: to miss
    none, the log must begin a longest delay before the first step of interest.

    Args:
        log: messages sent and held.
        now: a step, the last one if not given; no message that arrives later is used.
    """
    steps = _steps(log.delay)
    arrived = (log.delay >= 0) & (steps + log.delay <= (len(steps) - 1 if now is None else now))
    newest = torch.where(arrived, steps, -1).cummax(0).values
    # With ``order=arrival`` the server may have held a newer message before.
    held, held_at = (steps - log.age).cummax(0)
    late = newest > held  # never a message of an earlier episode: none is newer than the held one
    return torch.where(late.unsqueeze(-1), _at(log.sent, newest.clamp(min=0)), _at(log.held, held_at))


def episode_starts(begins: Tensor) -> Tensor:
    """The step with which each step's episode begins, [T, *]; 0 if it began before these steps."""
    return torch.where(begins, _steps(begins), 0).cummax(0).values


def ended_before(ended: Tensor, begins: Tensor, already: Tensor) -> Tensor:
    """Had the episode of each step ended before it, [T, *] bool.

    Args:
        ended: does the episode end with this step, as the server knows now, [T, *].
        begins: is this step the first after a reset, [T, *].
        already: had the episode of the first step ended before it, [*].
    """
    ends = torch.where(ended, _steps(ended), -1)
    before = torch.cat([already.unsqueeze(0).long() - 1, ends[:-1]]).cummax(0).values
    return before >= episode_starts(begins)


def _steps(like: Tensor) -> Tensor:
    """0, 1, ..., T - 1 in the shape [T, *]."""
    steps = torch.arange(len(like), device=like.device)
    return steps.view(-1, *[1] * (like.dim() - 1)).expand(like.shape)


def _at(rows: Tensor, step: Tensor) -> Tensor:
    """``rows[step[t, *], *]`` for every t and *, [T, *, M]."""
    return rows.gather(0, step.unsqueeze(-1).expand_as(rows))
