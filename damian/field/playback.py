"""The flight that a journal tells, as an episode, from which films, pages and GeoJSON are made.

The server node takes the steps of the journal again. Positions are those that the UAVs reported, in
hindsight, and between two reports on the straight way to the later one. Nobody knows where the source was.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from damian import keys
from damian.common.errors import InputError
from damian.common.text_files import named
from damian.field.fitting import fit
from damian.field.journal import Line, read_journal
from damian.field.node import Node
from damian.field.rows import Place, Report, written
from damian.field.tracker import Tracker, latest
from damian.show.episode import Episode, Floats, cells_of, fixed_of

MOST_STEPS = 20_000
"""Most steps of an episode that is made from a journal."""
FOLLOWED = ("accepted", "taken off", "landed")
"""What a UAV says of an answer that it follows."""
_KNOWN = ("step", "uav", "east", "north", "age", "reward")
"""What the server node knew of a UAV at the end of a step: where it was by the message that the node held
[m], the age of this message [s], and the reward of the step; its terms follow."""


def episode_of(
    path: Path,
    node_of: Callable[[int], Node],
    about: Mapping[str, Any],
    span: tuple[float, float] = (0.0, math.inf),
) -> Episode:
    """The flight of a journal as an episode; ``source`` and ``emits`` are None.

    ``node_of`` gives a node for a number of UAVs, which writes the terms of the reward; ``span`` is the first
    and last time to keep, since every UAV had reported [s].
    """
    replay = _Replay(path, node_of, span)
    tracker, node = replay.tracker, replay.tracker.node
    reports = {uav: own for uav, own in replay.reports.items() if own}
    names = [*node.server.reward.terms]
    table = pd.DataFrame(replay.known, columns=[*_KNOWN, *range(len(names))])
    known = table.pivot(index="step", columns="uav")
    steps = known.index.to_numpy()

    def column(name: str | int, stays: bool = False) -> Floats:
        """What was known of all UAVs, [S, U]; while one is not a member 0, or as before, or as then."""
        of_uavs = cast(pd.DataFrame, known[name]).reindex(columns=[*reports])
        return (of_uavs.ffill().bfill() if stays else of_uavs).fillna(0).to_numpy(np.float32, copy=True)

    truth = [_hindsight(tracker, uav, own, steps) for uav, own in reports.items()]
    columns = {name: np.stack([each[name] for each in truth], 1) for name in truth[0]}
    columns["believed"] = np.stack([column("east", stays=True), column("north", stays=True)], -1)
    columns |= {"age": column("age"), "reward": column("reward")}
    columns["sent"], columns["delay"] = _messages(replay, reports, steps)
    terms = {name: column(number) for number, name in enumerate(names)}
    for rows in (columns["sent"], columns["reward"], *terms.values()):
        rows[0] = 0
    head, began = replay.head, written(cast(float, tracker.start) + int(steps[0]) * node.dt)
    about = {"policy": head.about.policy, "checkpoint": head.about.checkpoint, **about, "fleet": head.fleet}
    parts: dict[str, Any] = {
        **fixed_of(node.worlds, {**about, "uavs": [*reports], "began": began}, 0),
        **columns,
    }
    return Episode(
        **parts,
        instant=False,
        success=replay.success,
        time=np.arange(len(steps)) * node.dt,
        source=None,
        emits=None,
        reward_terms=terms,
        cells=cells_of(node.worlds) if replay.beliefs else None,
        belief=np.stack(replay.beliefs) if replay.beliefs else None,
    )


class _Replay:
    """Takes the steps of a journal again, and notes what was known in those of a span [s]."""

    def __init__(self, path: Path, node_of: Callable[[int], Node], span: tuple[float, float]) -> None:
        self.head, lines = read_journal(path)
        self.tracker, self.span = Tracker(self.head.uavs, node_of), span
        self.known: list[tuple[Any, ...]] = []
        """Rows of what was known of each UAV, as of ``_KNOWN``."""
        self.beliefs: list[Floats] = []
        """Probability that the source is in a cell, [K], of each step; empty without a belief."""
        self.success = False
        """Whether the node knew in the last step that the task was accomplished."""
        self.delays: dict[tuple[int, str], int] = {}
        """Delays of the messages that arrived [steps], by the step of their generation, and the UAV."""
        self.reports: dict[str, list[Report]] = {uav: [] for uav in self.head.uavs}
        """All reports by UAV."""
        self._answers: dict[str, tuple[str, float, Place]] = {}
        """Where a UAV was told to be, and when, by the ID of the answer."""
        for number, line in tqdm(lines, unit=" lines", delay=1):
            with named(f"{path}: line {number}"):
                self._take(line)
        tracker, (first, last) = self.tracker, self._first_and_last()
        if tracker.start is None:
            raise InputError(f"{path}: the fleet never began: not every UAV has reported")
        if first <= tracker.step <= last:
            self._note()
        if not self.known:
            whole = f"the journal covers 0 to {(tracker.step - tracker.first_step) * tracker.node.dt:g} s"
            raise InputError(f"span: no step lies between {span[0]:g} and {span[1]:g} s: {whole}")

    def _first_and_last(self) -> tuple[float, float]:
        """The steps between which the span lies."""
        first, last = (self.tracker.first_step + each / self.tracker.node.dt for each in self.span)
        return first, last

    def _take(self, line: Line) -> None:
        """Take the steps before a line, and what it says."""
        tracker, (first, last) = self.tracker, self._first_and_last()
        if tracker.step <= last:
            for step in tracker.advance(line.time, math.ceil(first)):
                if step <= last:
                    self._note()
            tracker.change_members(line.join, line.leave)
            for order in self._followed(line):
                tracker.follow(*order)
            for report in sorted(line.reports, key=lambda each: each.received):
                tracker.report(report)
        for report in line.reports:
            self.reports.setdefault(report.id, []).append(report)

    def _followed(self, line: Line) -> Iterator[tuple[str, float, Place]]:
        """The UAVs that follow an answer from this line on, each with when and where it was sent."""
        for told in line.advice:
            if (place := told.place) is not None and told.id in self.tracker.held:
                self._answers[told.answer] = told.id, line.time, place
                if not self.head.rules.acknowledge:
                    yield self._answers[told.answer]
        for number, said in enumerate(line.acknowledged):
            if said.status in FOLLOWED and number not in line.outdated and said.answer in self._answers:
                yield self._answers.pop(said.answer)

    def _note(self) -> None:
        """Note what the server node knows at the end of the tracker's step."""
        tracker, node, outputs = self.tracker, self.tracker.node, self.tracker.observe()
        for uav, each in tracker.arrived:
            lag = tracker.step - each.step
            self.delays[each.step, uav] = min(lag, self.delays.get((each.step, uav), lag))
        age = outputs[keys.AGE][0, :, 0] * node.dt
        places = tracker.points[[tracker.held[uav].point for uav in tracker.uavs]]
        values = [*places.T, age, outputs.get(keys.REWARD, torch.zeros(1, len(age), 1))[0, :, 0]]
        values += [
            outputs.get((*keys.REWARD_TERMS, name), torch.zeros(1, len(age)))[0]
            for name in node.server.reward.terms
        ]
        rows = torch.stack(values, -1).tolist()
        self.known += [(tracker.step, uav, *row) for uav, row in zip(tracker.uavs, rows, strict=True)]
        if (belief := outputs.get(keys.BELIEF, None)) is not None:
            self.beliefs.append(np.asarray(belief[0]))
        self.success = bool(outputs[keys.SUCCESS])
        if tracker.step - self.known[0][0] >= MOST_STEPS:
            problem = f"it has more than {MOST_STEPS} steps of {node.dt:g} s: give FIRST and LAST [s]"
            raise InputError(f"span: {problem}")


def _hindsight(
    tracker: Tracker, uav: str, reports: Sequence[Report], steps: NDArray[np.int64]
) -> dict[str, NDArray[Any]]:
    """Columns of a UAV that follow from its reports by the time when they were generated, [S, ...]."""
    ground, orders, rows = tracker.node.ground, tracker.orders[uav], []
    for report in sorted(reports, key=lambda each: each.time):
        target = report.place("target_")
        goal = (math.nan, math.nan) if target is None else ground.local(target)
        if target is None and report.flies and (order := latest(orders, report.time)):
            goal = ground.points[order.goal]
        rows.append(
            (
                max(tracker.step_of(report.time), tracker.first_step),
                *ground.local(cast(Place, report.place())),
                max(report.fla or 0.0, 0.0),
                *goal,
                report.battery,
                None if report.track is None else math.radians(report.track),
                report.source_spotted and not report.flies,
                report.flies,
            )
        )
    place, goal = ["east", "north", "up"], ["to_east", "to_north"]
    names = ["step", *place, *goal, "battery", "track", "spotted", "flies"]
    table = pd.DataFrame(rows, columns=names).drop_duplicates("step", keep="last").set_index("step")
    position = np.stack([np.interp(steps, table.index, table[axis]) for axis in place], -1)
    stands = table[place[:2]].set_axis(goal, axis=1)
    # A UAV in flight without a known goal goes to where it stands next.
    goals = table[goal].fillna(stands[~table.flies]).bfill().fillna(stands)
    following = np.clip(table.index.searchsorted(steps), None, len(table) - 1)
    newest = np.clip(table.index.searchsorted(steps, side="right") - 1, 0, None)
    track = _course(position) if table.track.isna().any() else table.track.to_numpy()[newest]
    return {
        "position": position,
        "target": goals.to_numpy()[following],
        "battery": table.battery.astype(float).ffill().fillna(100.0).to_numpy()[newest],
        "spotted": table.spotted.to_numpy()[newest],
        "track": track % (2 * np.pi),
    }


def _course(position: Floats) -> Floats:
    """Headings by which a UAV has come to its positions [S, 3], clockwise from north [rad], [S]."""
    way = np.diff(position[:, :2], axis=0, prepend=position[:1, :2])
    return pd.Series(np.arctan2(*way.T)).where(np.asarray(way.any(1))).ffill().fillna(0.0).to_numpy()


def _messages(
    replay: _Replay, reports: Mapping[str, Sequence[Report]], steps: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Whether a UAV sent a message in a step, and its delay [steps], -1 if it never arrived, [S, N] each."""
    sent, number = np.zeros((len(steps), len(reports)), bool), {uav: i for i, uav in enumerate(reports)}
    delay, step_of = np.zeros(sent.shape, int), replay.tracker.step_of
    for (step, uav), lag in replay.delays.items():
        if step >= steps[0]:
            at = step - steps[0], number[uav]
            sent[at], delay[at] = True, lag
    found = fit(report for own in reports.values() for report in own)
    for uav, time, received in zip(found.uav, found.time, found.received, strict=True):
        at = step_of(time) - steps[0], number[uav]
        if 0 <= at[0] < len(steps) and not sent[at]:  # lost, or it came in after the last of the steps
            lag = -1 if math.isnan(received) else step_of(received) - steps[0] - at[0]
            sent[at], delay[at] = True, lag
    return sent, delay
