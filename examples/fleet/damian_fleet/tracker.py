"""Follows UAVs by their reports: takes the steps of the server node with what had come in by then.

Step k lasts from ``start + k dt`` on; the oldest first report was generated at the start. A message
belongs to the step in which it was generated, and counts from the step in which it came in.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase

from damian import keys
from damian.common.checks import SECONDS
from damian.common.errors import InputError
from damian.common.text_files import listed, named, show
from damian.delays.clocks import AGREE, UNSET
from damian.world.messages import Messages
from damian.world.state import State
from damian_fleet.known import FilledReport, UavLog, messages_of
from damian_fleet.node import LateMessage, Memories, Node, Reported
from damian_fleet.reports import Report, Rows

NEVER_DECIDED = 2**31
"""Steps since the latest decision of a UAV that is ready to choose."""
_ROUNDING = 1e-3
"""Share of a step by which times may be rounded."""


class Tracker:
    """The server node of a fleet, which begins with the newest report of each UAV, once each has
    sent one.

    Args:
        node: the server node for so many UAVs.
        uavs: their IDs.
        rows: reports that ``steps`` takes in the order in which they came in, whatever theirs is;
            others are given to ``add``, in the order in which they come in.
        standing: called with the ID of a UAV and whether it asks for advice, returns the index of
            the landing point where it stands or to which it flies; if not given, its newest message
            tells.
    """

    def __init__(
        self,
        node: Node,
        uavs: Sequence[str],
        rows: Rows | None = None,
        standing: Callable[[str, bool], int] | None = None,
    ) -> None:
        self.node = node
        self.uavs = [*uavs]
        self.points = node.simulation.airspace.points[0]
        self.logs = {uav: self.new_log() for uav in uavs}
        self.held: dict[str, FilledReport] = {}
        """The message of each UAV that the server holds."""
        self.pending: list[tuple[int, str, FilledReport]] = []
        """Reports that have come in and count later: the step from which they do, the UAV, the
        report."""
        self.has_begun, self.start = False, 0.0
        """Whether every UAV has sent a report, and when step 0 began then [s]."""
        self.step = self.first_step = 0
        self.before: Memories | None = None
        """The memories of the node after the step before; None in the first step."""
        self._standing = standing or (lambda uav, _: self.held[uav].target)
        self._outputs: TensorDictBase | None = None
        """Outputs of this step; None until they are needed."""
        self._begin_step()
        self._previous = self.action, self.chosen
        for where, report in rows or []:
            with named(where):
                self.check(report)
        self._coming = deque(
            sorted((report for _, report in rows or []), key=lambda each: each.received)
        )
        """Reports of ``rows`` that have not come in yet."""
        while self._coming and not self.has_begun:
            self.add(self._coming.popleft())
        if self._coming and self._coming[-1].received - self.start > SECONDS:
            raise InputError(
                f"time: the first reports are more than {SECONDS:g} s older: leave them out"
            )

    def new_log(self) -> UavLog:
        """The log of a UAV that has not reported yet."""
        widths = self.node.simulation.widths
        stops = self.node.server.observation.carried_stops
        return UavLog(self.node.ground, stops, widths.readings, self.node.dt)

    def check(self, report: Report, log: UavLog | None = None) -> None:
        """Refuse a report that no UAV of the fleet can send; give ``log`` for one that is joining
        it."""
        if log is None and report.id not in self.logs:
            raise InputError(
                f"ID: {show(report.id)} is not a UAV of this fleet: {listed(self.uavs)}"
            )
        for name, time in (("time", report.time), ("source time", report.source_time)):
            if time is not None and time > report.received + AGREE:
                late = f"{time:.13g} s is {time - report.received:.1f} s after it came in"
                raise InputError(f"{name}: {late}: set the clock of the UAV")
        if report.received - report.time > UNSET:
            early = (
                f"{report.time:.13g} s is {report.received - report.time:.3g} s before it came in"
            )
            raise InputError(f"time: {early}: the clock of {report.id} is not set")
        (log or self.logs[report.id]).check(report)

    def step_of(self, time: float) -> int:
        """The step in which an instant lies."""
        return math.floor((time - self.start) / self.node.dt + _ROUNDING)

    def add(self, report: Report, origin: int | None = None) -> FilledReport | None:
        """Let a report come in now; None if it is known already, or was generated before the start.

        ``origin`` is the landing point from which a UAV in flight took off, if that is known.
        """
        log = self.logs[report.id]
        if log.has(report) or (self.has_begun and report.time < self.start):
            return None
        if not self.has_begun:
            filled = log.add(report, 0, None)
            if all(each.newest for each in self.logs.values()):
                self.begin(report.received)
            return filled
        filled = self.put(report, origin)
        held_back = self.node.scenario.delay.hold == "max"
        due = max(self.step, filled.step + self.node.law_longest) if held_back else self.step
        self.pending.append((due, report.id, filled))
        self._collect()
        return filled

    def begin(self, now: float) -> None:
        """Begin at an instant [s], by when every UAV has sent a report."""
        newest = {uav: log.reports[-1].report for uav, log in self.logs.items()}
        self.has_begun = True
        self.start = min(each.time for each in newest.values())
        self.step = self.first_step = max(self.step_of(now), 0)
        for uav, report in newest.items():
            self.logs[uav].reports.clear()
            self.held[uav] = self.put(report)
        self._begin_step()

    def put(self, report: Report, origin: int | None = None) -> FilledReport:
        """Put a report into the log of its UAV, whatever counts; as of ``add``."""
        detected = None if report.source_time is None else max(self.step_of(report.source_time), 0)
        return self.logs[report.id].add(
            report, min(self.step_of(report.time), self.step), detected, origin
        )

    # Steps.

    def steps(self, until: float) -> Iterator[TensorDictBase]:
        """Take all steps up to that in which an instant lies [s], and give the outputs of each."""
        while True:
            while self._coming and self.step_of(self._coming[0].received) <= self.step:
                self.add(self._coming.popleft())
            yield self.observe()
            if self.step >= self.step_of(until):
                return
            self.next_step()

    def observe(self) -> TensorDictBase:
        """The outputs of this step, computed from the reports that have come in so far."""
        if self._outputs is None:
            if self.before is None:
                self._after, self._outputs = self.node.begin(self._reported())
            else:
                self._after, self._outputs = self.node.step(
                    self.before, self._reported(), *self._previous
                )
        return self._outputs

    def next_step(self) -> None:
        """End this step; in the next one it counts who has ``chosen`` which ``action`` in this
        one."""
        self.observe()
        self.before = self._after
        self.step = self.step + 1
        self._previous = (self.action, self.chosen)
        self._begin_step()

    def begin_anew(self, step: int) -> None:
        """Go on in a later step, or in this one, with nothing but the message of each UAV."""
        self.before = None
        self.step = step
        self.first_step = step
        self._begin_step()
        self._previous = self.action, self.chosen

    def choose(self, uav: str, action: Any) -> None:
        """Note the action that a UAV has chosen in this step."""
        number = self.uavs.index(uav)
        self.action, self.chosen = self.action.clone(), self.chosen.clone()
        self.action[0, number], self.chosen[0, number] = torch.tensor(action), True

    def _begin_step(self) -> None:
        self.action = self.node.env.full_action_spec[keys.ACTION].zero()
        self.chosen = torch.zeros(1, len(self.uavs), dtype=torch.bool)
        self._held_before = dict(self.held)
        self._arrived = list[tuple[str, FilledReport]]()
        self._outputs = None
        self._collect()

    def _collect(self) -> None:
        """Let the reports that count by now arrive."""
        due = [(uav, filled) for step, uav, filled in self.pending if step <= self.step]
        if not due:
            return
        self.pending = [each for each in self.pending if each[0] > self.step]
        arrived = sorted([*self._arrived, *due], key=lambda each: each[1].order)
        self._arrived = [*{(uav, filled.step): (uav, filled) for uav, filled in arrived}.values()]
        self.held = dict(self._held_before)
        self._outputs = None
        by_arrival = self.node.scenario.delay.order == "arrival"
        for uav, filled in self._arrived:
            if by_arrival or filled.order >= self.held[uav].order:
                self.held[uav] = filled

    def _reported(self) -> Reported:
        arrived = {(uav, filled.step): filled for uav, filled in self._arrived}
        late = {
            key: filled for key, filled in arrived.items() if self.first_step < key[1] < self.step
        }
        rows = self._messages([*late.values()]).pack() if late else ()
        return Reported(
            state=self.state([]),
            age=self.step - torch.tensor([each.step for each in self.held.values()]),
            on_time=torch.tensor(
                [
                    each.step == self.step and (uav, self.step) in arrived
                    for uav, each in self.held.items()
                ]
            ),
            late=[
                LateMessage(row, self.uavs.index(uav), self.step - step)
                for row, (uav, step) in zip(rows, late, strict=True)
            ],
        )

    def _messages(self, reports: Sequence[FilledReport]) -> Messages:
        return messages_of(reports, self.node.scenario.battery, self.points, self.node.dt)

    def state(self, asking: Sequence[str]) -> State:
        """The world, as far as it is known; the UAVs that ask are ready to choose."""
        sent = self._messages([*self.held.values()])
        goal = torch.tensor([[self._standing(uav, uav in asking) for uav in self.uavs]])
        ready = torch.tensor([[uav in asking for uav in self.uavs]])
        return self.node.blank._replace(
            steps=torch.tensor([self.step]),
            goal=goal,
            origin=goal,
            elapsed=torch.where(ready, NEVER_DECIDED, -1),
            battery=sent.battery.unsqueeze(0),
            track=sent.track.unsqueeze(0),
            sent=type(sent)._make(field.unsqueeze(0) for field in sent),
        )
