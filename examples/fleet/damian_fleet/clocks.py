"""Leaves out reports that tell the time of a wrong clock, as numbers, times and receive times
show."""

import math

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from damian.common.text_files import listed
from damian.delays.clocks import AGREE, LATEST_MEDIAN, UNSET, in_order
from damian.delays.logs import delays_of
from damian_fleet.reports import Rows

WINDOW = 10
"""Messages before and after a step of a clock that must show it, where numbers do not."""

Floats = NDArray[np.floating]
Flags = NDArray[np.bool_]


def wrong_clocks(rows: Rows) -> tuple[set[int], pd.DataFrame]:
    """Which reports tell the time of a wrong clock, which is printed, and the others as of
    ``delays_of``.

    Of a UAV whose clock was never right, what it says counts.
    """
    columns = ["where", "uav", "time", "received", "sequence"]
    cells = [(where, each.id, each.time, each.received, each.sequence) for where, each in rows]
    messages = in_order(pd.DataFrame(cells, columns=columns).astype({"sequence": float}))
    right = are_right(messages)
    right |= ~right.groupby(messages.uav).transform("any")
    if not right.all():
        print(note_on(messages, right))
    never = math.inf  # marks what is left out: the time of a lost message depends on its place
    told = messages.assign(
        time=messages.time.where(right),
        received=messages.received.where(right, never),
    )
    delays = delays_of(told)
    return {*messages.index[~right]}, delays[delays.received != never]


def are_right(messages: pd.DataFrame) -> pd.Series:
    """Whether the clock of its sender was right, for each message of ``in_order``.

    Where it was right, the least late messages are about as late as those of any part of the log,
    and a part lasts from one step of the clock to the next.
    """
    right = pd.Series(False, messages.index)
    is_set = messages.received - messages.time <= UNSET
    for _, own in messages[is_set].groupby("uav"):
        right[own.index] = _right(own)
    return right


def _right(own: pd.DataFrame) -> Flags:
    """The same for a sender whose clock was set."""
    late = (own.received - own.time).reset_index(drop=True)
    part = np.cumsum(_steps(own))
    is_plausible = late.groupby(part).median().between(0, LATEST_MEDIAN)
    comes_before_its_time = late < -AGREE
    least = late.mask(comes_before_its_time).groupby(part).min()
    is_right = is_plausible & (least <= least[is_plausible].min() + AGREE)
    return is_right[part].to_numpy() & ~comes_before_its_time.to_numpy()


def _steps(own: pd.DataFrame) -> Flags:
    """Where the clock of a sender seems to have been set: between a message and the one before
    it."""
    time = own.time.to_numpy()
    received = own.received.to_numpy()
    steps = np.zeros(len(own), bool)
    if own.sequence.notna().all():
        is_behind = time < np.maximum.accumulate(time) - AGREE
        steps[1:] = (np.diff(time) < -AGREE) | np.diff(is_behind)
    if len(own) >= 2 * WINDOW:
        number = own.sequence.diff().where(own.run.diff() == 0).fillna(1).to_numpy()
        steps[WINDOW : len(own) - WINDOW + 1] |= _level_steps(received - time, received, number)
    return steps


def _level_steps(late: Floats, received: Floats, number: Floats) -> Flags:
    """Where delays are level before, level after, and different, though messages came in as
    regularly.

    If it was the link that got slower or faster, messages would have come in later or sooner than
    usual.
    """
    lates, times = (sliding_window_view(values, WINDOW) for values in (late, received))
    level = np.median(lates, 1)
    spread = np.ptp(lates, 1)
    span = np.ptp(times, 1)
    before = slice(None, -WINDOW)
    after = slice(WINDOW, None)
    step = np.abs(level[after] - level[before])
    is_level = (
        np.maximum(spread[before], spread[after])
        < np.minimum(step, np.minimum(span[before], span[after])) / 2
    )
    gaps = np.diff(received)
    usual = np.median(sliding_window_view(gaps, 2 * WINDOW - 1), 1)
    gap = gaps[WINDOW - 1 : len(gaps) - WINDOW + 1]
    comes_as_usual = np.abs(gap - usual * number[WINDOW : len(late) - WINDOW + 1]) < step / 2
    return (step > AGREE) & is_level & comes_as_usual


def note_on(messages: pd.DataFrame, right: pd.Series) -> str:
    """A line about stretches of messages from wrong clocks: where each begins, whose it is, and how
    wrong."""
    late = messages.received - messages.time
    typical = late[right].groupby(messages.uav).median()
    begins = (messages.uav != messages.uav.shift()) | (right != right.shift())
    places = []
    for _, part in messages[~right].groupby(begins.cumsum()):
        (where, uav), n = part[["where", "uav"]].iloc[0], len(part)
        behind = late[part.index].median() - typical.get(uav, 0.0)
        wrong = f"{abs(behind):.3g} s {'behind' if behind > 0 else 'ahead'}"
        places.append(f"{where}: the clock of {uav} is {wrong} in {n} messages from here on")
    return f"note: {listed(places)}: they are left out"
