"""A fleet of real UAVs: reports come in, advice goes out.

Step k lasts from ``start + k dt`` on; the oldest first report was generated at the start. A message belongs
to the step in which it was generated, and counts from the step in which it came in.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.advice.known import FilledReport, Ground, UavLog, messages_of
from damian.advice.node import LateMessage, Memories, Node, Reported
from damian.advice.rows import Advice, FleetStatus, Report, UavStatus, written
from damian.common.checks import SECONDS
from damian.common.errors import InputError
from damian.common.tensors import expand_mask
from damian.common.text_files import listed, show
from damian.learners.recurrent import AgentGRU
from damian.world.messages import Messages
from damian.world.state import State

FUTURE = 1.0
"""How far the clock of a UAV may be ahead of that of the server [s]."""
LIFE = SECONDS
"""How long a fleet lasts [s]."""
SILENT_STEPS = 1000
"""Steps without any report after which beliefs stand still."""
GRACE = 60.0
"""A landing point stays booked for so long after a late arrival [s], unless the UAV reports to be there."""
TOLD = 64
"""Decisions of a UAV that are kept: a late report in flight was of one of them."""
NEVER_DECIDED = 2**31
"""Steps since the latest decision of a UAV that is ready to choose."""
_ROUNDING = 1e-3
"""Share of a step by which times may be rounded."""


@dataclass(frozen=True)
class Decision:
    """What a UAV was told to do."""

    step: int
    """The step in which it chose."""
    time: float
    """When it was told [s]."""
    action: Any
    """The action: a number, or distance and heading in [0, 1]."""
    origin: int
    """Landing point from which it flies."""
    goal: int
    """Landing point to which it flies; the same if it holds."""
    duration: float
    """Expected duration of the flight [s]."""


class Choice(NamedTuple):
    """What UAVs have chosen, and have not been told yet."""

    decisions: dict[int, Decision]
    """By the numbers of the UAVs."""
    action: Tensor
    """Actions of all UAVs; only those of these UAVs count, [1, N, ...]."""
    hidden: Tensor | None
    """Hidden states after the choice, [1, N, H]."""


class Waiting(Exception):
    """The fleet has not begun, because UAVs have not reported yet; ``str(error)`` names them."""


class Fleet:
    """The server node of one fleet, and the policy that it asks.

    Fleets may share a node, which remembers nothing of them. UAVs book landing points in the order of their
    IDs. With ``drawn``, actions are drawn by ``seed``; if not, the most likely ones are taken.
    """

    def __init__(
        self,
        node: Node,
        uavs: Sequence[str],
        policy: Callable[[TensorDictBase], TensorDictBase],
        drawn: bool = False,
        seed: int = 0,
    ) -> None:
        self.node, self.uavs, self.policy, self.drawn, self.seed = node, list(uavs), policy, drawn, seed
        self.number = {uav: i for i, uav in enumerate(self.uavs)}
        server, airspace = node.server, node.simulation.airspace
        self.ground = Ground(airspace, 2 * node.scenario.region.lattice_step + 50.0)
        self.points = airspace.points[0]
        window, n_readings = server.observation.window, sum(s.width for s in node.simulation.sensors.values())
        self.logs = [UavLog(self.ground, window, n_readings) for _ in self.uavs]
        self.start: float | None = None
        """When step 0 began [s]; None until every UAV has reported."""
        self.step, self.clock = 0, 0.0
        self.held: list[FilledReport] = []
        """The message of each UAV that the server holds."""
        self.told: list[deque[Decision]] = [deque(maxlen=TOLD) for _ in self.uavs]
        """The latest decisions of each UAV, oldest first."""
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
        self.first_step = self.last_arrival = 0
        modules = policy.modules() if isinstance(policy, torch.nn.Module) else ()
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
        """Check a report before it is added, at the time ``now`` [s], or None for one that is recorded."""
        if report.id not in self.number:
            raise InputError(f"ID: {show(report.id)} is no UAV of this fleet: {listed(self.uavs)}")
        came = report.received if now is None else now
        for name, time in (("time", report.time), ("source time", report.source_time)):
            if time is not None and time > came + FUTURE:
                late = f"{time:.13g} s is {time - came:.1f} s after it came in"
                raise InputError(f"{name}: {late}: set the clock of the UAV")
        self._check_life(report.received)
        self.logs[self.number[report.id]].check(report)

    def _check_life(self, now: float) -> None:
        """Check that the steps of the fleet can still be counted."""
        if self.start is not None and now - self.start > LIFE:
            raise InputError(f"time: the fleet began more than {LIFE:g} s ago: end it, and begin a new one")

    def report(self, report: Report) -> str:
        """Add a checked report; it is ``new``, ``late``, ``duplicate``, or ``old`` (before the start)."""
        self.advance(report.received)  # what comes in late fills in no earlier step
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
        if report.time < self.start:
            return "old"
        now = self.step_of(self.clock)
        step = min(self.step_of(report.time), now)
        sent = next((each for each in reversed(self.told[uav]) if each.step < step), None)
        filled = log.add(report, step, self._detected(report), sent and (sent.origin, sent.goal))
        due = max(now, self.step)
        if self.node.scenario.delay.hold == "max":
            due = max(due, step + self.node.law_longest)
        self.pending.append((due, uav, filled))
        self.outputs = self.sent = None
        self._collect()
        return found

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
        self.step = self.first_step = self.last_arrival = max(self.step_of(self.clock), 0)
        for log, report in zip(self.logs, newest, strict=True):
            log.reports.clear()
            log.add(report, min(self.step_of(report.time), self.step), self._detected(report))
        self.held = [log.reports[-1] for log in self.logs]

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

    def advance(self, now: float) -> None:
        """Take all steps up to an instant [s]."""
        self.clock = now = max(self.clock, now)
        if self.start is None:
            return
        last = self.step_of(now)
        while self.step < last:
            quiet = self.step >= self.last_arrival + SILENT_STEPS
            if self.before is not None and quiet and not self.chosen.any() and not self.previous[1].any():
                following = min([last, *(due for due, _, _ in self.pending)])
                self.before = self.node.skip(self.before, following - self.step)
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
        late = {key: filled for key, filled in arrived.items() if self.first_step < key[1] < self.step}
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
        if decision is None:
            return held.target
        if held.step <= decision.step:
            return decision.goal
        expired = self.clock > decision.time + 2 * decision.duration + GRACE
        return held.target if asks or expired else decision.goal

    # Advice.

    def choose(self, now: float, asking: Sequence[str] | None = None) -> Choice | None:
        """What UAVs choose that have not yet in this step; nothing changes until they are told (``tell``)."""
        numbers = self.numbers_of(asking)
        self.advance(now)
        if self.start is None:
            raise Waiting(f"no advice yet: no report of {listed(self._missing())} has come in")
        self._check_life(self.clock)
        if numbers is None:
            numbers = [uav for uav, held in enumerate(self.held) if not held.report.flies]
        choosing = [uav for uav in numbers if not self.chosen[0, uav]]
        if choosing:  # else what has come in since then need not be looked at yet
            ready = self._observe()[keys.READY][0]
            choosing = [uav for uav in choosing if ready[uav]]
        return self.choice(choosing, *self.ask_policy(choosing)) if choosing else None

    def numbers_of(self, asking: Sequence[str] | None) -> list[int] | None:
        """Numbers of the UAVs that ask."""
        for uav in asking or ():
            if uav not in self.number:
                raise InputError(f"uav: {show(uav)} is no UAV of this fleet: {listed(self.uavs)}")
        return None if asking is None else sorted({self.number[uav] for uav in asking})

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

    def choice(self, choosing: Sequence[int], action: Tensor, hidden: Tensor | None) -> Choice:
        """To which landing points the actions of the UAVs of these numbers lead; tensors as of ``Choice``."""
        before = self._state(choosing)
        state = self.node.simulation.decide(before, action, self._mask(choosing))
        vehicles = self.node.simulation.vehicles
        length = vehicles.length(before.goal, state.goal)
        duration = (2 * vehicles.vertical + vehicles.shortest_time(length)) * (length > 0)
        columns = (each[0].tolist() for each in (action, before.goal, state.goal, duration))
        decided = [Decision(self.step, self.clock, *values) for values in zip(*columns, strict=True)]
        return Choice({uav: decided[uav] for uav in choosing}, action, hidden)

    def tell(self, choice: Choice) -> None:
        """Note that UAVs have been told what they have chosen in this step."""
        for uav, decision in choice.decisions.items():
            self.told[uav].append(decision)
        valid = self._mask([*choice.decisions])
        self.chosen = self.chosen | valid
        self.action = torch.where(expand_mask(valid, choice.action), choice.action, self.action)
        self.hidden_after = choice.hidden

    def _mask(self, uavs: Sequence[int]) -> Tensor:
        return torch.tensor([[uav in uavs for uav in range(len(self.uavs))]])

    def decision(self, uav: int) -> Decision | None:
        """What a UAV was told last."""
        return self.told[uav][-1] if self.told[uav] else None

    def _forget_choices(self) -> None:
        self.action = self.node.env.full_action_spec[keys.ACTION].zero()
        self.chosen = self._mask([])

    # Answers.

    def advice(self, uavs: Sequence[int] | None = None) -> list[Advice]:
        """What UAVs of these numbers, or all, have been told last; the fleet has begun."""
        numbers = range(len(self.uavs)) if uavs is None else uavs
        return [self.advice_of(uav, self.decision(uav)) for uav in numbers]

    def advice_of(self, uav: int, decision: Decision | None) -> Advice:
        """What a decision tells a UAV."""
        place: tuple[Any, Any] = (None, None)
        told: dict[str, Any] = dict.fromkeys(("heading", "distance", "duration", "arrival", "step"))
        state = "none"
        if decision is not None:
            moves, place = decision.goal != decision.origin, self.ground.place(decision.goal)
            distance, course = self.ground.way(decision.origin, decision.goal)
            state = ("fly" if moves else "hold") if decision.step == self.step else "bound"
            told["heading"], told["distance"] = course if moves else None, distance
            told["duration"] = round(decision.duration, 2)
            told["arrival"], told["step"] = written(decision.time + decision.duration), decision.step
        where = dict(zip(self.ground.columns, place, strict=True))
        age = cast(float, self._age(self.held[uav]))
        return Advice(ID=self.uavs[uav], state=state, **where, **told, age=age)

    def status(self, name: str) -> FleetStatus:
        """What is known of the fleet of this name: where its UAVs are believed to be, how reports come in."""
        rows = []
        for uav, log in zip(self.uavs, self.logs, strict=True):
            newest, counts = log.newest, {"late": log.late, "duplicates": log.duplicates}
            place: Any = newest and newest.report.place()
            where = dict(zip(self.ground.columns, place, strict=True)) if place else {}
            rows.append(UavStatus(ID=uav, age=self._age(newest), **where, reports=log.received, **counts))
        start = None if self.start is None else written(self.start)
        return FleetStatus(fleet=name, start=start, step=self.step, dt=self.node.dt, uavs=rows)

    def _age(self, filled: FilledReport | None) -> float | None:
        """Age of a report [s]."""
        return None if filled is None else round(max(self.clock - filled.report.time, 0.0), 3)
