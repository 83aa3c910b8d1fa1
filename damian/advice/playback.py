"""The flight that a journal tells, as an episode, from which films, pages and GeoJSON are made.

The server node takes the steps of the journal again. Positions are those that the UAVs reported, in
hindsight, and between two reports on the straight way. Nobody knows where the source was.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from damian import keys
from damian.advice.fitting import fit
from damian.advice.fleet import Decision, Fleet
from damian.advice.journal import Advised, Received, read_lines
from damian.advice.rows import Place, Report, written
from damian.advice.session import replay
from damian.common.errors import InputError
from damian.common.text_files import named
from damian.show.episode import Episode, Floats, cells_of, fixed_of

MOST_STEPS = 20_000
"""Most steps of an episode that is made from a journal."""


@dataclass
class ServerView:
    """What the server node knew in each of S steps of the N UAVs that were members then."""

    steps: list[int] = field(default_factory=list)
    """Numbers of the steps, each one more than the one before."""
    members: list[list[str]] = field(default_factory=list)
    """IDs of the UAVs."""
    believed: list[Tensor] = field(default_factory=list)
    """Positions in the messages that it held [m], [N, 2] each."""
    age: list[Tensor] = field(default_factory=list)
    """Ages of these messages [s], [N] each."""
    reward: list[Tensor] = field(default_factory=list)
    """Rewards of the step, [N] each."""
    terms: dict[str, list[Tensor]] = field(default_factory=dict)
    """Their weighted terms by name, [N] each."""
    belief: list[Tensor] = field(default_factory=list)
    """Probability that the source is in a cell, [K] each; empty without a belief."""
    success: bool = False
    """Whether it knew in the last step that the task was accomplished."""
    delay: dict[tuple[int, str], int] = field(default_factory=dict)
    """Delays of the messages that arrived [steps], by the step in which they were generated and the UAV."""
    told: list[tuple[str, Decision]] = field(default_factory=list)
    """What UAVs have followed, by ID, from the step in which this was known."""


def episode_of(
    path: Path,
    fleet: Fleet,
    about: Mapping[str, Any],
    span: tuple[float, float] | None = None,
    progress: Callable = iter,
) -> Episode:
    """The flight of a journal as an episode; ``source`` and ``emits`` are None.

    The fleet is a new one, whose node writes the terms of the reward; ``span`` is the first and last time to
    keep, since every UAV had reported [s], and ``progress`` is like ``tqdm.tqdm``.
    """
    view, reports = _read(path, fleet, span or (0.0, math.inf), progress)
    steps, uavs = np.array(view.steps), [*reports]
    truth = [_hindsight(fleet, own, steps) for own in reports.values()]
    columns = {name: np.stack([each[name] for each in truth], 1) for name in truth[0]}
    columns["target"] = np.tile(columns["position"][0, :, :2], (len(steps), 1, 1))
    for uav, decision in view.told:
        columns["target"][steps > decision.step, uavs.index(uav)] = fleet.ground.points[decision.goal]
    columns["sent"], columns["delay"] = _messages(fleet, view, reports, steps)
    columns["believed"] = _of_members(view, view.believed, uavs, stays=True)
    columns |= {name: _of_members(view, getattr(view, name), uavs) for name in ("age", "reward")}
    columns["sent"][0], columns["reward"][0] = False, 0.0
    terms = {name: _of_members(view, rows, uavs) for name, rows in view.terms.items()}
    for rows in terms.values():
        rows[0] = 0.0
    began = cast(float, fleet.start) + view.steps[0] * fleet.node.dt
    flight = {"uavs": uavs, "began": written(began)}
    parts: dict[str, Any] = {**fixed_of(fleet.node.worlds, {**about, **flight}, 0), **columns}
    return Episode(
        **parts,
        instant=False,
        success=view.success,
        time=np.arange(len(steps)) * fleet.node.dt,
        source=None,
        emits=None,
        reward_terms=terms,
        cells=cells_of(fleet.node.worlds) if view.belief else None,
        belief=np.stack([np.asarray(row) for row in view.belief]) if view.belief else None,
    )


def _read(
    path: Path, fleet: Fleet, span: tuple[float, float], progress: Callable
) -> tuple[ServerView, dict[str, list[Report]]]:
    """What was known in the steps of a span, and all reports of each UAV that has ever been a member."""
    view, end = ServerView(), math.inf
    reports: dict[str, list[Report]] = {uav: [] for uav in fleet.uavs}
    for number, line in progress(list(read_lines(path))):
        with named(f"{path}: line {number}"):
            if fleet.step <= end:
                _advance(fleet, view, line.asked if isinstance(line, Advised) else line.received, span)
                before = {uav: own[-1:] for uav, own in zip(fleet.uavs, map(list, fleet.told), strict=True)}
                replay(fleet, line)
                for uav, own in zip(fleet.uavs, map(list, fleet.told), strict=True):
                    view.told += [(uav, each) for each in own[-1:] if [each] != before.get(uav, [each])]
            if fleet.start is not None:
                end = fleet.first_step + span[1] / fleet.node.dt
            for report in line.reports if isinstance(line, Received) else ():
                reports.setdefault(report.id, []).append(report)
    reports = {uav: own for uav, own in reports.items() if own}
    if fleet.start is None:
        raise InputError(f"{path}: the fleet never began: not every UAV has reported")
    _advance(fleet, view, fleet.clock, span, is_last=True)
    if not view.steps:
        whole = f"the journal covers 0 to {(fleet.step - fleet.first_step) * fleet.node.dt:g} s"
        raise InputError(f"span: no step lies between {span[0]:g} and {span[1]:g} s: {whole}")
    return view, reports


def _advance(
    fleet: Fleet, view: ServerView, now: float, span: tuple[float, float], is_last: bool = False
) -> None:
    """Take the steps up to an instant, and note those in the span; the last one is noted at the end."""
    if fleet.start is None:
        return
    start, dt = fleet.start, fleet.node.dt
    first, last = (fleet.first_step + each / dt for each in span)
    if first > fleet.step:
        fleet.advance(min(now, start + math.ceil(first) * dt))
    until = min(fleet.step_of(now) + is_last, last + 1)
    if until - fleet.step + len(view.steps) > MOST_STEPS and first <= fleet.step:
        raise InputError(f"span: it has more than {MOST_STEPS} steps of {dt:g} s: give FIRST and LAST [s]")
    while first <= fleet.step < until:
        _note(fleet, view)
        fleet.advance(start + (fleet.step + 1) * dt)


def _note(fleet: Fleet, view: ServerView) -> None:
    """Note what the server node knows at the end of a step."""
    view.steps.append(fleet.step)
    view.members.append(fleet.uavs)
    for uav, each in fleet.arrived:
        sent = each.step, fleet.uavs[uav]
        view.delay[sent] = min(fleet.step - each.step, view.delay.get(sent, fleet.step))
    outputs = fleet.observe([])
    view.believed.append(fleet.points[[each.point for each in fleet.held]])
    view.age.append(outputs[keys.AGE][0, :, 0] * fleet.node.dt)
    reward = outputs.get(keys.REWARD, None)
    view.reward.append(view.age[-1] * 0 if reward is None else cast(Tensor, reward)[0, :, 0])
    for name in fleet.node.server.reward.terms:
        term = outputs.get((*keys.REWARD_TERMS, name), None)
        view.terms.setdefault(name, []).append(view.age[-1] * 0 if term is None else cast(Tensor, term)[0])
    if (belief := outputs.get(keys.BELIEF, None)) is not None:
        view.belief.append(cast(Tensor, belief)[0])
    view.success = bool(outputs[keys.SUCCESS])


def _hindsight(fleet: Fleet, reports: Sequence[Report], steps: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Columns of a UAV that follow from its reports by the time when they were generated, [S, ...]."""
    ordered = sorted(reports, key=lambda report: report.time)
    at = np.clip([fleet.step_of(report.time) for report in ordered], fleet.first_step, None)
    of_step = {int(step): report for step, report in zip(at, ordered, strict=True)}
    knots, latest = np.array(list(of_step)), list(of_step.values())
    places = np.array(
        [(*fleet.ground.local(cast(Place, each.place())), max(each.fla or 0.0, 0.0)) for each in latest]
    )
    position = np.stack([np.interp(steps, knots, axis) for axis in places.T], -1)
    newest = np.clip(np.searchsorted(knots, steps, side="right") - 1, 0, None)
    spots = np.array([each.source_spotted and not each.flies for each in latest])
    headings = [None if each.track is None else math.radians(each.track) for each in latest]
    return {
        "position": position,
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
    fleet: Fleet, view: ServerView, reports: Mapping[str, Sequence[Report]], steps: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Whether a UAV sent a message in a step, and its delay [steps], -1 if it never arrived, [S, N] each."""
    sent, number = np.zeros((len(steps), len(reports)), bool), {uav: i for i, uav in enumerate(reports)}
    delay = np.zeros(sent.shape, int)
    for (step, name), lag in view.delay.items():
        uav = number[name]
        if step >= steps[0]:
            sent[step - steps[0], uav], delay[step - steps[0], uav] = True, lag
    for message in fit([report for own in reports.values() for report in own]).messages:
        row, uav = fleet.step_of(message.time) - steps[0], number[message.uav]
        if 0 <= row < len(steps) and not sent[row, uav]:  # lost, or it came in after the last of the steps
            lag = -1 if message.received is None else fleet.step_of(message.received) - steps[0] - row
            sent[row, uav], delay[row, uav] = True, lag
    return sent, delay


def _of_members(
    view: ServerView, rows: Sequence[Tensor], uavs: Sequence[str], stays: bool = False
) -> NDArray[Any]:
    """Rows of the members [N, ...] as columns of all UAVs [S, U, ...]; 0 while a UAV is not a member.

    With ``stays`` it is then where it was last, and before it joins, where it will be first.
    """
    found = np.zeros((len(rows), len(uavs), *rows[0].shape[1:]), np.asarray(rows[0]).dtype)
    there = np.zeros(found.shape[:2], bool)
    for step, (members, row) in enumerate(zip(view.members, rows, strict=True)):
        at = [uavs.index(uav) for uav in members]
        found[step, at], there[step, at] = np.asarray(row), True
    for uav in range(len(uavs)) if stays else ():
        known = np.flatnonzero(there[:, uav])
        if len(known):
            latest = np.searchsorted(known, np.arange(len(rows)), side="right") - 1
            found[:, uav] = found[known[latest.clip(min=0)], uav]
    return found
