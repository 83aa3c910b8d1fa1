"""A fleet of real UAVs: what it knows, what each UAV may be told, and what it does of that.

What happens to a fleet is a list of events, plain data. ``reported``, ``advised`` and so on look at
a request and give its event, and change nothing; ``apply`` takes an event into account. So a fleet
that applies the
stored events again knows what was answered: it reads that from them, and never decides again.

Worked timeline, an answer that holds for 10 s: at 100 s the UAV asks and is offered a landing point
until 110 s; if it asks again before, it gets the same answer. At 103 s it says ``accepted``, and
from then on the service takes it to fly to that landing point. Without an acceptance by 110 s, it
is taken to stay.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import shapely
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from damian import keys
from damian.common.checks import SECONDS
from damian.common.errors import InputError
from damian.common.text_files import listed, named, show
from damian.world.battery import flight_drain
from damian.world.vehicles import check_levels
from damian_fleet.advice import Adviser, Policy
from damian_fleet.known import FilledReport, UavLog
from damian_fleet.node import Node
from damian_fleet.reports import Report, Rows, validated, written
from damian_fleet.rows import (
    MOST_UAVS,
    Acknowledgement,
    Advice,
    Asking,
    Change,
    Command,
    FleetStatus,
    Speaker,
    UavStatus,
    said_by,
)
from damian_fleet.settings import FleetConfig

GRACE = 60.0
"""A UAV that stands elsewhere so long after twice the duration of its flight has ended that [s]."""
LEASE = 30.0
"""How long a UAV is of the bridge that spoke for it last [s]; in a flight, until that is over."""
MOST_STEPS = 3600
"""Steps that are taken at once, or again after a restart; beliefs begin anew after earlier ones."""
KEPT_REPORTS, KEPT_ANSWERS = 512, 64
"""Of a UAV: a late report changes what newer ones left open, and may be of a flight that is
over."""
REASONS = ("silent", "battery", "held", "returning", "aborted", "airborne", "conflict", "detour")
"""Why a UAV is not told what the policy chooses: it stands, and its newest report is too old; its
battery is below the reserve, would be after the flight, or was never reported; a person holds it,
or sends it home; it has aborted a flight without a report since, or flies without an answer;
another UAV is in its way; the straight way there leaves the region, or crosses a zone."""
OFFERED, ACCEPTED, TAKEN_OFF, LANDED = "offered", "accepted", "taken off", "landed"
"""How far an answer has come; it never goes back."""
REFUSED, ABORTED, LAPSED = "refused", "aborted", "lapsed"
"""How an answer ends that is not flown: by the UAV, in flight, or because nobody accepted it in
time."""
AFTER = {
    ACCEPTED: {OFFERED: ACCEPTED},
    REFUSED: {OFFERED: REFUSED},
    ABORTED: {OFFERED: REFUSED, ACCEPTED: ABORTED, TAKEN_OFF: ABORTED},
    TAKEN_OFF: dict.fromkeys((OFFERED, LAPSED, ACCEPTED), TAKEN_OFF),
    LANDED: dict.fromkeys((OFFERED, LAPSED, ACCEPTED, TAKEN_OFF), LANDED),
}
"""How far an answer has come once a UAV says something of it, by how far it had come before; facts
(taken off, landed) count whenever they are said, and nothing undoes an end."""

Event = dict[str, Any]


class Waiting(InputError):
    """The fleet has not begun, because UAVs have not reported yet; ``str(error)`` names them."""


class Held(InputError):
    """Another bridge speaks for the UAV, or for its vehicle."""


@dataclass
class Lease:
    """Which bridge speaks for a UAV, for which vehicle (empty if it does not tell), and when it did
    last [s];
    None after a restart of the service. ``warning``: who else has tried to since."""

    bridge: str
    vehicle: str
    seen: float | None
    warning: str = ""


@dataclass
class Decision:
    """What a UAV was told: to fly from a landing point, ``origin``, to ``goal``, or to hold if both
    are one.

    ``start`` is where it stood, east and north [m], maybe beside the landing point. Times and
    durations in seconds. ``action`` is a number, or distance and heading in [0, 1]; None if the
    policy has not chosen it, but one of ``REASONS``. ``until`` is the end of the time in which it
    may be accepted. ``since`` is the step up to which reports are older than what is known of it.
    """

    step: int
    time: float
    action: Any
    origin: int
    goal: int
    start: tuple[float, float]
    duration: float
    until: float
    reason: str | None = None
    since: int = 0
    status: str = OFFERED
    advice: dict[str, Any] = field(default_factory=dict)

    @property
    def moves(self) -> bool:
        return self.goal != self.origin

    @property
    def kind(self) -> str:
        """``fly``, ``hold``, or ``return``: a flight that the policy has not chosen."""
        return "hold" if not self.moves else "return" if self.action is None else "fly"

    @property
    def is_followed(self) -> bool:
        """Whether the UAV follows it, or has followed it."""
        counts = self.moves or self.action is not None
        return counts and self.status in (ACCEPTED, TAKEN_OFF, LANDED, ABORTED)

    @property
    def is_open(self) -> bool:
        """Whether the UAV is taken to be on its way."""
        return self.moves and self.status in (ACCEPTED, TAKEN_OFF)

    def is_live(self, now: float) -> bool:
        """Whether it may be accepted at an instant [s]."""
        return self.status == OFFERED and now <= self.until

    def after(self, said: str, now: float, status: str) -> str:
        """Its status after what a UAV says at an instant [s], from what the status was."""
        was = LAPSED if status == OFFERED and now > self.until else status
        found = AFTER[said].get(was, was)
        return LANDED if found == ACCEPTED and not self.moves else found


@dataclass
class Uav:
    """A UAV of a fleet: its flight level [m], the landing point of its first report, the command of
    a person (``hold``, ``return``, or none), its latest answers, oldest first, and how its reports
    came in."""

    id: str
    level: float
    home: int | None = None
    command: str = ""
    answers: list[Decision] = field(default_factory=list)
    received: int = 0
    duplicates: int = 0

    @property
    def offer(self) -> Decision | None:
        """The latest answer."""
        return self.answers[-1] if self.answers else None

    @property
    def order(self) -> Decision | None:
        """What it has followed last."""
        return next((each for each in reversed(self.answers) if each.is_followed), None)

    @property
    def open_order(self) -> Decision | None:
        """The flight on which it is taken to be."""
        return self.order if self.order and self.order.is_open else None

    def answer(self, answer: str) -> Decision | None:
        """The answer of an ID."""
        return next((each for each in self.answers if each.advice["answer"] == answer), None)

    def lapse(self) -> None:
        """End the answer that it has not accepted."""
        if self.offer and self.offer.status == OFFERED:
            self.offer.status = LAPSED


class Fleet:
    """The server node of one fleet, and the policy that it asks.

    Args:
        parts: gives the node and the policy for a number of UAVs; fleets may share them.
        uavs: the IDs of the UAVs, which book landing points in this order.
        config: what it holds to, whatever the policy chooses.
        mark: begins the IDs of answers.
        computed_from: time before which no step is computed [s], because the fleet is restored.
    """

    def __init__(
        self,
        parts: Callable[[int], tuple[Node, Policy]],
        uavs: Sequence[str],
        config: FleetConfig,
        mark: str = "",
        computed_from: float = 0.0,
    ) -> None:
        self.parts = parts
        self.config = config
        self.mark = mark
        self.computed_from = computed_from
        self.clock = 0.0
        self.n_answers = 0
        self.uavs: dict[str, Uav] = {}
        self.leases: dict[str, Lease] = {}
        """The bridges that speak for UAVs."""
        self.others: Callable[[], Iterable[Fleet]] = lambda: [self]
        """All fleets of the service, this one included."""
        self.joining: dict[str, UavLog] = {}
        """UAVs that join with their first report."""
        self._take_in(uavs)
        self.ground = self.node.ground
        check_levels(self.config.levels[: len(uavs)], self.node.simulation.airspace)

    def _take_in(self, uavs: Sequence[str]) -> None:
        """Go on with these UAVs: the node, the policy and the tracker for so many."""
        self.uavs = {uav: self.uavs[uav] for uav in uavs if uav in self.uavs}
        for uav in uavs:
            used = [each.level for each in self.uavs.values()]
            level = min(self.config.levels, key=lambda level: (used.count(level), level))
            self.uavs.setdefault(uav, Uav(uav, level))
        self.node, policy = self.parts(len(uavs))
        self.tracker = Adviser(self.node, uavs, policy, standing=self._standing)

    def members(self, uavs: Iterable[str] | None, key: str) -> list[Uav]:
        """UAVs of these IDs, or all, in the order of the fleet."""
        wanted = {*self.uavs} if uavs is None else {*uavs}
        for uav in wanted - {*self.uavs}:
            raise InputError(
                f"{key}: {show(uav)} is not a UAV of this fleet: {listed([*self.uavs])}"
            )
        return [each for name, each in self.uavs.items() if name in wanted]

    # Time.

    def advance(self, now: float) -> None:
        """Take all steps up to an instant [s], or skip them if they are too many or of before a
        restart."""
        self.clock = max(self.clock, now)
        tracker = self.tracker
        last = tracker.step_of(self.clock) if tracker.has_begun else tracker.step
        if last > tracker.step and (
            self.clock < self.computed_from or last > tracker.step + MOST_STEPS
        ):
            tracker.begin_anew(last)
        while tracker.step < last:
            tracker.next_step()

    def _at(self, now: float) -> float:
        """The time of an event: that of the fleet never goes back."""
        if self.tracker.has_begun and now - self.tracker.start > SECONDS:
            raise InputError(
                f"time: the fleet began {SECONDS:g} s ago: end it, and begin a new one"
            )
        return max(now, self.clock)

    # Requests as events.

    def reported(self, rows: Rows, now: float) -> Event:
        """Reports that come in together; all or none."""
        at = self._at(now)
        said = []
        speakers = dict[str, Any]()
        for where, report in rows:
            with named(where):
                speaker = validated(Speaker, {"ID": report.id, **(report.model_extra or {})})
                said.append(said_by(report))
                report.stamp(at)
                self.tracker.check(report, self.joining.get(report.id))
            self.require_lease(report.id, speaker.bridge, at, speaker.vehicle)
            if speaker.bridge:
                speakers[report.id] = [speaker.bridge, speaker.vehicle]
        return {"received": at, "reports": said, **({"speakers": speakers} if speakers else {})}

    def acknowledged(self, rows: Sequence[Acknowledgement], now: float) -> Event:
        """What UAVs say of their answers; how far these have come stands in the event."""
        at = self._at(now)
        said = []
        so_far = dict[str, str]()
        self.advance(at)
        for row in rows:
            (uav,) = self.members([row.id], "ID")
            self.require_lease(uav.id, row.bridge, at)
            decision = uav.answer(row.answer)
            status = "unknown"
            if decision is not None:
                before = so_far.get(row.answer, decision.status)
                accepts = row.status == ACCEPTED and before == OFFERED
                is_outdated = accepts and self._is_outdated(uav, decision)
                status = LAPSED if is_outdated else decision.after(row.status, at, before)
                so_far[row.answer] = status
            said.append({"ID": row.id, "answer": row.answer, "said": row.status, "status": status})
        return {"received": at, "acknowledged": said}

    def commanded(self, said: Command, now: float) -> Event:
        """A person lets UAVs hold or return until they ``resume``."""
        uavs = [uav.id for uav in self.members(said.uavs, "uavs")]
        return {"received": self._at(now), "command": said.command, "uavs": uavs}

    def changed(self, said: Change, now: float) -> Event:
        """UAVs join with their first reports, and leave now."""
        for uav in said.leave if said.bridge is not None else ():
            self.require_lease(uav, said.bridge, self._at(now))
        known = [*self.uavs, *self.joining]
        join = [uav for uav in dict.fromkeys(said.join) if uav not in known]
        leave = [uav for uav in known if uav in said.leave]
        n_uavs = len(known) - len(leave) + len(join)
        if {*self.uavs} <= {*leave} or n_uavs > MOST_UAVS:
            raise InputError(f"uavs: a fleet has 1 to {MOST_UAVS} UAVs: end it instead")
        self.parts(n_uavs)  # refuses another number of UAVs if the policy does
        return {"received": self._at(now), "join": join, "leave": leave}

    def advised(self, said: Asking, now: float) -> Event | None:
        """What UAVs are told that ask; None if that is what they have been told already.

        A UAV that is in danger is told to hold or to return instead; one that has an answer which
        still holds, or follows one, does not choose.
        """
        asked = self.members(said.uavs, "uavs")
        at = self._at(now)
        self.advance(at)
        for uav in asked if said.bridge else ():
            self.require_lease(uav.id, said.bridge, at)
        if not self.tracker.has_begun:
            waits = listed([uav for uav, log in self.tracker.logs.items() if log.newest is None])
            raise Waiting(f"no advice yet: no report of {waits} has come in")
        found = dict[str, Decision]()
        choosing = list[str]()
        for uav in asked:
            if reason := self.danger(uav):
                if not self._is_told(uav, reason):
                    found[uav.id] = self._instead(uav, reason)
            elif not self._is_busy(uav):
                choosing.append(uav.id)
        if choosing:
            ready = zip(self.uavs, self.tracker.observe()[keys.READY][0].tolist(), strict=True)
            choosing = [uav for uav, is_ready in ready if is_ready and uav in choosing]
            found |= self._chosen(choosing) if choosing else {}
        told = self._cleared([(uav, found[uav.id]) for uav in asked if uav.id in found])
        return {"received": at, "told": told} if told else None

    def _chosen(self, choosing: Sequence[str]) -> dict[str, Decision]:
        """What the policy chooses."""
        action = self.tracker.ask(choosing)
        mask = torch.tensor([[uav in choosing for uav in self.uavs]])
        goal = self.node.simulation.decide(self.tracker.state(choosing), action, mask).goal
        rows = zip(self.uavs.values(), action[0].tolist(), goal[0].tolist(), strict=True)
        return {uav.id: self._decision(uav, *row) for uav, *row in rows if uav.id in choosing}

    # Who speaks for a UAV.

    def require_lease(self, uav: str, bridge: str, now: float, vehicle: str = "") -> None:
        """Refuse a bridge while another one speaks for the UAV, or its vehicle is a UAV of another
        name."""
        told = bridge[:6] or "without a name"
        own = self.leases.get(uav)
        if own is not None:
            own.seen = now if own.seen is None else own.seen
            if own.bridge != bridge and self.holds(uav, now):
                own.warning = f"bridge {told} has tried to speak for UAV {uav}: end it"
                remedy = f"end that one, or wait until it has not been heard for {LEASE:g} s"
                raise Held(f"bridge: {own.bridge[:6]} speaks for UAV {uav}, not {told}: {remedy}")
        for fleet in self.others() if vehicle else ():
            for name, lease in fleet.leases.items():
                if lease.vehicle == vehicle and (fleet is not self or name != uav):
                    lease.warning = f"bridge {told} has called its vehicle {uav}: end it"
                    raise Held(
                        f"bridge: the vehicle of {uav} is UAV {name}: let that leave its fleet first"
                    )
        if own is not None and own.bridge == bridge:
            own.seen = now

    def holds(self, uav: str, now: float) -> bool:
        """Whether the bridge that spoke for a UAV last still has it."""
        seen = self.leases[uav].seen or 0.0
        member = self.uavs.get(uav)
        if order := member and member.open_order:
            seen = max(seen, order.time + 2 * order.duration + GRACE)
        return now <= seen + LEASE

    def warnings(self, uavs: Iterable[str]) -> str:
        """Who else has tried to speak for UAVs since this was asked last."""
        leases = [self.leases[uav] for uav in uavs if uav in self.leases]
        found = "; ".join(lease.warning for lease in leases if lease.warning)
        for lease in leases:
            lease.warning = ""
        return found

    # Events.

    def apply(self, event: Event) -> list[str]:
        """Take an event into account; returns what became of its rows, or to which UAVs it
        applies."""
        self.advance(event["received"])
        if "reports" in event:
            for uav, speaker in event.get("speakers", {}).items():
                lease = Lease(*speaker, event["received"])
                if (before := self.leases.get(uav)) and before.bridge == lease.bridge:
                    lease.warning = before.warning
                self.leases[uav] = lease
            return [
                self._report(validated(Report, row), event["received"]) for row in event["reports"]
            ]
        if "acknowledged" in event:
            return [self._acknowledge(**row) for row in event["acknowledged"]]
        if "told" in event:
            self._tell([Decision(**told) for told in event["told"]])
        elif "command" in event:
            for uav in self.members(event["uavs"], "uavs"):
                uav.command = "" if event["command"] == "resume" else event["command"]
                uav.lapse()
            return event["uavs"]
        else:
            self._change(event["join"], event["leave"])
        return [*self.uavs]

    def _report(self, report: Report, received: float) -> str:
        """Add a report; it is ``new``, ``late``, ``duplicate``, or ``old`` (before the start)."""
        report.stamp(received)
        if report.id in self.joining:
            self._regroup([*self.uavs, report.id], report)
            self.uavs[report.id].received = 1
            return "new"
        uav = self.uavs[report.id]
        log = self.tracker.logs[report.id]
        uav.received += 1
        if log.has(report):
            uav.duplicates += 1
            return "duplicate"
        late = log.newest is not None and report.time < log.newest.report.time
        sent = None
        if report.flies:
            told = (
                each
                for each in reversed(uav.answers)
                if each.is_followed and each.time < report.time
            )
            sent = next(told, None)
        if sent and report.place("target_") is None:
            for column, value in zip(
                self.ground.columns, self.ground.place(sent.goal), strict=True
            ):
                setattr(report, f"target_{column}", value)
        filled = self.tracker.add(report, sent and sent.origin)
        if filled is None:
            return "old"
        del log.reports[:-KEPT_REPORTS]
        uav.home = filled.point if uav.home is None else uav.home
        self._note(uav, filled)
        return "late" if late else "new"

    def _note(self, uav: Uav, filled: FilledReport) -> None:
        """Note what a report says of the order that its UAV follows."""
        order = uav.open_order
        report = filled.report
        if order is None or report.time <= order.time:
            return
        is_over = report.time > order.time + 2 * order.duration + GRACE
        if report.flies:
            order.status = TAKEN_OFF
        elif filled.point == order.goal or is_over:
            order.status = LANDED if filled.point == order.goal else ABORTED
            order.since = max(order.since, filled.step - 1)

    def _tell(self, decisions: Sequence[Decision]) -> None:
        if self.tracker.hidden is not None and self.clock >= self.computed_from:
            self.tracker.ask(
                [each.advice["ID"] for each in decisions]
            )  # they change as when it was asked
        for decision in decisions:
            uav = self.uavs[decision.advice["ID"]]
            uav.lapse()
            uav.answers = [*uav.answers[1 - KEPT_ANSWERS :], decision]
        self.n_answers += len(decisions)

    def _acknowledge(self, ID: str, answer: str, said: str, status: str) -> str:
        decision = self.uavs[ID].answer(answer)
        if decision is not None and decision.status != status:
            was = decision.is_followed
            decision.status = status
            if status in (LANDED, ABORTED):
                decision.since = self.tracker.step
            if not was and decision.is_followed and decision.action is not None:
                self.tracker.choose(ID, decision.action)
        return status

    def _change(self, join: Sequence[str], leave: Sequence[str]) -> None:
        self.joining = {uav: log for uav, log in self.joining.items() if uav not in leave}
        self.leases = {uav: lease for uav, lease in self.leases.items() if uav not in leave}
        now = () if self.tracker.has_begun else join
        if now or {*leave} & {*self.uavs}:
            self._regroup([*(uav for uav in self.uavs if uav not in leave), *now])
        self.joining |= {uav: self.tracker.new_log() for uav in join if uav not in now}

    def _regroup(self, uavs: list[str], first: Report | None = None) -> None:
        """Go on with other UAVs; ``first`` is the report with which the last one joins.

        The belief, the message history and the past actions begin anew; what is known of the other
        UAVs, and what they were told, stays.
        """
        old = self.tracker
        self._take_in(uavs)
        new = self.tracker
        new.logs |= {uav: log for uav, log in old.logs.items() if uav in new.logs}
        if not old.has_begun:
            if all(log.newest for log in new.logs.values()):
                new.begin(self.clock)
            return
        new.has_begun = True
        new.start = old.start
        new.step = old.step
        new.pending = [each for each in old.pending if each[1] in new.logs]
        new.held = {uav: held for uav, held in old.held.items() if uav in new.logs}
        if first is not None:
            del self.joining[first.id]
            new.held[first.id] = new.put(first)
            self.uavs[first.id].home = new.held[first.id].point
        new.begin_anew(old.step)

    def _standing(self, uav: str, asks: bool) -> int:
        """Landing point on which a UAV stands, or for which it is bound."""
        order = self.uavs[uav].order
        held = self.tracker.held[uav]
        if order is None or order.status == ABORTED:
            return held.target
        if held.step <= max(order.step, order.since):
            return order.goal
        return held.target if asks or order.status == LANDED else order.goal

    # Safety.

    def _newest(self, uav: Uav) -> FilledReport:
        return self.tracker.logs[uav.id].reports[-1]

    def danger(self, uav: Uav) -> str | None:
        """Why a UAV must not do what the policy chooses, one of ``REASONS``, or None; the fleet has
        begun."""
        order = uav.open_order
        newest = self._newest(uav)
        if order is None and self.clock - newest.report.time > self.config.oldest_report:
            return "silent"  # in flight it may be: its goal is safer than a landing where it is
        if self.config.reserve > 0 and not (
            newest.battery_known and newest.battery >= self.config.reserve
        ):
            return "battery"
        if self._is_nowhere(uav):
            return "aborted"
        if (
            newest.report.flies
            and order is None
            and newest.step > (uav.order.since if uav.order else -1)
        ):
            return "airborne"
        return {"hold": "held", "return": "returning", "": None}[uav.command]

    def _is_nowhere(self, uav: Uav) -> bool:
        """Whether a UAV has aborted a flight, and has not reported since where it is."""
        order = uav.order
        return (
            order is not None and order.status == ABORTED and self._newest(uav).step <= order.since
        )

    def _is_busy(self, uav: Uav) -> bool:
        """Whether a UAV has nothing to choose now."""
        offer = uav.offer
        number = self.tracker.uavs.index(uav.id)
        if self.tracker.chosen[0, number] or uav.open_order:
            return True
        if offer is None or (
            offer.action is None and offer.reason not in ("conflict", "battery", "detour")
        ):
            return False
        return offer.is_live(self.clock) or offer.step == self.tracker.step

    def _is_told(self, uav: Uav, reason: str) -> bool:
        """Whether a UAV in danger has been told so, and the answer still holds."""
        offer = uav.offer
        order = uav.open_order
        may_fly = uav.command != "hold"
        if offer is not None and offer.status != LAPSED and self.clock <= offer.until:
            if offer.reason == reason:
                return offer.status not in (REFUSED, ABORTED) and (may_fly or not offer.moves)
            if offer.reason in ("conflict", "detour") and offer.step == self.tracker.step:
                return True
        is_bound_home = order is not None and (
            order.kind == "return" or order.goal == self._home(uav)
        )
        return is_bound_home and may_fly and reason in ("battery", "returning")

    def _is_outdated(self, uav: Uav, decision: Decision) -> bool:
        """Whether a flight is not safe any more that a UAV accepts now."""
        if not decision.moves or decision is not uav.offer:
            return False
        newest = self._newest(uav).report
        now = decision
        if newest.time > decision.time and not newest.flies:
            now = replace(decision, start=self.ground.local(newest.place() or (0.0, 0.0)))
        return (
            self.danger(uav) not in (None, decision.reason)
            or self._meets(uav, now, {})
            or self._bends(now)
        )

    def _start(self, uav: Uav, point: int) -> tuple[float, float]:
        """Position of a UAV [m]: by its newest report, if it stands at this landing point; or the
        point."""
        newest = self._newest(uav)
        if newest.point != point or newest.report.flies:
            return tuple(self.ground.points[point].tolist())
        return self.ground.local(newest.report.place() or (0.0, 0.0))

    def _flight(self, uav: Uav, start: tuple[float, float], goal: int) -> tuple[float, float]:
        """Expected duration of a flight [s], and the battery that it takes [%]."""
        vehicles = self.node.simulation.vehicles
        battery = self.node.scenario.battery
        length = torch.linalg.vector_norm(self.tracker.points[goal] - torch.tensor(start))
        vertical = vehicles.shortest_time(torch.tensor(uav.level))
        duration = float(2 * vertical + vehicles.shortest_time(length))
        return duration, float(flight_drain(vertical, length, battery)) if battery.enabled else 0.0

    def _home(self, uav: Uav) -> int:
        """The free landing point nearest to where a UAV began."""
        taken = {point for other in self._others(uav) for point in self.booked(other)}
        free = [point for point in range(len(self.ground.points)) if point not in taken]
        return min(free, key=lambda point: self.ground.way(uav.home or 0, point)[0])

    def _instead(self, uav: Uav, reason: str) -> Decision:
        """What a UAV in danger is told: to return if it is sent home or can still get there, else
        to hold."""
        here = goal = self._standing(uav.id, True)
        if reason == "returning":
            goal = self._leads_to(uav, self._home(uav))
        elif reason == "battery" and self.node.scenario.battery.enabled:
            home = self._home(uav)
            reaches = (
                self._flight(uav, self._start(uav, here), home)[1] <= self._newest(uav).battery
            )
            stands = not uav.open_order  # in flight nobody knows how far it is
            goal = home if reaches and stands and uav.command != "hold" else here
        return self._decision(uav, None, goal, reason)

    def _decision(self, uav: Uav, action: Any, goal: int, reason: str | None = None) -> Decision:
        """A decision for a UAV, made from where it stands or will land."""
        origin = self._standing(uav.id, True)
        step = self.tracker.step
        start = self._start(uav, origin)
        until = self.clock + self.config.answer_time
        duration = self._flight(uav, start, goal)[0] if goal != origin else 0.0
        return Decision(
            step, self.clock, action, origin, goal, start, duration, until, reason, step
        )

    def _others(self, uav: Uav) -> list[Uav]:
        return [other for other in self.uavs.values() if other is not uav]

    def _flights(self, uav: Uav, found: dict[str, Decision]) -> list[Decision]:
        """Flights on which a UAV may be, or for which it may set out; ``found`` have not been told
        yet."""
        told = filter(None, (uav.open_order, uav.offer, found.get(uav.id)))
        return [each for each in told if each.is_open or (each.moves and each.is_live(self.clock))]

    def booked(self, uav: Uav, found: dict[str, Decision] | None = None) -> set[int]:
        """Landing points where a UAV may stand or land."""
        order = uav.order
        booked = {each.goal for each in self._flights(uav, found or {})}
        if order is not None and (order.status == ACCEPTED or self._is_nowhere(uav)):
            booked |= {order.origin, order.goal}
        return booked | {self._standing(uav.id, False)}

    def _meets(self, uav: Uav, decision: Decision, found: dict[str, Decision]) -> bool:
        """Whether a flight leads to where another UAV may be, or comes near its way at the same
        level.

        A UAV may have to land anywhere on its way: so nobody is sent under the way of another one,
        nor over where another one may stand or land, whatever their levels are.
        """
        way = self._path(decision)
        points = self.ground.points
        for other in self._others(uav):
            places = self.booked(other, found)
            near = [way.distance(shapely.Point(self._start(other, place))) for place in places]
            mine = way if other.level == uav.level else shapely.Point(points[decision.goal])
            near += [self._path(each).distance(mine) for each in self._flights(other, found)]
            if decision.goal in places or min(near) < self.config.clearance:
                return True
        return False

    def _path(self, decision: Decision) -> shapely.LineString:
        return shapely.LineString([decision.start, self.ground.points[decision.goal]])

    def _is_clear(self, ways: Any) -> Any:
        """Whether straight ways stay in the region, and away from its edge, that of its zones
        included.

        The margin is less where a way begins or ends nearer to the edge.
        """
        polygon = self.ground.region.polygon
        shapely.prepare(polygon)
        edge = polygon.boundary
        ends = [shapely.distance(shapely.get_point(ways, end), edge) for end in (0, -1)]
        least = np.minimum(self.config.margin, np.minimum(*ends)) - 1e-6
        return shapely.covers(polygon, ways) & (shapely.distance(ways, edge) >= least)

    def _bends(self, decision: Decision) -> bool:
        """Whether the straight way from where a UAV stands is not clear; from outside it may come
        in."""
        polygon = self.ground.region.polygon
        way = self._path(decision)
        if not polygon.covers(shapely.Point(decision.start)):
            within = way.intersection(polygon)
            if within.geom_type != "LineString" or within.length < way.length - self.config.margin:
                return True
            way = within
        return not self._is_clear(way)

    @cached_property
    def _hops(self) -> csr_array:
        """Distances between landing points, not too far apart, whose straight ways are clear
        [m]."""
        points = self.ground.points
        one, other = (
            KDTree(points)
            .query_pairs(6 * self.node.scenario.region.lattice_step, output_type="ndarray")
            .T
        )
        clear = self._is_clear(shapely.linestrings(np.stack([points[one], points[other]], 1)))
        one = one[clear]
        other = other[clear]
        far = np.linalg.norm(points[one] - points[other], axis=1)
        return csr_array((far, (one, other)), shape=(len(points),) * 2)

    def _leads_to(self, uav: Uav, goal: int) -> int:
        """The landing point to which a UAV flies next on the way to a goal, around what is in
        between."""
        here = self._standing(uav.id, True)
        if here == goal or not self._bends(self._decision(uav, None, goal)):
            return goal
        left = dijkstra(self._hops, directed=False, indices=goal)  # from each point on
        taken = {point for other in self._others(uav) for point in self.booked(other)}
        total = left + np.linalg.norm(self.ground.points - self._start(uav, here), axis=-1)
        for point in total.argsort(kind="stable").tolist():
            is_nearer = left[point] < left[here] and point not in taken
            if is_nearer and not self._bends(self._decision(uav, None, point)):
                return point
        return goal

    def _cleared(self, found: Sequence[tuple[Uav, Decision]]) -> list[dict[str, Any]]:
        """Decisions to store, where UAVs hold that would meet others, or whose batteries end too
        low."""
        cleared: dict[str, Decision] = {}
        for number, (uav, decision) in enumerate(found, self.n_answers + 1):
            reason = None
            here = decision.origin
            if decision.moves and self._meets(uav, decision, cleared):
                reason = "conflict"
            elif decision.moves and self._bends(decision):
                reason = "detour"
            elif decision.kind == "fly" and self.node.scenario.battery.enabled:
                left = (
                    self._newest(uav).battery - self._flight(uav, decision.start, decision.goal)[1]
                )
                reason = "battery" if left < self.config.reserve else None
            told = self._decision(uav, None, here, reason) if reason else decision
            told.advice = self._told(uav, told, f"{self.mark}-{number}".lstrip("-"))
            cleared[uav.id] = told
        return [asdict(each) for each in cleared.values()]

    # Answers.

    def advice(self, asking: Asking) -> list[Advice]:
        """What UAVs are told for now."""
        return [self._shown(uav, self.clock) for uav in self.members(asking.uavs, "uavs")]

    def _shown(self, uav: Uav, now: float) -> Advice:
        offer = uav.offer
        decision = uav.open_order
        told = dict[str, Any]()
        if offer is not None and offer.is_live(now):
            decision = offer
            told = {"state": offer.kind}
        elif offer is not None and (offer.status, offer.moves) == (LANDED, False):
            still = now <= offer.until if offer.action is None else offer.step == self.tracker.step
            decision, told = (offer, {"state": "hold"}) if still else (decision, told)
        if decision is None:
            told = {"answer": None, "ID": uav.id, "state": "none", "reason": None}
        else:
            told = decision.advice | (told or {"state": "bound"})
        return Advice(**told, age=self._age(uav, now))

    def _told(self, uav: Uav, decision: Decision, answer: str) -> dict[str, Any]:
        """What a decision tells a UAV, as of ``Advice``."""
        told: dict[str, Any] = {"answer": answer, "ID": uav.id}
        told |= {"state": decision.kind, "reason": decision.reason}
        shows_place = decision.reason is None or decision.moves
        place = self.ground.place(decision.goal) if shows_place else (None, None)
        told |= zip(self.ground.columns, place, strict=True)
        told |= dict.fromkeys(("altitude", "speed", "heading", "distance", "duration", "arrival"))
        if decision.moves:
            told["altitude"] = uav.level
        if not uav.open_order:  # else nobody knows where it is
            way = self._path(decision)
            distance = way.length * decision.moves
            arrival = written(decision.time + decision.duration)
            told |= {
                "distance": round(distance, 2),
                "duration": round(decision.duration, 2),
                "arrival": arrival,
            }
            if decision.moves:
                (x, y), (x_goal, y_goal) = way.coords
                cruise = self.node.simulation.vehicles.shortest_time(torch.tensor(distance))
                heading = math.degrees(math.atan2(x_goal - x, y_goal - y)) % 360
                told |= {"speed": round(distance / float(cruise), 2), "heading": round(heading, 2)}
        return told | {"until": written(decision.until), "step": decision.step}

    def status(self, now: float) -> FleetStatus:
        """What is known of the fleet at an instant [s]."""
        tracker = self.tracker
        now = max(now, self.clock)
        uavs = [self._status(uav, now) for uav in self.uavs.values()]
        start = written(tracker.start) if tracker.has_begun else None
        return FleetStatus(start=start, step=tracker.step, dt=self.node.dt, uavs=uavs)

    def _status(self, uav: Uav, now: float) -> UavStatus:
        newest = self.tracker.logs[uav.id].newest
        told = {"ID": uav.id, "age": self._age(uav, now)}
        if newest is not None:
            told |= zip(self.ground.columns, newest.report.place() or (), strict=True)
            battery = newest.battery if newest.battery_known else None
            told |= {"flies": newest.report.flies, "battery": battery}
        told |= {"reports": uav.received, "duplicates": uav.duplicates, "command": uav.command}
        return UavStatus(**told, order=uav.offer and uav.offer.status, advice=self._shown(uav, now))

    def _age(self, uav: Uav, now: float) -> float | None:
        newest = self.tracker.logs[uav.id].newest
        return None if newest is None else round(max(now - newest.report.time, 0.0), 3)
