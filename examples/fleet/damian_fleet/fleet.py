"""A fleet of real UAVs: reports come in, advice goes out.

Step k lasts from ``start + k dt`` on; the oldest first report was generated at the start. A message belongs
to the step in which it was generated, and counts from the step in which it came in.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, cast

import shapely
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.common.checks import SECONDS
from damian.common.errors import InputError
from damian.common.text_files import listed, show
from damian.field.known import FilledReport, messages_of
from damian.field.node import REMEMBERED_STEPS, LateMessage, Memories, Node, Reported
from damian.field.rows import Report, written
from damian.learners.recurrent import AgentGRU
from damian.world.battery import flight_drain
from damian.world.messages import Messages
from damian.world.state import State
from damian.world.vehicles import check_levels
from damian_fleet.answers import Acknowledgement, Advice, FleetStatus, UavStatus
from damian_fleet.idle import diffuses, held_back, settles, skip
from damian_fleet.known import UavLog
from damian_fleet.orders import (
    ABORTED,
    ACCEPTED,
    LANDED,
    LAPSED,
    OFFERED,
    TAKEN_OFF,
    TOLD,
    Decision,
)
from damian_fleet.rules import FieldRules

FUTURE = 1.0
"""How far the clock of a UAV may be ahead of that of the server [s]."""
LIFE = SECONDS
"""How long a fleet lasts [s]."""
SILENT_STEPS = 1000
"""Steps without any report after which beliefs stand still."""
MOST_UAVS = 100
"""Most UAVs of a fleet."""
NEVER_DECIDED = 2**31
"""Steps since the latest decision of a UAV that is ready to choose."""
_NOT_STORED = {"node", "policy", "rules", "parts", "ground", "points", "after", "outputs", "sent"}
"""What of a fleet is given to it, or computed again."""
_ROUNDING = 1e-3
"""Share of a step by which times may be rounded."""


class Choice(NamedTuple):
    """What UAVs have chosen, and have not been told yet."""

    decisions: dict[int, Decision]
    """By the numbers of the UAVs."""
    hidden: Tensor | None
    """Hidden states after the choice, [1, N, H]; None if the policy was not asked or has none."""


class Waiting(Exception):
    """The fleet has not begun, because UAVs have not reported yet; ``str(error)`` names them."""


class Fleet:
    """The server node of one fleet, and the policy that it asks.

    Fleets may share a node, which remembers nothing of them. UAVs book landing points in the order of their
    IDs. With ``drawn``, actions are drawn by ``seed``; if not, the most likely ones are taken. UAVs can join
    and leave if ``parts`` gives the node and the policy for a number of UAVs. ``mark`` begins the IDs of
    answers.
    """

    def __init__(
        self,
        node: Node,
        uavs: Sequence[str],
        policy: Callable[[TensorDictBase], TensorDictBase],
        drawn: bool = False,
        seed: int = 0,
        rules: FieldRules | None = None,
        parts: Callable[[int], tuple[Node, Callable[[TensorDictBase], TensorDictBase]]] | None = None,
        mark: str = "",
    ) -> None:
        self.node, self.uavs, self.policy, self.drawn, self.seed = node, list(uavs), policy, drawn, seed
        self.rules, self.parts, self.mark = rules or FieldRules(), parts, mark
        self.number = {uav: i for i, uav in enumerate(self.uavs)}
        self.ground, self.points = node.ground, node.simulation.airspace.points[0]
        check_levels(self.rules.levels[: len(uavs)], node.simulation.airspace)
        self.logs = [self._new_log() for _ in self.uavs]
        self.joining: dict[str, UavLog] = {}
        """UAVs that join with their first report."""
        self.levels: list[float] = []
        """Flight level of each UAV [m]."""
        for _ in self.uavs:
            self.levels.append(self._free_level(self.levels))
        self.homes: list[int] = []
        """Landing point of the first report of each UAV, to which it returns; empty until all have one."""
        self.commands = [""] * len(self.uavs)
        """The command of a person to each UAV: ``hold``, ``return``, or none."""
        self.n_answers = 0
        """Answers with an ID so far."""
        self.start: float | None = None
        """When step 0 began [s]; None until every UAV has reported."""
        self.step, self.clock = 0, 0.0
        self.held: list[FilledReport] = []
        """The message of each UAV that the server holds."""
        self.offered: list[list[Decision]] = [[] for _ in self.uavs]
        """The latest answers to each UAV, oldest first."""
        self.told: list[list[Decision]] = [[] for _ in self.uavs]
        """Those that it has followed, oldest first."""
        self.pending: list[tuple[int, int, FilledReport]] = []
        """Reports that count later: the step from which they do, the number of the UAV, the report."""
        self.arrived: list[tuple[int, FilledReport]] = []
        """Reports that count from this step on, with the numbers of the UAVs."""
        self.before: Memories | None = None
        """What the node remembers after the step before; ``after`` this step; None in the first one."""
        self.after: Memories = []
        self.outputs: TensorDictBase | None = None
        """Outputs of this step, and the messages ``sent`` that are held in it; None until they are needed."""
        self.sent: Messages | None = None
        self.first_step = self.begun = self.last_arrival = 0
        """The first step; that in which the present members began; that of the latest report or decision."""
        self._forget_history()

    def _new_log(self) -> UavLog:
        n_readings = self.node.simulation.widths.readings
        kept = 2 * max(self.node.law_longest, REMEMBERED_STEPS)
        return UavLog(self.ground, self.node.server.observation.stops, n_readings, kept, self.node.dt)

    def _free_level(self, used: Sequence[float]) -> float:
        """The lowest of the flight levels [m] that the fewest UAVs use."""
        return min(self.rules.levels, key=lambda level: (used.count(level), level))

    def _forget_history(self) -> None:
        """Begin the hidden states and the choices anew."""
        modules = self.policy.modules() if isinstance(self.policy, torch.nn.Module) else ()
        sizes = [each.cell.hidden_size for each in modules if isinstance(each, AgentGRU)]
        self.hidden = self.hidden_after = torch.zeros(1, len(self.uavs), sizes[0]) if sizes else None
        """Hidden states of a recurrent policy before and after this step, [1, N, H]."""
        self._forget_choices()
        self.previous = self.action, self.chosen

    # Reports.

    def step_of(self, time: float) -> int:
        """The step in which an instant lies."""
        return math.floor((time - (self.start or 0.0)) / self.node.dt + _ROUNDING)

    def check(self, report: Report, now: float | None = None) -> None:
        """Check a report before it is added, at the time ``now`` [s], or None for one that is recorded.

        A report from a flight says then where the UAV was sent, if it does not say that itself.
        """
        log = self.joining.get(report.id) or self.logs[self.number_of(report.id)]
        came = report.received if now is None else now
        for name, time in (("time", report.time), ("source time", report.source_time)):
            if time is not None and time > came + FUTURE:
                late = f"{time:.13g} s is {time - came:.1f} s after it came in"
                raise InputError(f"{name}: {late}: set the clock of the UAV")
        self._check_life(report.received)
        log.check(report)
        if report.flies and report.place("target_") is None and (sent := self._sent(report)):
            for column, value in zip(self.ground.columns, self.ground.place(sent.goal), strict=True):
                setattr(report, f"target_{column}", value)

    def _sent(self, report: Report) -> Decision | None:
        """What the UAV of a report had followed last when the report was generated."""
        told = self.told[self.number[report.id]] if report.id in self.number else []
        return next((each for each in reversed(told) if each.time < report.time), None)

    def number_of(self, uav: str, key: str = "ID") -> int:
        """Number of a UAV of the fleet."""
        if uav not in self.number:
            raise InputError(f"{key}: {show(uav)} is not a UAV of this fleet: {listed(self.uavs)}")
        return self.number[uav]

    def _check_life(self, now: float) -> None:
        """Check that the steps of the fleet can still be counted."""
        if self.start is not None and now - self.start > LIFE:
            raise InputError(f"time: the fleet began more than {LIFE:g} s ago: end it, and begin a new one")

    def report(self, report: Report) -> str:
        """Add a checked report; it is ``new``, ``late``, ``duplicate``, or ``old`` (before the start)."""
        self.advance(report.received)  # what comes in late fills in no earlier step
        if report.id in self.joining:
            self._change([*self.uavs, report.id], report)
            return "new"
        uav = self.number[report.id]
        log = self.logs[uav]
        log.received += 1
        if log.has(report.time):
            log.duplicates += 1
            return "duplicate"
        found = "late" if log.newest and report.time < log.newest.report.time else "new"
        log.late += found == "late"
        if self.start is None:
            log.add(report, 0, None)
            if not self._missing():
                self._begin()
            return found
        if report.time < max(self.start, log.known_from):
            return "old"
        now = self.step_of(self.clock)
        step = min(self.step_of(report.time), now)
        sent = self._sent(report)
        filled = log.add(report, step, self._detected(report), sent and sent.origin)
        self._note_flight(uav, filled)
        due = max(now, self.step)
        if self.node.scenario.delay.hold == "max":
            due = max(due, step + self.node.law_longest)
        self.pending.append((due, uav, filled))
        self.outputs = self.sent = None
        self._collect()
        return found

    def _note_flight(self, uav: int, filled: FilledReport) -> None:
        """Note what a report says of the order that its UAV follows."""
        order = self.decision(uav)
        if order is None or not order.is_open(self.clock) or filled.report.time <= order.time:
            return
        if filled.report.flies:
            order.status = TAKEN_OFF
        elif filled.point == order.goal:
            order.status, order.since = LANDED, max(order.since, filled.step - 1)

    def _detected(self, report: Report) -> int | None:
        """The step of the detection that a report names."""
        return None if report.source_time is None else max(self.step_of(report.source_time), 0)

    def _missing(self) -> list[str]:
        """The UAVs for which the fleet waits."""
        return [uav for uav, log in zip(self.uavs, self.logs, strict=True) if log.newest is None]

    def _begin(self) -> None:
        """Begin with the newest report of each UAV."""
        newest = [log.reports[-1].report for log in self.logs]
        self.start = min(report.time for report in newest)
        self.step = self.first_step = self.begun = self.last_arrival = max(self.step_of(self.clock), 0)
        for log, report in zip(self.logs, newest, strict=True):
            log.reports.clear()
            log.add(report, min(self.step_of(report.time), self.step), self._detected(report))
        self.held = [log.reports[-1] for log in self.logs]
        self.homes = [held.point for held in self.held]

    def _collect(self) -> None:
        """Let the reports that count by now arrive."""
        due = [each for each in self.pending if each[0] <= self.step]
        if not due:
            return
        self.pending = [each for each in self.pending if each[0] > self.step]
        self.outputs, self.sent, self.last_arrival = None, None, self.step
        by_arrival = self.node.scenario.delay.order == "arrival"
        for _, uav, filled in sorted(due, key=lambda each: each[2].report.time):
            held = self.held[uav]
            # Of those that arrive in the same step, the one that was generated last counts as the last.
            earlier = by_arrival and not any(each is held for _, each in self.arrived)
            self.arrived.append((uav, filled))
            if earlier or filled.report.time > held.report.time:
                self.held[uav] = filled

    # Steps.

    @property
    def changes_by_itself(self) -> bool:
        """Whether steps must be taken one by one, even if nothing is reported."""
        return diffuses(self.node) or self.hidden is not None

    def advance(self, now: float) -> None:
        """Take all steps up to an instant [s]."""
        self.clock = now = max(self.clock, now)
        if self.start is None:
            return
        last = self.step_of(now)
        settled = SILENT_STEPS if self.changes_by_itself else settles(self.node)
        skipped = last - held_back(self.node)
        while self.step < last:
            quiet = self.step >= self.last_arrival + settled
            quiet = quiet and self.step < skipped and self.before is not None
            if quiet and not self.chosen.any() and not self.previous[1].any():
                following = min([skipped, *(due for due, _, _ in self.pending)])
                self.before = skip(self.node, cast(Memories, self.before), following - self.step)
            else:
                if self.hidden is not None and self.hidden_after is self.hidden:
                    _, self.hidden_after = self.ask_policy([])  # hidden states change in every step
                self._observe()
                following, self.before = self.step + 1, self.after
            self.previous = self.action, self.chosen
            self.hidden, self.step, self.outputs, self.arrived = self.hidden_after, following, None, []
            self._forget_choices()
            self._collect()

    def _observe(self) -> TensorDictBase:
        """The outputs of the step, from what has arrived by now."""
        if self.outputs is None:
            reported = self._reported()
            if self.before is None:
                self.after, self.outputs = self.node.begin(reported)
            else:
                self.after, self.outputs = self.node.step(self.before, reported, *self.previous)
        return self.outputs

    def _reported(self) -> Reported:
        arrived = {(uav, filled.step): filled for uav, filled in self.arrived}
        late = {key: filled for key, filled in arrived.items() if self.begun < key[1] < self.step}
        self.sent = self._messages(self.held)
        rows = self._messages([*late.values()]).pack() if late else ()
        on_time = [
            held.step == self.step and (uav, self.step) in arrived for uav, held in enumerate(self.held)
        ]
        return Reported(
            state=self._state([]),
            age=self.step - torch.tensor([filled.step for filled in self.held]),
            on_time=torch.tensor(on_time),
            late=[LateMessage(row, key[0], self.step - key[1]) for row, key in zip(rows, late, strict=True)],
        )

    def _messages(self, reports: Sequence[FilledReport]) -> Messages:
        return messages_of(reports, self.node.server, self.points, self.node.dt)

    def _state(self, asking: Sequence[int]) -> State:
        """The state of the world, as far as it is known; the UAVs that ask are ready to choose."""
        if self.sent is None:
            self.sent = self._messages(self.held)
        sent, ready = self.sent, self._mask(asking)
        goal = torch.tensor([[self._standing(uav, uav in asking) for uav in range(len(self.uavs))]])
        return self.node.blank._replace(
            steps=torch.tensor([self.step]),
            goal=goal,
            origin=goal,
            elapsed=torch.where(ready, NEVER_DECIDED, -1),
            battery=sent.battery.unsqueeze(0),
            track=sent.track.unsqueeze(0),
            sent=type(sent)._make(field.unsqueeze(0) for field in sent),
        )

    def _standing(self, uav: int, asks: bool) -> int:
        """Landing point on which a UAV stands, or which is booked for it."""
        decision, held = self.decision(uav), self.held[uav]
        if decision is None or decision.status == ABORTED:
            return held.target
        if held.step <= max(decision.step, decision.since):
            return decision.goal
        expired = self.clock > decision.expires
        return held.target if asks or expired or decision.status == LANDED else decision.goal

    # Advice.

    def choose(self, now: float, asking: Sequence[str] | None = None) -> Choice | None:
        """What UAVs choose that have not yet in this step; nothing changes until they are told (``tell``).

        A UAV that is in danger is told to hold or to return instead; one that has an answer which still
        holds, or follows one, does not choose.
        """
        numbers = self.numbers_of(asking)
        self.advance(now)
        if self.start is None:
            raise Waiting(f"no advice yet: no report of {listed(self._missing())} has come in")
        self._check_life(self.clock)
        asked = range(len(self.uavs)) if numbers is None else numbers
        dangers = {uav: danger for uav in asked if (danger := self.danger(uav))}
        instead = {
            uav: (self._kind(uav, danger), danger)
            for uav, danger in dangers.items()
            if not self._is_told(uav, danger)
        }
        choosing = [uav for uav in asked if uav not in dangers and not self._is_busy(uav, numbers is None)]
        if choosing:  # else what has come in since then need not be looked at yet
            ready = self._observe()[keys.READY][0]
            choosing = [uav for uav in choosing if ready[uav]]
        if not choosing and not instead:
            return None
        asks = choosing or self.hidden is not None
        action, hidden = self.ask_policy(choosing) if asks else (None, None)
        return self._cleared(self.choice(choosing, action, hidden, instead))

    def _is_busy(self, uav: int, unasked: bool) -> bool:
        """Whether a UAV has nothing to choose now; ``unasked``: if it flies, neither."""
        if bool(self.chosen[0, uav]) or (unasked and self.held[uav].report.flies):
            return True
        offer, order = self.offer(uav), self.decision(uav)
        if self.rules.acknowledge and order is not None and order.is_open(self.clock):
            return True
        if offer is None or (offer.action is None and offer.reason not in ("conflict", "battery")):
            return False
        return offer.is_live(self.clock) or offer.step == self.step

    def _is_told(self, uav: int, reason: str) -> bool:
        """Whether a UAV in danger has been told so, and the answer still holds."""
        offer, order = self.offer(uav), self.decision(uav)
        may_fly = self.commands[uav] != "hold"  # what a person wants ends a flight home, too
        if offer is not None and offer.status != LAPSED and self.clock <= offer.until:
            if offer.reason == reason or (offer.reason, reason) == ("home", "returning"):
                return offer.status in (OFFERED, ACCEPTED, TAKEN_OFF, LANDED) and (may_fly or not offer.moves)
            if offer.reason == "conflict" and offer.step == self.step:
                return True
        returns = may_fly and order is not None and order.kind == "return" and order.reason == reason
        return returns and cast(Decision, order).is_open(self.clock)

    # Safety.

    def danger(self, uav: int) -> str | None:
        """Why a UAV must not do what the policy chooses, one of ``REASONS``, or None; the fleet has begun."""
        order, newest = self.decision(uav), cast(FilledReport, self.logs[uav].newest)
        heard = newest.report.time
        flies = order is not None and order.moves and order.status not in (LANDED, ABORTED)
        if order is not None and flies:  # in flight it is silent
            heard = max(heard, min(order.time + order.duration, self.clock))
        if self.clock - heard > self.rules.oldest_report:
            return "silent"
        if self.rules.reserve > 0 and not (newest.battery_known and newest.battery >= self.rules.reserve):
            return "battery"
        if self._is_nowhere(uav):
            return "aborted"
        late = order is not None and flies and self.rules.acknowledge and self.clock > order.expires
        if late and newest.report.time <= cast(Decision, order).time:
            return "lost"
        return {"hold": "held", "return": "returning", "": None}[self.commands[uav]]

    def _is_nowhere(self, uav: int) -> bool:
        """Whether a UAV has aborted a flight, and has not reported since where it is."""
        order, newest = self.decision(uav), cast(FilledReport, self.logs[uav].newest)
        return order is not None and order.status == ABORTED and newest.step <= order.since

    def _flight(self, uav: int, origin: int, goal: int) -> tuple[float, float]:
        """Expected duration of a flight [s], and the battery that it takes [%]."""
        if origin == goal:
            return 0.0, 0.0
        vehicles, battery = self.node.simulation.vehicles, self.node.scenario.battery
        length = torch.linalg.vector_norm(self.points[goal] - self.points[origin])
        vertical = vehicles.shortest_time(torch.tensor(self.levels[uav]))
        duration = float(2 * vertical + vehicles.shortest_time(length))
        return duration, float(flight_drain(vertical, length, battery)) if battery.enabled else 0.0

    def _home(self, uav: int) -> int:
        """The free landing point nearest to where a UAV began."""
        taken = {each for other in self._others(uav) for each in self._booked(other)}
        free = [point for point in range(len(self.ground.points)) if point not in taken]
        return min(free, key=lambda point: self.ground.way(self.homes[uav], point)[0])

    def _kind(self, uav: int, reason: str) -> str:
        """What a UAV in danger is told: to return if it is sent home or can still get there, else to hold."""
        if reason == "returning":
            return "return"
        order, modelled = self.decision(uav), self.node.scenario.battery.enabled
        in_flight = order is not None and order.is_open(self.clock)  # nobody knows how far it is
        if reason != "battery" or self.commands[uav] == "hold" or in_flight or not modelled:
            return "hold"
        needed = self._flight(uav, self._standing(uav, True), self._home(uav))[1]
        return "return" if needed <= cast(FilledReport, self.logs[uav].newest).battery else "hold"

    def _instead(self, uav: int, kind: str, reason: str) -> Decision:
        """A decision that the policy has not taken."""
        here = self._standing(uav, True)
        goal = self._home(uav) if kind == "return" else here
        return self._decision(
            uav, None, here, goal, "home" if goal == here and reason == "returning" else reason
        )

    def _decision(self, uav: int, action: Any, origin: int, goal: int, reason: str | None) -> Decision:
        duration, until = self._flight(uav, origin, goal)[0], self.clock + self.rules.answer_time
        return Decision(self.step, self.clock, action, origin, goal, duration, until=until, reason=reason)

    def _others(self, uav: int) -> Iterator[int]:
        return (other for other in range(len(self.uavs)) if other != uav)

    def _booked(self, uav: int) -> set[int]:
        """Landing points where a UAV may stand or land."""
        offer, order = self.offer(uav), self.decision(uav)
        booked = {self._standing(uav, False)}
        if offer is not None and offer.is_live(self.clock):
            booked.add(offer.goal)
        if order is None or not self.rules.acknowledge:
            return booked
        leaves = order.status == ACCEPTED and order.is_open(self.clock)
        return booked | {order.origin, order.goal} if leaves or self._is_nowhere(uav) else booked

    def _path(self, decision: Decision) -> shapely.LineString:
        return shapely.LineString(self.ground.points[[decision.origin, decision.goal]])

    def _cleared(self, choice: Choice) -> Choice:
        """The same, where UAVs hold that would meet others, or whose batteries do not bring them so far."""
        flights = {
            uav: each
            for uav in range(len(self.uavs))
            for each in (self.offer(uav), self.decision(uav))
            if each and each.moves and (each.is_live(self.clock) or each.is_open(self.clock))
        }
        booked = [self._booked(uav) for uav in range(len(self.uavs))]
        for uav, decision in choice.decisions.items():
            if not decision.moves:
                continue
            reason, others, level = None, [*self._others(uav)], self.levels[uav]
            near = [
                shapely.distance(self._path(flights[other]), self._path(decision)) < self.rules.clearance
                for other in others
                if other in flights and self.levels[other] == level
            ]
            if any(near) or any(decision.goal in booked[other] for other in others):
                reason = "conflict"
            elif decision.action is not None and self.node.scenario.battery.enabled:
                left = cast(FilledReport, self.logs[uav].newest).battery
                left -= self._flight(uav, decision.origin, decision.goal)[1]
                reason = "battery" if left < self.rules.reserve else None
            if reason:
                decision.action, decision.goal, decision.duration = None, decision.origin, 0.0
                decision.reason = reason
            else:
                flights[uav] = decision
                booked[uav].add(decision.goal)
        return choice

    # What UAVs are told, and what they say of it.

    def numbers_of(self, asking: Sequence[str] | None) -> list[int] | None:
        """Numbers of the UAVs that ask."""
        return None if asking is None else sorted({self.number_of(uav, "uav") for uav in asking})

    def observe(self, asking: Sequence[int]) -> TensorDictBase:
        """What the policy reads, if these UAVs are ready to choose."""
        tensordict = self._observe().clone(False)
        if keys.ACTION_MASK in tensordict.keys(True):
            tensordict[keys.ACTION_MASK] = self.node.simulation.action_mask(self._state(asking))
        if self.hidden is not None:
            tensordict[keys.HIDDEN] = self.hidden.clone()
        return tensordict

    @torch.no_grad()
    def ask_policy(self, choosing: Sequence[int]) -> tuple[Tensor, Tensor | None]:
        """Actions of all UAVs, [1, N, ...], where only those that choose count; hidden states, [1, N, H]."""
        read = self.observe(choosing)
        kind = ExplorationType.RANDOM if self.drawn else ExplorationType.DETERMINISTIC
        with torch.random.fork_rng(devices=[]), set_exploration_type(kind):
            torch.default_generator.manual_seed(hash((self.seed, self.step, *choosing)) % 2**62)
            chosen = self.policy(read)
        return chosen[keys.ACTION], None if self.hidden is None else chosen[keys.HIDDEN].detach()

    def choice(
        self,
        choosing: Sequence[int],
        action: Tensor | None,
        hidden: Tensor | None,
        instead: dict[int, tuple[str, str]],
    ) -> Choice:
        """To which landing points the actions of the UAVs of these numbers lead; hidden as of ``Choice``.

        ``action`` [1, N, ...] of all UAVs, where only those that choose count; ``instead``: what those are
        told that must not, ``hold`` or ``return``, and why.
        """
        decisions = {uav: self._instead(uav, *told) for uav, told in instead.items()}
        if choosing and action is not None:
            before = self._state(choosing)
            state = self.node.simulation.decide(before, action, self._mask(choosing))
            acted, here, there = (each[0].tolist() for each in (action, before.goal, state.goal))
            for uav in choosing:
                decisions[uav] = self._decision(uav, acted[uav], here[uav], there[uav], None)
        decisions = dict(sorted(decisions.items()))
        for number, decision in enumerate(decisions.values(), self.n_answers + 1):
            decision.answer, decision.since = f"{self.mark}-{number}".lstrip("-"), self.step
        return Choice(decisions, hidden)

    def tell(self, choice: Choice) -> None:
        """Note what UAVs have been told; without acknowledgements, they follow it from now on."""
        for uav, decision in choice.decisions.items():
            self._lapse(uav)
            self.offered[uav] = [*self.offered[uav][1 - TOLD :], decision]
            if not self.rules.acknowledge and decision.acknowledge(ACCEPTED, self.clock, self.step):
                self._follow(uav, decision)
        self.n_answers += len(choice.decisions)
        if choice.hidden is not None:
            self.hidden_after = choice.hidden

    def _lapse(self, uav: int) -> None:
        """End the answer of a UAV that it has not accepted."""
        if (offer := self.offer(uav)) is not None and offer.status == OFFERED:
            offer.status = LAPSED

    def _follow(self, uav: int, decision: Decision) -> None:
        """Take a UAV to follow a decision from now on."""
        if decision.action is None and not decision.moves:
            return
        self.told[uav] = sorted([*self.told[uav], decision], key=lambda each: each.time)[-TOLD:]
        if decision.action is not None:
            self.last_arrival = max(self.last_arrival, self.step)
            self.chosen = self.chosen | self._mask([uav])
            self.action = self.action.clone()
            self.action[0, uav] = torch.tensor(decision.action)

    def acknowledge(self, said: Acknowledgement, now: float, outdated: bool = False) -> str:
        """Note what a UAV of the fleet does with an answer; returns how far this has come, or ``unknown``.

        An answer that is ``outdated`` has lapsed before it was accepted.
        """
        uav = self.number_of(said.id)
        self.advance(now)
        if outdated:
            self._lapse(uav)
        decision = next((each for each in self.offered[uav] if each.answer == said.answer), None)
        if decision is None:
            return "unknown"
        if decision.acknowledge(said.status, self.clock, self.step):
            self._follow(uav, decision)
        return decision.status

    def outdated(self, said: Acknowledgement) -> bool:
        """Whether a UAV accepts a flight that is not safe any more."""
        uav = self.number_of(said.id)
        offer = self.offer(uav)
        if offer is None or offer.answer != said.answer or not offer.moves:
            return False
        return said.status == ACCEPTED and self.danger(uav) not in (None, offer.reason)

    def command(self, command: str, uavs: Sequence[str], now: float) -> None:
        """Let UAVs hold or return until they ``resume``; what they have not accepted yet does not hold."""
        self.advance(now)
        for uav in map(self.number_of, uavs):
            self.commands[uav] = "" if command == "resume" else command
            self._lapse(uav)

    # Members.

    def check_change(self, join: Sequence[str], leave: Sequence[str]) -> None:
        """Check that UAVs can join and leave."""
        if self.parts is None:
            raise InputError("uavs: the members of this fleet cannot change")
        for uav in leave:
            if uav not in self.joining:
                self.number_of(uav, "leave")
        stay = {*self.uavs, *self.joining} - {*leave}
        if known := stay & {*join}:
            raise InputError(f"join: {listed(sorted(known))} belongs to the fleet")
        if not stay & {*self.uavs} or len(stay | {*join}) > MOST_UAVS:
            raise InputError(f"uavs: a fleet has 1 to {MOST_UAVS} UAVs: end it instead")
        self.parts(len(stay | {*join}))  # refuses another number of UAVs if the policy does

    def change_members(self, join: Sequence[str], leave: Sequence[str], now: float) -> None:
        """Let UAVs leave now, and join with their first reports; checked before.

        The belief, the message history and the past actions begin anew with the new number of UAVs.
        """
        self.advance(now)
        self.joining = {uav: log for uav, log in self.joining.items() if uav not in leave}
        if {*leave} & {*self.uavs}:
            self._change([uav for uav in self.uavs if uav not in leave])
        if self.start is None:
            self._change([*self.uavs, *join])
        else:
            self.joining |= {uav: self._new_log() for uav in join}

    def _change(self, uavs: list[str], first: Report | None = None) -> None:
        """Go on with other UAVs; ``first`` is the report with which the last one joins."""
        stay = [(i, self.number.get(uav)) for i, uav in enumerate(uavs)]
        assert self.parts is not None
        self.node, self.policy = self.parts(len(uavs))

        def moved(old: Sequence[Any], new: Callable[[], Any]) -> list[Any]:
            return [new() if then is None else old[then] for _, then in stay]

        self.logs = moved(self.logs, self._new_log)
        self.offered = moved(self.offered, list)
        self.told = moved(self.told, list)
        self.commands = moved(self.commands, str)
        used = [self.levels[then] for _, then in stay if then is not None]
        self.levels = moved(self.levels, lambda: self._free_level(used))
        kept = {then: i for i, then in stay if then is not None}
        self.pending = [(due, kept[uav], filled) for due, uav, filled in self.pending if uav in kept]
        self.uavs, self.number = uavs, {uav: i for i, uav in enumerate(uavs)}
        if self.start is not None:
            new = []
            if first is not None:
                del self.joining[first.id]
                step = min(self.step_of(first.time), self.step)
                new = [self.logs[-1].add(first, step, self._detected(first))]
                self.logs[-1].received += 1
            self.held = moved(self.held, lambda: new[0])
            self.homes = moved(self.homes, lambda: new[0].point)
            self.begun = self.step
        elif not self._missing():
            self._begin()
        self.arrived, self.before, self.after, self.outputs, self.sent = [], None, [], None, None
        self._forget_history()

    def _mask(self, uavs: Sequence[int]) -> Tensor:
        return torch.tensor([[uav in uavs for uav in range(len(self.uavs))]])

    def decision(self, uav: int) -> Decision | None:
        """What a UAV has followed last."""
        return self.told[uav][-1] if self.told[uav] else None

    def offer(self, uav: int) -> Decision | None:
        """The latest answer to a UAV."""
        return self.offered[uav][-1] if self.offered[uav] else None

    def _forget_choices(self) -> None:
        self.action = self.node.env.full_action_spec[keys.ACTION].zero()
        self.chosen = self._mask([])

    # What is stored of a fleet.

    def state(self) -> dict[str, Any]:
        """All that the fleet knows; ``restore`` takes it back, bit for bit."""
        return {name: value for name, value in vars(self).items() if name not in _NOT_STORED}

    def restore(self, state: dict[str, Any]) -> None:
        """Take back a ``state`` in a new fleet of these settings."""
        if len(state["uavs"]) != len(self.uavs) and self.parts is not None:
            self.node, self.policy = self.parts(len(state["uavs"]))
        vars(self).update(state)
        for log in [*self.logs, *self.joining.values()]:
            log.ground = self.ground

    # Answers.

    def advice(self, uavs: Sequence[int] | None = None) -> list[Advice]:
        """What UAVs of these numbers, or all, have been told last; the fleet has begun."""
        numbers = range(len(self.uavs)) if uavs is None else uavs
        return [self.advice_of(uav, *self._shown(uav)) for uav in numbers]

    def _shown(self, uav: int) -> tuple[Decision | None, str]:
        """The decision that counts for a UAV, and its state."""
        offer, order = self.offer(uav), self.decision(uav)
        over = offer is not None and offer.status == LANDED and offer.moves
        if offer is not None and offer.status in (OFFERED, ACCEPTED, LANDED) and not over:
            holds = offer.action is None and not offer.moves and self.clock <= offer.until
            if holds or offer.is_live(self.clock) or offer.step == self.step:
                follows = offer.is_open(self.clock) and self.rules.acknowledge
                return offer, "bound" if follows else offer.kind
        if order is None or (self.rules.acknowledge and not order.is_open(self.clock)):
            return None, "none"
        return order, "bound"

    def advice_of(self, uav: int, decision: Decision | None, state: str) -> Advice:
        """What a decision tells a UAV."""
        place: tuple[Any, Any] = (None, None)
        names = ("altitude", "speed", "heading", "distance", "duration", "arrival", "until", "step")
        told: dict[str, Any] = dict.fromkeys(("answer", "reason", *names))
        if decision is not None:
            order = self.decision(uav)
            in_flight = order is not None and order is not decision and order.is_open(self.clock)
            if decision.reason is None or decision.moves:
                place = self.ground.place(decision.goal)
            told["answer"], told["reason"], told["step"] = decision.answer, decision.reason, decision.step
            distance, course = self.ground.way(decision.origin, decision.goal)
            told["until"] = written(decision.expires if state == "bound" else decision.until)
            if not in_flight:  # else nobody knows where it is
                told["distance"], told["duration"] = distance, round(decision.duration, 2)
                told["arrival"] = written(decision.time + decision.duration)
            if decision.moves:
                told["altitude"] = self.levels[uav]
            if decision.moves and not in_flight:
                cruise = self.node.simulation.vehicles.shortest_time(torch.tensor(distance))
                told["heading"], told["speed"] = course, round(distance / float(cruise), 2)
        where = dict(zip(self.ground.columns, place, strict=True))
        age = cast(float, self._age(self.logs[uav].newest))
        head = {"answer": told.pop("answer"), "ID": self.uavs[uav], "state": state}
        return Advice(**head, reason=told.pop("reason"), **where, **told, age=age)

    def status(self, name: str) -> FleetStatus:
        """What is known of the fleet of this name: where its UAVs are believed to be, how reports come in."""
        rows = []
        for uav, log in zip(self.uavs, self.logs, strict=True):
            newest, counts = log.newest, {"late": log.late, "duplicates": log.duplicates}
            place: Any = newest and newest.report.place()
            where = dict(zip(self.ground.columns, place, strict=True)) if place else {}
            number, offer = self.number[uav], self.offer(self.number[uav])
            told: dict[str, Any] = {"command": self.commands[number], "order": offer and offer.status}
            how = {"age": self._age(newest), "reports": log.received, **counts}
            rows.append(UavStatus(ID=uav, **how, **where, **told))
        start = None if self.start is None else written(self.start)
        return FleetStatus(fleet=name, start=start, step=self.step, dt=self.node.dt, uavs=rows)

    def _age(self, filled: FilledReport | None) -> float | None:
        """Age of a report [s]."""
        return None if filled is None else round(max(self.clock - filled.report.time, 0.0), 3)
