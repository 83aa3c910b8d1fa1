"""The flight that a journal tells, as episodes, from which films and pages are made.

The server node takes the steps of the journal again. Positions are those that the UAVs reported, in
hindsight, and between two reports on the straight way to the later one. Nobody knows where the
source was.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tqdm import tqdm

from damian import keys
from damian.common.errors import InputError
from damian.show.episode import Episode, at_instant, episode_of
from damian.world.state import Truth
from damian_fleet.clocks import wrong_clocks
from damian_fleet.journal import Line, read_journal
from damian_fleet.node import Node
from damian_fleet.reports import Place, Report, Rows, written
from damian_fleet.tracker import Tracker


def episodes_of(
    path: Path, node_of: Callable[[int], Node], about: Mapping[str, Any]
) -> list[Episode]:
    """The flight of a journal as episodes; ``source`` and ``emits`` are None if the task has one or
    a UAV has spotted one.

    An episode begins when all UAVs of the fleet have reported; when UAVs join or leave, another one
    does. ``node_of`` gives a node for a number of UAVs, which writes the terms of the reward.
    """
    head, lines = read_journal(path)
    rows = [(where, report) for where, line in lines for report in line.reports]
    problem = f"{path}: the fleet never began: not every UAV has reported"
    if not rows:
        raise InputError(problem)
    wrong, fitted = wrong_clocks(rows)
    numbers = count()
    for _, line in lines:
        line.reports = [report for report in line.reports if next(numbers) not in wrong]
    told = {"policy": head.about.get("policy"), "checkpoint": head.about.get("checkpoint")}
    episodes = []
    for uavs, part in _parts(head.uavs, lines):
        rows = [(where, report) for where, line in part for report in line.reports]
        if {*uavs} - {report.id for _, report in rows}:
            continue  # not every UAV has reported
        tracker = Tracker(node_of(len(uavs)), uavs, rows)
        steps = range(tracker.first_step, tracker.step_of(part[-1][1].time) + 1)
        episodes.append(
            _episode(tracker, rows, fitted, steps, {**told, **about, "fleet": head.fleet})
        )
    if not episodes:
        raise InputError(problem)
    return episodes


def _parts(
    uavs: list[str], lines: Sequence[tuple[str, Line]]
) -> Iterator[tuple[list[str], list[tuple[str, Line]]]]:
    """The members of a fleet and the lines of its journal until they change, again and again."""
    part: list[tuple[str, Line]] = []
    for where, line in lines:
        if line.join or line.leave:
            yield uavs, part
            uavs = [*(uav for uav in uavs if uav not in line.leave), *line.join]
            part = []
        part.append((where, line))
    yield uavs, part


def _episode(
    tracker: Tracker,
    rows: Rows,
    fitted: pd.DataFrame,
    steps: Sequence[int],
    about: Mapping[str, Any],
) -> Episode:
    """The flight of these steps; ``fitted`` has its messages, as of ``fit``."""
    node = tracker.node
    numbers = np.array(steps)
    known = list[Any]()
    taken = tracker.steps(tracker.start + steps[-1] * node.dt)
    known += [outputs[0] for outputs in tqdm(taken, unit=" steps", delay=1)]
    reports = {uav: [each for _, each in rows if each.id == uav] for uav in tracker.uavs}
    flown = [_hindsight(tracker, own, numbers) for own in reports.values()]
    columns = {name: np.stack([each[name] for each in flown], 1) for name in flown[0]}
    columns["age"] = torch.stack([each[keys.AGE][:, 0] for each in known]).numpy() * node.dt
    columns["sent"], columns["delay"] = _messages(tracker, fitted, numbers)
    instants = cast(TensorDictBase, torch.stack([at_instant(each) for each in known]))  # type: ignore[arg-type]
    for rewards in (instants[keys.REWARD], *instants.get(keys.REWARD_TERMS, {}).values()):
        rewards[0] = 0  # of a step before
    position, battery = (torch.as_tensor(columns[name]) for name in ("position", "battery"))
    unknown = torch.zeros(len(steps), 1, 2)
    nothing = unknown[:, :0], unknown[:, 0, :0]
    instants[keys.STATE] = Truth(position, battery, unknown[..., 0], unknown, *nothing).pack()
    told = {**about, "uavs": tracker.uavs, "began": written(tracker.start + steps[0] * node.dt)}
    episode = episode_of(instants, node.worlds, told)
    is_sought = episode.has_source or columns["spotted"].any()
    unknown_source = {"source": None, "emits": None} if is_sought else {}
    return replace(episode, **columns, **unknown_source, instant=False)


def _hindsight(
    tracker: Tracker, reports: Sequence[Report], steps: NDArray[np.int64]
) -> dict[str, NDArray[Any]]:
    """Columns of a UAV that follow from its reports by the time when they were generated,
    [S, ...]."""
    ground = tracker.node.ground
    rows = []
    for report in reports:
        target = report.place("target_")
        rows.append(
            (
                max(tracker.step_of(report.time), tracker.first_step),
                report.time,
                *ground.local(cast(Place, report.place())),
                max(report.fla or 0.0, 0.0),
                *((math.nan, math.nan) if target is None else ground.local(target)),
                report.battery,
                None if report.track is None else math.radians(report.track),
                report.source_spotted and not report.flies,
                report.flies,
            )
        )
    place = ["east", "north", "up"]
    goal = ["to_east", "to_north"]
    names = ["step", "time", *place, *goal, "battery", "track", "spotted", "flies"]
    table = (
        pd.DataFrame(rows, columns=names).sort_values("time").drop_duplicates("step", keep="last")
    )
    table = table.set_index("step")
    position = np.stack([np.interp(steps, table.index, table[axis]) for axis in place], -1)
    stands = table[place[:2]].set_axis(goal, axis=1)
    # A UAV in flight without a known goal goes to where it stands next.
    goals = table[goal].fillna(stands[~table.flies]).bfill().fillna(stands)
    following = np.clip(table.index.searchsorted(steps), None, len(table) - 1)
    newest = np.clip(table.index.searchsorted(steps, side="right") - 1, 0, None)
    return {
        "position": position,
        "target": goals.to_numpy()[following],
        "battery": table.battery.astype(float).ffill().fillna(100.0).to_numpy()[newest],
        "spotted": table.spotted.to_numpy()[newest],
        "track": table.track.astype(float).ffill().fillna(0.0).to_numpy()[newest] % (2 * np.pi),
    }


def _messages(
    tracker: Tracker, fitted: pd.DataFrame, steps: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Whether a UAV sent a message in a step, and its delay [steps], -1 if it never arrived, [S, N]
    each."""
    sent = np.zeros((len(steps), len(tracker.uavs)), bool)
    number = {uav: i for i, uav in enumerate(tracker.uavs)}
    delay = np.zeros(sent.shape, int)
    found = fitted[fitted.uav.isin(tracker.uavs)]
    # Of those of one step, the first that has arrived counts.
    found = found.sort_values("delay", ascending=False, na_position="first")
    for uav, time, received in found[["uav", "time", "received"]].itertuples(index=False):
        step = tracker.step_of(time) - steps[0]
        if 0 < step < len(steps):
            lag = (
                -1 if math.isnan(received) else max(tracker.step_of(received) - steps[0] - step, 0)
            )
            at = step, number[uav]
            sent[at], delay[at] = True, lag
    return sent, delay
