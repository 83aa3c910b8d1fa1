"""Follows UAVs by their reports: takes the steps of the server node with what had come in by then.

Step k lasts from ``start + k dt`` on; the oldest first report was generated at the start. A message belongs
to the step in which it was generated, and counts from the step in which it came in.
"""

import math
from collections import deque
from collections.abc import Iterator, Sequence

import torch
from tensordict import TensorDictBase

from damian import keys
from damian.common.checks import SECONDS
from damian.common.errors import InputError
from damian.common.text_files import listed, named, show
from damian.field.known import FilledReport, UavLog, messages_of
from damian.field.node import LateMessage, Node, Reported
from damian.field.rows import Report, Rows
from damian.world.messages import Messages
from damian.world.state import State

FUTURE = 1.0
"""How far the clock of a UAV may be ahead of that of the server [s]."""
NEVER_DECIDED = 2**31
"""Steps since the latest decision of a UAV that is ready to choose."""
_ROUNDING = 1e-3
"""Share of a step by which times may be rounded."""


class Tracker:
    """The server node of a fleet, once every UAV has sent a report; ``rows`` are their reports in any order.

    It begins with the newest report of each UAV, once each has one.
    """

    def __init__(self, node: Node, uavs: Sequence[str], rows: Rows) -> None:
        self.node, self.uavs = node, [*uavs]
        self.points = node.simulation.airspace.points[0]
        told = node.ground, node.server.observation.stops, node.simulation.widths.readings, node.dt
        self._logs = {uav: UavLog(*told) for uav in uavs}
        for where, report in rows:
            with named(where):
                self._check(report)
        self._coming = deque(sorted((report for _, report in rows), key=lambda each: each.received))
        """Reports that have not come in yet."""
        self._pending: list[tuple[int, str, FilledReport]] = []
        """Reports that have come in and count later: the step from which they do, the UAV, the report."""
        self._arrived: list[tuple[str, FilledReport]] = []
        """Messages that count from this step on, by UAV."""
        newest: dict[str, Report] = {}
        report = self._coming[0]
        while len(newest) < len(self.uavs):
            report = self._coming.popleft()
            if report.id not in newest or report.time > newest[report.id].time:
                newest[report.id] = report
        self.start = min(each.time for each in newest.values())
        """When step 0 began [s]."""
        if self._coming and self._coming[-1].received - self.start > SECONDS:
            raise InputError(f"time: the first reports are more than {SECONDS:g} s older: leave them out")
        self.step = self.first_step = max(self.step_of(report.received), 0)
        self.held = {uav: self._add(newest[uav]) for uav in self.uavs}
        """The message of each UAV that the server holds."""

    def _check(self, report: Report) -> None:
        if report.id not in self._logs:
            raise InputError(f"ID: {show(report.id)} is not a UAV of this fleet: {listed(self.uavs)}")
        for name, time in (("time", report.time), ("source time", report.source_time)):
            if time is not None and time > report.received + FUTURE:
                late = f"{time:.13g} s is {time - report.received:.1f} s after it came in"
                raise InputError(f"{name}: {late}: set the clock of the UAV")
        self._logs[report.id].check(report)

    def step_of(self, time: float) -> int:
        """The step in which an instant lies."""
        return math.floor((time - self.start) / self.node.dt + _ROUNDING)

    def steps(self, until: float) -> Iterator[TensorDictBase]:
        """Take all steps up to that in which an instant lies [s], and give the outputs of each."""
        action = self.node.env.full_action_spec[keys.ACTION].zero()  # nothing here depends on it
        nobody, memories = torch.zeros(1, len(self.uavs), dtype=torch.bool), None
        for step in range(self.first_step, self.step_of(until) + 1):
            self.step = step
            self._collect()
            if memories is None:
                memories, outputs = self.node.begin(self._reported())
            else:
                memories, outputs = self.node.step(memories, self._reported(), action, nobody)
            yield outputs

    def _collect(self) -> None:
        """Let the reports that count by now arrive; those that were generated before the start never do."""
        while self._coming and self.step_of(self._coming[0].received) <= self.step:
            report = self._coming.popleft()
            if report.time >= self.start and not self._logs[report.id].has(report.time):
                filled = self._add(report)
                held_back = self.node.scenario.delay.hold == "max"
                due = filled.step + self.node.law_longest if held_back else self.step
                self._pending.append((due, report.id, filled))
        due = sorted((each for each in self._pending if each[0] <= self.step), key=lambda x: x[2].report.time)
        self._pending = [each for each in self._pending if each[0] > self.step]
        self._arrived = [(uav, filled) for _, uav, filled in due]
        by_arrival = self.node.scenario.delay.order == "arrival"
        for uav, filled in self._arrived:
            if by_arrival or filled.report.time > self.held[uav].report.time:
                self.held[uav] = filled

    def _add(self, report: Report) -> FilledReport:
        """Add a report to the log of its UAV."""
        detected = None if report.source_time is None else max(self.step_of(report.source_time), 0)
        return self._logs[report.id].add(report, min(self.step_of(report.time), self.step), detected)

    def _reported(self) -> Reported:
        arrived = {(uav, filled.step): filled for uav, filled in self._arrived}
        late = {key: filled for key, filled in arrived.items() if self.first_step < key[1] < self.step}
        rows = self._messages([*late.values()]).pack() if late else ()
        return Reported(
            state=self.state([]),
            age=self.step - torch.tensor([each.step for each in self.held.values()]),
            on_time=torch.tensor(
                [each.step == self.step and (uav, self.step) in arrived for uav, each in self.held.items()]
            ),
            late=[
                LateMessage(row, self.uavs.index(uav), self.step - step)
                for row, (uav, step) in zip(rows, late, strict=True)
            ],
        )

    def _messages(self, reports: Sequence[FilledReport]) -> Messages:
        return messages_of(reports, self.node.server, self.points, self.node.dt)

    def state(self, asking: Sequence[str]) -> State:
        """The world, as far as it is known; the UAVs that ask are ready to choose."""
        sent = self._messages([*self.held.values()])
        goal = torch.tensor([[each.target for each in self.held.values()]])
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
