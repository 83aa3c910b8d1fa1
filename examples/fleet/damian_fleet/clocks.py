"""Leaves out reports that tell the time of a wrong clock."""

import pandas as pd

from damian.delays.clocks import are_right, in_order, note_on
from damian.delays.logs import delays_of
from damian_fleet.reports import Rows


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
    return {*messages.index[~right]}, delays_of(messages, right)
