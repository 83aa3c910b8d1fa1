"""The delays of real reports, and those that never came in, as a trace to replay and as the law that fits."""

import math
from collections.abc import Iterable, Sequence
from itertools import groupby, zip_longest
from pathlib import Path
from typing import NamedTuple

import numpy as np

from damian.common.errors import InputError
from damian.common.plotting import COLOURS
from damian.common.text_files import named
from damian.delays.law_fit import LOST_STEPS, NO_MESSAGE, Integers, LawFit, autocorrelation
from damian.delays.laws import LOST, in_steps
from damian.field.journal import SUFFIX, read_head, read_lines
from damian.field.rows import Report, TimedReport, read_file

REGULAR = 0.2
"""Share of a period by which the time between two reports may differ from whole periods."""
MOST = 0.8
"""Share of the times between reports that must be whole periods, for the reports to count as regular."""
LATEST_MEDIAN = 1800.0
"""Longest median delay of a UAV [s]; a longer one is a clock of another time zone, or one since the start."""
LONGEST_GAP = 1000
"""Most messages that are taken as lost between two that came in: longer gaps are pauses."""


class Message(NamedTuple):
    """A message of a UAV."""

    uav: str
    """ID of the UAV."""
    time: float
    """When it was generated [s]; estimated for one that never came in."""
    received: float | None
    """When it came in first [s]; None if it never did."""

    @property
    def delay(self) -> float:
        """How late it came in [s]; nan if it never did."""
        return max(self.difference, 0.0)  # stays nan

    @property
    def difference(self) -> float:
        """From its time to its receive time [s], below 0 if their clocks differ; nan if it never came in."""
        return math.nan if self.received is None else self.received - self.time


class Fit(NamedTuple):
    """Delays of messages."""

    messages: list[Message]
    """Those of one UAV after those of another, each in the order of their generation."""
    losses: str
    """How lost messages were found."""


def read_log(path: Path) -> list[Report]:
    """The reports of a journal, or of a table with a column ``receive time``; each says when it came in."""
    if path.suffix == SUFFIX or path.name.endswith(".ended"):
        read_head(path)
        reports = [report for _, line in read_lines(path) for report in line.reports]
    else:
        with named(path):
            rows = read_file(path, TimedReport)
            for where, report in rows:
                said = report.model_fields_set
                if "time" not in said or not {"received", "aoi"} & said:
                    raise InputError(f"{where}: it needs time and receive time, or time and AoI")
                report.stamp(math.nan, file=True)
        reports = [report for _, report in rows]
    if len(reports) < 2:
        raise InputError(f"{path}: {len(reports)} reports are too few to tell how late they are")
    return reports


def fit(reports: Iterable[Report]) -> Fit:
    """Delays of reports, and which are missing between them.

    Where reports of a UAV are numbered (``sequence``), a missing number is a lost message. Where they are
    not, but most come in whole periods, a gap of several periods has lost messages in it, unless the UAV was
    in the air, where it is silent. Else no loss can be seen.
    """
    found: list[Message] = []
    kinds: set[str] = set()

    def identity(report: Report) -> tuple[float, int]:  # a UAV that starts anew counts from 0
        return (report.time, -1 if report.sequence is None else report.sequence)

    by_uav = sorted(reports, key=lambda report: (report.id, *identity(report), report.received))
    for uav, own in groupby(by_uav, lambda report: report.id):
        first_copies = [next(copies) for _, copies in groupby(own, identity)]
        gaps, kind = _gaps(first_copies)
        kinds.add(kind)
        times = [report.time for report in first_copies]
        for i, report in enumerate(first_copies):
            if i and gaps[i - 1] <= LONGEST_GAP:
                between = np.linspace(times[i - 1], times[i], gaps[i - 1] + 2)[1:-1]
                found += [Message(uav, time, None) for time in between.tolist()]
            found.append(Message(uav, report.time, report.received))
    return Fit(found, " and ".join(sorted(kinds)))


def _gaps(reports: Sequence[Report]) -> tuple[list[int], str]:
    """Number of messages that are missing between each report and the next one, and how this was found."""
    numbers = [report.sequence for report in reports]
    if len(numbers) > 1 and all(number is not None for number in numbers):
        steps = np.diff(np.array(numbers, dtype=int))
        return (steps - 1).clip(min=0).tolist(), "by their numbers"  # a UAV that starts anew counts from 0
    between = np.diff([report.time for report in reports])
    if len(between) >= 2:
        period = float(np.median(between))
        periods = between / period
        regular = np.abs(periods - periods.round()) <= REGULAR
        if (regular & (periods.round() >= 1)).mean() >= MOST:
            missing = (periods.round().astype(int) - 1).clip(min=0)
            missing[[report.flies for report in reports[:-1]]] = 0
            return missing.tolist(), f"by their period of {period:.3g} s"
    return [0] * len(between), "not to be seen (no numbers, no period)"


def check_clocks(fitted: Fit, path: Path) -> None:
    """Refuse a log whose messages mostly came in before they were generated, or far too late."""
    for uav, own in groupby(fitted.messages, lambda message: message.uav):
        typical = float(np.nanmedian([message.difference for message in own]))
        if not 0 <= typical <= LATEST_MEDIAN:
            raise InputError(
                f"{path}: the clocks of {uav} and of the receiver differ: receive times are in the median "
                f"{abs(typical):.3g} s {'before' if typical < 0 else 'after'} times; correct one of them"
            )


def trace_rows(fitted: Fit) -> list[str]:
    """The column ``delay`` of a trace, a row for each message: times, which a simulation rounds up."""
    return [LOST if m.received is None else f"{m.delay:.6f}s" for m in fitted.messages]


def steps_of(fitted: Fit, dt: float) -> Integers:
    """Delays of the messages of each UAV in whole steps of ``dt`` seconds, for ``fit_laws``, [U, T]."""
    steps = (LOST_STEPS if row == LOST else in_steps("delay", row, dt) for row in trace_rows(fitted))
    by_uav = [[next(steps) for _ in own] for _, own in groupby(message.uav for message in fitted.messages)]
    return np.array([*zip_longest(*by_uav, fillvalue=NO_MESSAGE)]).T


def summary(fitted: Fit) -> str:
    """The fitted delays and losses as text, on two lines."""
    delays = np.array([m.delay for m in fitted.messages if m.received is not None])
    uavs, n = {message.uav for message in fitted.messages}, len(fitted.messages)
    times, n_lost = [message.time for message in fitted.messages], n - len(delays)
    median, most, nearly_all = np.quantile(delays, [0.5, 0.9, 0.99])
    early = [-message.difference for message in fitted.messages if message.difference < 0]
    problem = "came in before their time, because clocks differ, and count as 0 s late; the earliest by"
    clocks = f"\n{len(early)} {problem} {max(early):.3g} s" if early else ""
    return (
        f"{n} messages of {len(uavs)} UAVs over {max(times) - min(times):.0f} s; lost: {n_lost} "
        f"({n_lost / n:.1%}), {fitted.losses}\n"
        f"delay [s]: mean {delays.mean():.3f}, median {median:.3f}, 90 % {most:.3f}, 99 % {nearly_all:.3f}, "
        f"longest {delays.max():.3f}{clocks}"
    )


def law_summary(best: LawFit, own: LawFit, steps: Integers, dt: float) -> str:
    """The law that ``fit_laws`` finds as settings, and what of the delays it does not repeat, as text."""
    other, gain = np.abs(best.chances - own.chances).sum() / 2, (own.likelihood - best.likelihood) / best.n
    law, loss = str(best.written).replace("'", ""), f" delay.loss={best.loss}" * (best.loss > 0)
    text = f'best law: "delay.obs={law}"{loss} clock.simulation={dt:g}s\n'
    text += (
        f"it gives {other:.1%} of the messages another delay; {own.written} are likelier by {gain:.3f} nats "
    )
    text += f"a message; autocorrelation of delays {(alike := autocorrelation(steps)):.2f}"
    if alike > max(0.1, 4 / best.n**0.5):
        text += "\nlate messages come in bursts: no law without memory repeats them, only burst and the trace"
    if best.bic - own.bic > 10:  # very strong evidence (Kass and Raftery, 1995)
        text += "\na bad fit: take the trace"
    return text


def plot_delays(fitted: Fit, best: LawFit, own: LawFit, path: Path) -> None:
    """Draw how often each delay was recorded, and how often the law has it; and the delays of each UAV."""
    from matplotlib.figure import Figure  # noqa: PLC0415 (slow to import, and a service needs none)

    figure = Figure(figsize=(8, 5), layout="constrained")
    (shares, times), begin = figure.subplots(2), fitted.messages[0].time
    shares.bar(range(len(own.chances)), own.chances, color="0.8")
    shares.plot(best.chances, "o", color=COLOURS[0], markersize=4)
    shares.set(xlabel="delay [steps]; the last bar: lost", ylabel="share of messages")
    shares.set_title(f"recorded (bars), and {best.written}", fontsize=7)
    for i, (uav, messages) in enumerate(groupby(fitted.messages, lambda message: message.uav)):
        points = np.array([(m.time, m.delay) for m in messages])
        times.scatter(*points.T - [[begin], [0]], s=3, color=COLOURS[i % len(COLOURS)], label=uav)
    times.set(xlabel="time of the message [s]", ylabel="delay [s]")
    times.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
    figure.savefig(path, dpi=150)
