"""The delays of real reports, and those that never came in, as a trace to replay and as the law that fits."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from damian.common.errors import InputError
from damian.common.plotting import COLOURS
from damian.common.text_files import named
from damian.delays.clocks import Flags, are_right, in_order, notes_of
from damian.delays.law_fit import LOST_STEPS, NO_MESSAGE, Integers, LawFit
from damian.delays.laws import LOST, in_steps
from damian.field.journal import SUFFIX, read_journal
from damian.field.rows import Rows, read_file

LONGEST_GAP = 1000
"""Most messages that are taken as lost between two that came in: longer gaps are pauses."""


def read_log(path: Path) -> pd.DataFrame:
    """The log in a journal, or in a table with a column ``receive time``, as of ``damian.delays.clocks``."""
    if path.suffix == SUFFIX:
        _, lines = read_journal(path)
        rows = [(where, report) for where, line in lines for report in line.reports]
    else:
        with named(path):
            rows = [(f"{path}: {where}", report) for where, report in read_file(path)]
        for where, report in rows:
            said = report.model_fields_set
            if "time" not in said or not {"received", "aoi"} & said:
                raise InputError(f"{where}: it needs time and receive time, or time and AoI")
            report.stamp(math.nan, file=True)
    if len(rows) < 2:
        raise InputError(f"{path}: {len(rows)} reports are too few to tell how late they are")
    return log_of(rows)


def log_of(rows: Rows) -> pd.DataFrame:
    """Reports that say when they came in as a log."""
    columns = ["where", "uav", "time", "received", "sequence"]
    cells = [(where, each.id, each.time, each.received, each.sequence) for where, each in rows]
    return pd.DataFrame(cells, columns=columns).astype({"sequence": float})


def fit(messages: pd.DataFrame, right: Flags) -> pd.DataFrame:
    """A row for each message from a right clock, in the order of ``in_order``, whose columns these are.

    Columns: ``uav`` (ID), ``time`` when it was generated [s], ``received`` when it came in first [s], and its
    ``delay`` [s], 0 if clocks differ a little, so that it came in before its time; the last two are nan for a
    message that never came in, whose time is estimated: one whose number is missing. Where a UAV does not
    number its reports, no loss can be seen.
    """
    told = messages.assign(right=right).drop_duplicates(["uav", "run", "time", "sequence", "right"])
    parts = []
    for uav, own in told.groupby("uav"):
        gaps = own.groupby("run").sequence.diff().sub(1).fillna(0)
        rows = np.arange(len(own)) + gaps.where(gaps <= LONGEST_GAP, 0).cumsum().to_numpy(int)
        every = own.set_index(rows)[["time", "received", "right"]].reindex(range(rows[-1] + 1))
        counts = every.right.bfill().astype(bool)  # what was lost before a message counts if that does
        time = every.time.where(counts).interpolate(limit_direction="both")
        part = every.assign(uav=uav, time=time)[counts].drop(columns="right")
        parts.append(part.sort_values("time", kind="stable") if own.sequence.isna().all() else part)
    fitted = pd.concat(parts, ignore_index=True)
    return fitted.assign(delay=(fitted.received - fitted.time).clip(lower=0))


def wrong_clocks(rows: Rows) -> tuple[set[int], pd.DataFrame]:
    """Which reports tell the time of a wrong clock, which is printed, and the others as of ``fit``.

    Of a UAV whose clock was never right, what it says counts.
    """
    messages = in_order(log_of(rows))
    right = are_right(messages)
    right |= ~pd.Series(right, messages.index).groupby(messages.uav).transform("any").to_numpy(bool)
    for note in notes_of(messages, right):
        print(f"note: {note}, which are left out")
    return {*messages.index[~right]}, fit(messages, right)


def check_clocks(messages: pd.DataFrame, right: Flags, path: Path) -> None:
    """Refuse a log with a sender whose clock was never right."""
    for uav, late in (messages.received - messages.time).groupby(messages.uav):
        if not right[(messages.uav == uav).to_numpy()].any():
            typical = late.median()
            raise InputError(
                f"{path}: the clocks of {uav} and of the receiver differ: receive times are in the median "
                f"{abs(typical):.3g} s {'before' if typical < 0 else 'after'} times; correct one of them"
            )


def trace_rows(messages: pd.DataFrame) -> list[str]:
    """The column ``delay`` of a trace, a row for each message: times, which a simulation rounds up."""
    return [LOST if math.isnan(delay) else f"{delay:.6f}s" for delay in messages.delay]


def steps_of(messages: pd.DataFrame, dt: float) -> Integers:
    """Delays of the messages of each UAV in whole steps of ``dt`` seconds, for ``fit_laws``, [U, T]."""
    steps = [LOST_STEPS if row == LOST else in_steps("delay", row, dt) for row in trace_rows(messages)]
    table = pd.DataFrame({"uav": messages.uav, "n": messages.groupby("uav").cumcount(), "steps": steps})
    return table.pivot(index="uav", columns="n", values="steps").fillna(NO_MESSAGE).to_numpy(int)


def summary(messages: pd.DataFrame) -> str:
    """The fitted delays and losses as text, with a line about those that came in before their time."""
    delays, n, time = messages.delay.dropna(), len(messages), messages.time
    n_lost, early = n - len(delays), (time - messages.received)[messages.received < time]
    median, most, nearly_all = np.quantile(delays, [0.5, 0.9, 0.99])
    problem = "came in before their time, because clocks differ, and count as 0 s late; the earliest by"
    clocks = f"\n{len(early)} {problem} {early.max():.3g} s" if len(early) else ""
    return (
        f"{n} messages of {messages.uav.nunique()} UAVs over {time.max() - time.min():.0f} s; lost: {n_lost} "
        f"({n_lost / n:.1%})\n"
        f"delay [s]: mean {delays.mean():.3f}, median {median:.3f}, 90 % {most:.3f}, 99 % {nearly_all:.3f}, "
        f"longest {delays.max():.3f}{clocks}"
    )


def law_summary(best: LawFit, own: LawFit, dt: float) -> str:
    """The law that ``fit_laws`` finds as settings, and what of the delays it does not repeat, as text."""
    other, gain = np.abs(best.chances - own.chances).sum() / 2, (own.likelihood - best.likelihood) / best.n
    law, loss = str(best.written).replace("'", ""), f" delay.loss={best.loss}" * (best.loss > 0)
    text = f'best law: "delay.obs={law}"{loss} clock.simulation={dt:g}s\n'
    text += f"it gives {other:.1%} of the messages another delay; "
    text += f"{own.written} are likelier by {gain:.3f} nats a message"
    if best.bic - own.bic > 10:  # very strong evidence (Kass and Raftery, 1995)
        text += "\na bad fit: take the trace"
    return text


def plot_fit(messages: pd.DataFrame, law: LawFit, dt: float, path: Path) -> None:
    """Draw the share of the messages that are later than a delay, or lost: survival curves.

    The law has a point at whole steps of ``dt`` seconds, to which a simulation rounds delays up.
    """
    from damian.compare.figures import save  # noqa: PLC0415 (slow to import, needed once)

    delays = np.sort(messages.delay.dropna())
    recorded = 1 - np.arange(len(delays) + 1) / len(messages)
    later, lost = 1 - law.chances[:-1].cumsum(), law.chances[-1]
    shown = later > max(lost, 0.1 / len(messages))  # rounding leaves a rest where nothing is later

    def panel(axis: Any, _: str) -> None:
        axis.step([0, *delays], recorded, where="post", color=COLOURS[0], label="recorded")
        name = law.written["law"] if isinstance(law.written, dict) else "constant"
        style: Any = {"markersize": 4, "color": COLOURS[1], "label": f"best law: {name}"}
        axis.plot(np.arange(len(later))[shown] * dt, later[shown], "o", **style)
        axis.set(xlabel="delay [s]", ylabel="share of messages later, or lost", yscale="log")
        if lost:
            axis.axhline(lost, color="0.5", linestyle=":", label="lost")

    save(path, ["fit"], panel, (4.2, 3.0))
