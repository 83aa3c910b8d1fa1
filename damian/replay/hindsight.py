"""What the server can know of the past, once late messages have arrived (SPEC 4, back-updating).

Pure functions over time: T steps, any batch dimensions behind them. A message that was generated at step g
and takes d steps is known from step g + d on, also if the episode has ended meanwhile.
"""

from typing import NamedTuple

import torch
from torch import Tensor


class Mail(NamedTuple):
    """Messages of T consecutive steps."""

    sent: Tensor
    """Sent after each step, [T, *, F]; whatever, if there was none."""
    delay: Tensor
    """Steps until it arrives, [T, *]; -1 if it never does, or if there is none."""
    held: Tensor
    """Held by the server after each step, [T, *, F]."""
    age: Tensor
    """Steps since that was generated, [T, *]."""


def hindsight(mail: Mail, now: int | None = None) -> Tensor:
    """For each step, the newest message of its episode up to it that has arrived by ``now``, [T, *, F].

    What has arrived is what was held at some time, and what was sent within these steps: to miss nothing,
    they must begin a largest delay before the first step of interest.

    Args:
        mail: what was sent, and held.
        now: a step; the last one, if not given. Nothing that arrives later is used.
    """
    steps = _steps(mail.delay)
    known = (mail.delay >= 0) & (steps + mail.delay <= (len(steps) - 1 if now is None else now))
    newest = torch.where(known, steps, -1).cummax(0).values
    # Under ``order=arrival`` the server may have held something newer before.
    held, held_at = (steps - mail.age).cummax(0)
    late = newest > held  # never of an earlier episode, of which nothing is as new as what is held
    return torch.where(late.unsqueeze(-1), _at(mail.sent, newest.clamp(min=0)), _at(mail.held, held_at))


def beginnings(begins: Tensor) -> Tensor:
    """The step with which each step's episode begins, [T, *]; 0 if that was before."""
    return torch.where(begins, _steps(begins), 0).cummax(0).values


def over_before(ended: Tensor, begins: Tensor, already: Tensor) -> Tensor:
    """Had the episode of each step ended before it, [T, *] bool.

    Args:
        ended: does it end with this step, as one knows now, [T, *].
        begins: does an episode really begin with this step, [T, *].
        already: had that of the first step, [*].
    """
    ends = torch.where(ended, _steps(ended), -1)
    before = torch.cat([already.unsqueeze(0).long() - 1, ends[:-1]]).cummax(0).values
    return before >= beginnings(begins)


def _steps(like: Tensor) -> Tensor:
    """0, 1, ..., T - 1 in the shape [T, *]."""
    steps = torch.arange(len(like), device=like.device)
    return steps.view(-1, *[1] * (like.dim() - 1)).expand(like.shape)


def _at(rows: Tensor, step: Tensor) -> Tensor:
    """``rows[step[t, *], *]`` for every t and *, [T, *, F]."""
    return rows.gather(0, step.unsqueeze(-1).expand_as(rows))
