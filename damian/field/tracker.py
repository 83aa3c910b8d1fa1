"""Follows UAVs by their reports: takes the steps of the server node with what had come in by then.

Step k lasts from ``start + k dt`` on; the oldest first report was generated at the start. A message belongs
to the step in which it was generated, and counts from the step in which it came in.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDictBase

from damian import keys
from damian.common.checks import SECONDS
from damian.common.errors import InputError
from damian.common.text_files import listed, show
from damian.field.known import FilledReport, UavLog, messages_of
from damian.field.node import LateMessage, Memories, Node, Reported
from damian.field.rows import Place, Report
from damian.world.messages import Messages
from damian.world.state import State

FUTURE = 1.0
"""How far the clock of a UAV may be ahead of that of the server [s]."""
SILENT_STEPS = 1000
"""Steps without any report after which beliefs stand still."""
NEVER_DECIDED = 2**31
"""Steps since the latest decision of a UAV that is ready to choose."""
_ROUNDING = 1e-3
"""Share of a step by which times may be rounded."""


class Order(NamedTuple):
    """A flight on which a UAV was sent, or its stay."""

    time: float
    """When it was told [s]."""
    origin: int
    goal: int
    """Landing points from which and to which it flies."""


def latest(orders: Sequence[Order], time: float) -> Order | None:
    """The last of the orders that were told before an instant [s]."""
    return next((each for each in reversed(orders) if each.time < time), None)


class Tracker:
    """The server node of UAVs that report; ``node_of`` gives the node for a number of them."""

    def __init__(self, uavs: Sequence[str], node_of: Callable[[int], Node]) -> None:
        self._node_of = node_of
        self.start: float | None = None
        """When step 0 began [s]; None until every UAV has reported."""
        self.clock, self.step, self.first_step = 0.0, 0, 0
        self.held: dict[str, FilledReport] = {}
        """The message of each UAV that the server holds."""
        self.arrived: list[tuple[str, FilledReport]] = []
        """Messages that count from this step on, by UAV."""
        self.orders: defaultdict[str, list[Order]] = defaultdict(list)
        """Orders that UAVs have followed, oldest first, by UAV."""
        self._logs: dict[str, UavLog] = {}
        self._joining: list[str] = []
        self._pending: list[tuple[int, str, FilledReport]] = []
        """Reports that have come in and count later: the step from which they do, the UAV, the report."""
        self._last_arrival = 0
        self._become([*uavs])

    def _become(self, uavs: list[str]) -> None:
        """Go on with these UAVs; what the node remembers begins anew."""
        self.uavs, self.node = uavs, self._node_of(len(uavs))
        self.points = self.node.simulation.airspace.points[0]
        n_stops = self.node.server.observation.stops
        n_readings = sum(each.width for each in self.node.simulation.sensors.values())
        told = n_stops, n_readings, self.node.dt
        self._logs = {uav: self._logs.get(uav) or UavLog(self.node.ground, *told) for uav in uavs}
        self._pending = [each for each in self._pending if each[1] in uavs]
        self._before: Memories | None = None
        """What the node remembers after the step before; ``_after`` this step."""
        self._after: Memories = []
        self._outputs: TensorDictBase | None = None
        self.arrived, self._begun = [], self.step
        if self.start is None:
            self._begin()

    # Reports.

    def step_of(self, time: float) -> int:
        """The step in which an instant lies."""
        return math.floor((time - (self.start or 0.0)) / self.node.dt + _ROUNDING)

    @property
    def missing(self) -> list[str]:
        """The UAVs that have not reported yet."""
        return [uav for uav, log in self._logs.items() if log.newest is None]

    def change_members(self, join: Sequence[str], leave: Sequence[str]) -> None:
        """Let UAVs leave now, and join with their first reports."""
        self._joining = [uav for uav in self._joining if uav not in leave]
        stay = [uav for uav in self.uavs if uav not in leave]
        if self.start is None:
            self._become([*stay, *join])
            return
        if stay != self.uavs:
            self._become(stay)
        self._joining += join

    def report(self, report: Report) -> None:
        """Take a report that comes in, after the steps before it (``advance``).

        Nothing changes with one that is known already, or was generated before the start.
        """
        joins = report.id in self._joining
        if joins:
            self._joining.remove(report.id)
            self._become([*self.uavs, report.id])
        self._check(report)
        log = self._logs[report.id]
        if joins:
            self.held[report.id] = self._add(report)
        elif log.has(report.time):
            return
        elif self.start is None:
            log.add(report, 0, None)
            self._begin()
        elif report.time >= self.start:
            filled, due = self._add(report), self.step
            if self.node.scenario.delay.hold == "max":
                due = max(due, filled.step + self.node.law_longest)
            self._pending.append((due, report.id, filled))
            self._outputs = None
            self._collect()

    def _add(self, report: Report) -> FilledReport:
        """Add a report to the log of its UAV."""
        detected = None if report.source_time is None else max(self.step_of(report.source_time), 0)
        order, step = latest(self.orders[report.id], report.time), min(self.step_of(report.time), self.step)
        sent = order and (order.origin, order.goal)
        return self._logs[report.id].add(report, step, detected, sent)

    def follow(self, uav: str, time: float, goal: Place) -> None:
        """Take a UAV to follow an order of an instant [s] to fly to a place, or to stay there."""
        held, before = self.held[uav], latest(self.orders[uav], math.inf)
        origin = before.goal if before and held.report.time <= before.time else held.target
        self.orders[uav].append(Order(time, origin, self.node.ground.landing_point(goal)))

    def _check(self, report: Report) -> None:
        if report.id not in self._logs:
            raise InputError(f"ID: {show(report.id)} is not a UAV of this fleet: {listed(self.uavs)}")
        for name, time in (("time", report.time), ("source time", report.source_time)):
            if time is not None and time > report.received + FUTURE:
                late = f"{time:.13g} s is {time - report.received:.1f} s after it came in"
                raise InputError(f"{name}: {late}: set the clock of the UAV")
        if self.start is not None and report.received - self.start > SECONDS:
            raise InputError(f"time: the first reports are more than {SECONDS:g} s older: leave them out")
        self._logs[report.id].check(report)

    def _begin(self) -> None:
        """Begin with the newest report of each UAV, once each has one."""
        if self.missing:
            return
        newest = [(log, log.reports[-1].report) for log in self._logs.values()]
        self.start = min(report.time for _, report in newest)
        self.step = self.first_step = self._begun = self._last_arrival = max(self.step_of(self.clock), 0)
        for log, report in newest:
            log.reports.clear()
            self.held[report.id] = self._add(report)

    def _collect(self) -> None:
        """Let the reports that count by now arrive."""
        due = [each for each in self._pending if each[0] <= self.step]
        if not due:
            return
        self._pending = [each for each in self._pending if each[0] > self.step]
        self._outputs, self._last_arrival = None, self.step
        by_arrival = self.node.scenario.delay.order == "arrival"
        for _, uav, filled in sorted(due, key=lambda each: each[2].report.time):
            held = self.held[uav]
            # Of those that arrive in the same step, the one that was generated last counts as the last.
            earlier = by_arrival and not any(each is held for _, each in self.arrived)
            self.arrived.append((uav, filled))
            if earlier or filled.report.time > held.report.time:
                self.held[uav] = filled

    # Steps.

    def advance(self, now: float, first: float = math.inf) -> Iterator[int]:
        """Take all steps up to an instant [s]; stops at the end of each one from ``first`` on.

        Steps before ``first`` in which nothing happens are skipped, unless something changes by itself.
        """
        self.clock = max(self.clock, now)
        if self.start is None:
            return
        last = self.step_of(self.clock)
        while self.step < last:
            if self.step >= first:
                yield self.step
            following, skipped = self.step + 1, last - self.node.held_back
            settles = SILENT_STEPS if self.node.diffuses else self.node.settles
            if self._before is not None and self._last_arrival + settles <= self.step < skipped:
                if self.step < first:
                    following = int(min([skipped, first, *(due for due, _, _ in self._pending)]))
                self._before = self.node.skip(self._before, following - self.step)
            else:
                self.observe()
                self._before = self._after
            self.step, self._outputs, self.arrived = following, None, []
            self._collect()

    def observe(self) -> TensorDictBase:
        """The outputs of the step, from what has arrived by now."""
        if self._outputs is None:
            reported = self._reported()
            if self._before is None:
                self._after, self._outputs = self.node.begin(reported)
            else:
                action = self.node.env.full_action_spec[keys.ACTION].zero()  # nothing here depends on it
                self._after, self._outputs = self.node.step(
                    self._before, reported, action, torch.zeros(1, len(self.uavs), dtype=torch.bool)
                )
        return self._outputs

    def _reported(self) -> Reported:
        arrived = {(uav, filled.step): filled for uav, filled in self.arrived}
        late = {key: filled for key, filled in arrived.items() if self._begun < key[1] < self.step}
        rows = self._messages([*late.values()]).pack() if late else ()
        held = [self.held[uav] for uav in self.uavs]
        pairs = zip(self.uavs, held, strict=True)
        on_time = [each.step == self.step and (uav, self.step) in arrived for uav, each in pairs]
        return Reported(
            state=self.state([]),
            age=self.step - torch.tensor([each.step for each in held]),
            on_time=torch.tensor(on_time),
            late=[
                LateMessage(row, self.uavs.index(uav), self.step - step)
                for row, (uav, step) in zip(rows, late, strict=True)
            ],
        )

    def _messages(self, reports: Sequence[FilledReport]) -> Messages:
        return messages_of(reports, self.node.server, self.points, self.node.dt)

    def state(self, asking: Sequence[str]) -> State:
        """The world, as far as it is known; the UAVs that ask are ready to choose."""
        sent = self._messages([self.held[uav] for uav in self.uavs])
        goal = torch.tensor([[self.held[uav].target for uav in self.uavs]])
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
