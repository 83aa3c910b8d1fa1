"""The flight that a journal tells, as an episode, from which films, pages and GeoJSON are made.

The server node takes the steps of the journal again. Positions are those that the UAVs reported, in
hindsight, and between two reports on the straight way to the later one. Nobody knows where the source was.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from damian import keys
from damian.common.errors import InputError
from damian.common.text_files import named
from damian.field.fitting import fit
from damian.field.journal import read_lines
from damian.field.node import Node
from damian.field.rows import Place, Report, written
from damian.field.tracker import Tracker
from damian.show.episode import Episode, Floats, cells_of, fixed_of

MOST_STEPS = 20_000
"""Most steps of an episode that is made from a journal."""


class Known(NamedTuple):
    """What the server node knew of its N UAVs at the end of a step."""

    step: int
    uavs: list[str]
    believed: Tensor
    """Positions in the messages that it held [m], [N, 2]."""
    age: Tensor
    """Ages of these messages [s], [N]."""
    reward: Tensor
    """Rewards of the step, [N]."""
    terms: dict[str, Tensor]
    """Their weighted terms by name, [N] each."""
    belief: Tensor | None
    """Probability that the source is in a cell, [K]."""
    success: bool
    """Whether it knew that the task was accomplished."""


def episode_of(
    path: Path,
    uavs: Sequence[str],
    node_of: Callable[[int], Node],
    about: Mapping[str, Any],
    span: tuple[float, float] | None = None,
    progress: Callable = iter,
) -> Episode:
    """The flight of a journal that begins with these UAVs, as an episode; ``source`` and ``emits`` are None.

    ``node_of`` gives a node for a number of UAVs, which writes the terms of the reward; ``span`` is the first
    and last time to keep, since every UAV had reported [s], and ``progress`` is like ``tqdm.tqdm``.
    """
    tracker = Tracker(uavs, node_of)
    known, delays, reports = _read(path, tracker, span, progress)
    steps, uavs, node = np.array([each.step for each in known]), [*reports], tracker.node
    truth = [_hindsight(tracker, own, steps) for own in reports.values()]
    columns = {name: np.stack([each[name] for each in truth], 1) for name in truth[0]}
    columns["sent"], columns["delay"] = _messages(tracker, delays, reports, steps)
    columns["believed"] = _of_members(known, [each.believed for each in known], uavs, stays=True)
    columns["age"] = _of_members(known, [each.age for each in known], uavs)
    columns["reward"] = _of_members(known, [each.reward for each in known], uavs)
    terms = {name: _of_members(known, [each.terms[name] for each in known], uavs) for name in known[0].terms}
    for rows in (columns["sent"], columns["reward"], *terms.values()):
        rows[0] = 0
    began = cast(float, tracker.start) + known[0].step * node.dt
    flight = {"uavs": uavs, "began": written(began)}
    parts: dict[str, Any] = {**fixed_of(node.worlds, {**about, **flight}, 0), **columns}
    has_belief = known[0].belief is not None
    return Episode(
        **parts,
        instant=False,
        success=known[-1].success,
        time=np.arange(len(steps)) * node.dt,
        source=None,
        emits=None,
        reward_terms=terms,
        cells=cells_of(node.worlds) if has_belief else None,
        belief=np.stack([np.asarray(each.belief) for each in known]) if has_belief else None,
    )


def _read(
    path: Path, tracker: Tracker, span: tuple[float, float] | None, progress: Callable
) -> tuple[list[Known], dict[tuple[int, str], int], dict[str, list[Report]]]:
    """What was known in the steps of a span, delays of messages that arrived in it, and all reports by UAV.

    Delays [steps] are by the step in which the message was generated, and the UAV.
    """
    known: list[Known] = []
    delays: dict[tuple[int, str], int] = {}
    reports: dict[str, list[Report]] = {uav: [] for uav in tracker.uavs}
    begin, end = span or (0.0, math.inf)

    def note() -> None:
        for uav, each in tracker.arrived:
            lag = tracker.step - each.step
            delays[each.step, uav] = min(lag, delays.get((each.step, uav), lag))
        known.append(_known(tracker))
        if len(known) > MOST_STEPS:
            dt = tracker.node.dt
            raise InputError(
                f"span: it has more than {MOST_STEPS} steps of {dt:g} s: give FIRST and LAST [s]"
            )

    for number, line in progress([*read_lines(path)]):
        with named(f"{path}: line {number}"):
            first, last = (tracker.first_step + each / tracker.node.dt for each in (begin, end))
            if tracker.step <= last:
                for step in tracker.advance(line.time, math.ceil(first)):
                    if step <= last:
                        note()
                if line.join or line.leave:
                    tracker.change_members(line.join, line.leave)
                for report in sorted(line.reports, key=lambda each: each.received):
                    tracker.report(report)
            for report in line.reports:
                reports.setdefault(report.id, []).append(report)
    if tracker.start is None:
        raise InputError(f"{path}: the fleet never began: not every UAV has reported")
    first, last = (tracker.first_step + each / tracker.node.dt for each in (begin, end))
    if first <= tracker.step <= last:
        note()
    if not known:
        whole = f"the journal covers 0 to {(tracker.step - tracker.first_step) * tracker.node.dt:g} s"
        raise InputError(f"span: no step lies between {begin:g} and {end:g} s: {whole}")
    return known, delays, {uav: own for uav, own in reports.items() if own}


def _known(tracker: Tracker) -> Known:
    """What the server node knows at the end of the tracker's step."""
    outputs, node = tracker.observe(), tracker.node
    age = outputs[keys.AGE][0, :, 0] * node.dt
    reward, belief = outputs.get(keys.REWARD, None), outputs.get(keys.BELIEF, None)
    terms = {name: outputs.get((*keys.REWARD_TERMS, name), None) for name in node.server.reward.terms}
    return Known(
        tracker.step,
        tracker.uavs,
        believed=tracker.points[[tracker.held[uav].point for uav in tracker.uavs]],
        age=age,
        reward=age * 0 if reward is None else cast(Tensor, reward)[0, :, 0],
        terms={name: age * 0 if term is None else cast(Tensor, term)[0] for name, term in terms.items()},
        belief=None if belief is None else cast(Tensor, belief)[0],
        success=bool(outputs[keys.SUCCESS]),
    )


def _hindsight(
    tracker: Tracker, reports: Sequence[Report], steps: NDArray[np.int64]
) -> dict[str, NDArray[Any]]:
    """Columns of a UAV that follow from its reports by the time when they were generated, [S, ...]."""
    ordered = sorted(reports, key=lambda report: report.time)
    at = np.clip([tracker.step_of(report.time) for report in ordered], tracker.first_step, None)
    of_step = {int(step): report for step, report in zip(at, ordered, strict=True)}
    knots, latest = np.array(list(of_step)), list(of_step.values())
    local, heights = tracker.node.ground.local, [max(each.fla or 0.0, 0.0) for each in latest]
    places = np.array([local(cast(Place, each.place())) for each in latest])
    position = np.stack([np.interp(steps, knots, axis) for axis in (*places.T, heights)], -1)
    goals = [*places]
    for i in reversed(range(len(latest))):
        if (target := latest[i].place("target_")) is not None:
            goals[i] = np.array(local(target))
        elif latest[i].flies and i + 1 < len(latest):
            goals[i] = goals[i + 1]
    following = np.clip(np.searchsorted(knots, steps), None, len(knots) - 1)
    newest = np.clip(np.searchsorted(knots, steps, side="right") - 1, 0, None)
    spots = np.array([each.source_spotted and not each.flies for each in latest])
    headings = [None if each.track is None else math.radians(each.track) for each in latest]
    return {
        "position": position,
        "target": np.array(goals)[following],
        "battery": _filled([each.battery for each in latest], 100.0)[newest],
        "spotted": spots[newest],
        "track": _course(position) if None in headings else _filled(headings, 0.0)[newest] % (2 * np.pi),
    }


def _filled(values: Sequence[float | None], first: float) -> Floats:
    """Values in which the one before stands for each that is None."""
    filled = accumulate(values, lambda before, value: before if value is None else value, initial=first)
    return np.array([*filled][1:])


def _course(position: Floats) -> Floats:
    """Headings by which a UAV has come to its positions [S, 3], clockwise from north [rad], [S]."""
    east, north, _ = np.diff(position, axis=0, prepend=position[:1]).T
    moved = [float(np.arctan2(*way)) if any(way) else None for way in zip(east, north, strict=True)]
    return _filled(moved, 0.0) % (2 * np.pi)


def _messages(
    tracker: Tracker,
    delays: Mapping[tuple[int, str], int],
    reports: Mapping[str, Sequence[Report]],
    steps: NDArray[np.int64],
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Whether a UAV sent a message in a step, and its delay [steps], -1 if it never arrived, [S, N] each."""
    sent, number = np.zeros((len(steps), len(reports)), bool), {uav: i for i, uav in enumerate(reports)}
    delay = np.zeros(sent.shape, int)
    for (step, name), lag in delays.items():
        uav = number[name]
        if step >= steps[0]:
            sent[step - steps[0], uav], delay[step - steps[0], uav] = True, lag
    for message in fit([report for own in reports.values() for report in own]).messages:
        row, uav = tracker.step_of(message.time) - steps[0], number[message.uav]
        if 0 <= row < len(steps) and not sent[row, uav]:  # lost, or it came in after the last of the steps
            lag = -1 if message.received is None else tracker.step_of(message.received) - steps[0] - row
            sent[row, uav], delay[row, uav] = True, lag
    return sent, delay


def _of_members(
    known: Sequence[Known], rows: Sequence[Tensor], uavs: Sequence[str], stays: bool = False
) -> NDArray[Any]:
    """Rows of the members [N, ...] as columns of all UAVs [S, U, ...]; 0 while a UAV is not a member.

    With ``stays`` it is then where it was last, and before it joins, where it will be first.
    """
    found = np.zeros((len(rows), len(uavs), *rows[0].shape[1:]), np.asarray(rows[0]).dtype)
    there = np.zeros(found.shape[:2], bool)
    for step, (each, row) in enumerate(zip(known, rows, strict=True)):
        at = [uavs.index(uav) for uav in each.uavs]
        found[step, at], there[step, at] = np.asarray(row), True
    for uav in range(len(uavs)) if stays else ():
        when = np.flatnonzero(there[:, uav])
        if len(when):
            latest = np.searchsorted(when, np.arange(len(rows)), side="right") - 1
            found[:, uav] = found[when[latest.clip(min=0)], uav]
    return found
