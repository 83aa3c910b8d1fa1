"""A fleet of real UAVs: reports come in, advice goes out.

Time is divided into the steps of the training: step k lasts from ``start + k dt`` to ``start + (k + 1) dt``,
where the start is the instant at which the oldest first report was generated. A message belongs to the step
in which it was generated, and counts from the step in which it came in; its age is the number of steps since
the former.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.advice.clocks import LIFE, check_ahead, check_first, check_life, step_at
from damian.advice.decisions import TOLD, Choices, Decision, Told
from damian.advice.ground import Ground
from damian.advice.known import Known, UavLog, messages_of
from damian.advice.node import FOREVER, LateMessage, Memories, Node, Reported
from damian.advice.reports import Report
from damian.common.errors import InputError
from damian.common.text_files import listed, show
from damian.envs.uav_env import Outputs
from damian.learners.recurrent import AgentGRU
from damian.world.messages import Messages
from damian.world.state import State

SILENT_STEPS = 1000
"""Steps without any report after which beliefs stand still."""


class Waiting(Exception):
    """The fleet has not begun, because UAVs have not reported yet; ``str(error)`` names them."""


class Fleet:
    """The server node of one fleet, and the policy that it asks.

    Args:
        node: for as many UAVs; fleets may share it, because it remembers nothing of them.
        uavs: IDs of the UAVs, in the order in which they book landing points.
        policy: from observations to actions.
        drawn: actions are drawn; if not, the most likely ones are taken.
        seed: of these draws.
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
        self.held: list[Known] = []
        self.told: Told = [deque(maxlen=TOLD) for _ in self.uavs]
        self.pending: list[tuple[int, int, Known]] = []  # step from which it counts, UAV, report
        self.arrived: list[tuple[int, Known]] = []  # those that count from this step on
        self.before: Memories | None = None
        self.after: Memories = []
        self.outputs: Outputs | None = None
        self.sent: Messages | None = None
        self.first_step = self.last_arrival = 0
        self.hidden = self.hidden_after = _no_hidden(policy, len(self.uavs))
        self._forget_choices()
        self.previous = self.action, self.chosen

    # Reports.

    def step_of(self, time: float) -> int:
        """The step in which an instant lies."""
        return step_at(time, self.start or 0.0, self.node.dt)

    def check(self, report: Report, received: float, now: float | None = None) -> None:
        """Check a report before it is added.

        Args:
            report: the report.
            received: when it came in, by the clock of the fleet, which never goes back [s].
            now: the time, if it comes in now; None for one that is recorded [s].

        Raises:
            InputError: the UAV is of another fleet, its clock is wrong, the report is from another region, or
                it came in so late that steps cannot be counted.
        """
        if report.uav not in self.number:
            raise InputError(f"ID: {show(report.uav)} is no UAV of this fleet: {listed(self.uavs)}")
        check_ahead(report, received if now is None else now)
        if now is not None and self.start is None:
            check_first(report, now)
        check_life(self.start, received)
        self.logs[self.number[report.uav]].check(report)

    def report(self, report: Report, received: float) -> str:
        """Add a checked report.

        Args:
            report: the report.
            received: when it came in [s].

        Returns:
            ``new``, ``late`` (an older one, which is kept in its place), ``duplicate`` (one that was
            generated at the same time came in before), or ``old`` (generated before the fleet began).
        """
        self.advance(received)  # what comes in late fills in no earlier step
        received = self.clock
        uav = self.number[report.uav]
        log = self.logs[uav]
        log.received += 1
        if log.has(report.time):
            log.duplicates += 1
            return "duplicate"
        newest = log.newest
        late = newest is not None and report.time < newest.report.time
        log.late += late
        if self.start is None:
            log.add(report, 0, None)
            if not self._missing():
                self._begin(received)
            return "late" if late else "new"
        if report.time < self.start:
            return "old"
        now = self.step_of(received)
        step = min(self.step_of(report.time), now)
        detected = None if report.detected is None else max(self.step_of(report.detected), 0)
        sent = next((each for each in reversed(self.told[uav]) if each.step < step), None)
        known = log.add(report, step, detected, sent and (sent.origin, sent.goal))
        due = max(now, self.step)
        if self.node.scenario.delay.hold == "max":
            due = max(due, step + self.node.law_longest)
        self.pending.append((due, uav, known))
        self.outputs = self.sent = None
        self._collect()
        return "late" if late else "new"

    def _missing(self) -> list[str]:
        """The UAVs for which the fleet waits: each must have a report in which the fleet can begin."""
        oldest = self.clock - LIFE
        found = zip(self.uavs, self.logs, strict=True)
        return [uav for uav, log in found if log.newest is None or log.newest.report.time < oldest]

    def _begin(self, received: float) -> None:
        """Begin with the newest report of each UAV."""
        newest = [log.known[-1].report for log in self.logs]
        self.start = min(report.time for report in newest)
        self.step = self.first_step = self.last_arrival = max(self.step_of(received), 0)
        for log, report in zip(self.logs, newest, strict=True):
            detected = None if report.detected is None else max(self.step_of(report.detected), 0)
            log.known.clear()
            log.add(report, min(self.step_of(report.time), self.step), detected)
        self.held = [log.known[-1] for log in self.logs]

    def _collect(self) -> None:
        """Let the reports that count by now arrive."""
        due = [each for each in self.pending if each[0] <= self.step]
        if not due:
            return
        self.pending = [each for each in self.pending if each[0] > self.step]
        self.outputs, self.sent, self.last_arrival = None, None, self.step
        by_arrival = self.node.scenario.delay.order == "arrival"
        for _, uav, known in sorted(due, key=lambda each: each[2].report.time):
            held = self.held[uav]
            # Of those that arrive in the same step, the one that was generated last counts as the last.
            earlier = by_arrival and not any(each is held for _, each in self.arrived)
            self.arrived.append((uav, known))
            if earlier or known.report.time > held.report.time:
                self.held[uav] = known

    # Steps.

    def advance(self, now: float) -> None:
        """Take all steps up to an instant [s]."""
        self.clock = now = max(self.clock, now)
        if self.start is None:
            return
        last = self.step_of(now)
        while self.step < last:
            if self.before is not None and self._is_idle():
                following = min([last, *(due for due, _, _ in self.pending)])
                self.before = self.node.skip(self.before, following - self.step)
            else:
                if self.hidden is not None and self.hidden_after is self.hidden:
                    self.ask_policy([])  # hidden states change in every step
                self._observe()
                following, self.before = self.step + 1, self.after
            self.previous = self.action, self.chosen
            self.hidden, self.step, self.outputs, self.arrived = self.hidden_after, following, None, []
            self._forget_choices()
            self._collect()

    def _is_idle(self) -> bool:
        """Whether the step changes nothing: there was no report for long, and nobody has chosen."""
        quiet = self.step >= self.last_arrival + SILENT_STEPS
        return quiet and not self.chosen.any() and not self.previous[1].any()

    def _observe(self) -> Outputs:
        """The outputs of the step, from what has arrived by now."""
        if self.outputs is None:
            reported, state = self._reported(), self._state([])
            if self.before is None:
                self.after, self.outputs = self.node.begin(state, reported)
            else:
                self.after, self.outputs = self.node.step(self.before, state, reported, *self.previous)
        return self.outputs

    def _reported(self) -> Reported:
        late = {}
        for uav, known in self.arrived:
            if self.first_step < known.step < self.step:
                late[uav, known.step] = known
        self.sent = self._messages(self.held)
        rows = self.sent.pack()
        if late:
            rows = torch.cat([rows, self._messages([*late.values()]).pack()])
        steps = torch.tensor([known.step for known in self.held])
        fresh = {uav for uav, known in self.arrived if known.step == self.step}
        n = len(self.uavs)
        return Reported(
            held=rows[:n],
            age=self.step - steps,
            on_time=torch.tensor([uav in fresh and self.held[uav].step == self.step for uav in range(n)]),
            late=[
                LateMessage(row, uav, self.step - step)
                for row, (uav, step) in zip(rows[n:], late, strict=True)
            ],
        )

    def _messages(self, known: Sequence[Known]) -> Messages:
        return messages_of(known, self.node.server, self.points, self.node.dt)

    def _state(self, asking: Sequence[int]) -> State:
        """The state of the world, as far as it is known; the UAVs that ask are ready to choose."""
        state, n = self.node.blank, len(self.uavs)
        if self.sent is None:
            self.sent = self._messages(self.held)
        sent = self.sent
        ready = torch.tensor([[uav in asking for uav in range(n)]])
        goal = torch.tensor([[self._standing(uav, uav in asking) for uav in range(n)]])
        return state._replace(
            steps=torch.tensor([self.step]),
            goal=goal,
            origin=goal,
            elapsed=torch.where(ready, FOREVER, -1),
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
        return held.target if asks or self.clock > decision.expires else decision.goal

    # Advice.

    def advise(self, now: float, asking: Sequence[str] | None = None) -> list[int]:
        """Let UAVs choose.

        Args:
            now: the time [s].
            asking: IDs of those that are ready to choose; if not given, all that are not known to be in
                flight.

        Returns:
            Numbers of the UAVs that have chosen now; those that have chosen in this step before do not choose
            again.

        Raises:
            InputError: a UAV is of another fleet, or the fleet began too long ago.
            Waiting: not every UAV has reported yet.
        """
        numbers = self.numbers_of(asking)
        self.advance(now)
        if self.start is None:
            missing = self._missing()
            known = any(self.logs[self.number[uav]].known for uav in missing)
            since = f" that is newer than {LIFE:g} s" if known else ""
            raise Waiting(f"no advice yet: no report of {listed(missing)}{since} has come in")
        check_life(self.start, self.clock)
        if numbers is None:
            numbers = [uav for uav, known in enumerate(self.held) if not known.report.flies]
        chosen = self.chosen[0].tolist()
        choosing = [uav for uav in numbers if not chosen[uav]]
        if choosing:  # else what has come in since then need not be looked at yet
            ready = self._observe()[keys.READY][0].tolist()
            choosing = [uav for uav in choosing if ready[uav]]
        if choosing:
            self.choose(choosing, self.ask_policy(choosing))
        return choosing

    def numbers_of(self, asking: Sequence[str] | None) -> list[int] | None:
        """Numbers of the UAVs that ask."""
        for uav in asking or ():
            if uav not in self.number:
                raise InputError(f"uav: {show(uav)} is no UAV of this fleet: {listed(self.uavs)}")
        return None if asking is None else sorted({self.number[uav] for uav in asking})

    def observe(self, asking: Sequence[int]) -> TensorDictBase:
        """What the policy reads, if these UAVs are ready to choose."""
        outputs = dict(self._observe())
        if keys.ACTION_MASK in outputs:
            outputs[keys.ACTION_MASK] = self.node.simulation.action_mask(self._state(asking))
        tensordict = self.node.worlds.to_tensordict(outputs)
        if self.hidden is not None:
            tensordict[keys.HIDDEN] = self.hidden.clone()
        return tensordict

    @torch.no_grad()
    def ask_policy(self, choosing: Sequence[int]) -> Tensor:
        """Actions of all UAVs, [1, N, ...], of which those that choose count."""
        read = self.observe(choosing)
        if self.drawn:
            with torch.random.fork_rng(devices=[]), set_exploration_type(ExplorationType.RANDOM):
                torch.default_generator.manual_seed(hash((self.seed, self.step, *choosing)) % 2**62)
                chosen = self.policy(read)
        else:
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                chosen = self.policy(read)
        if self.hidden is not None:
            self.hidden_after = chosen[keys.HIDDEN].detach()
        return chosen[keys.ACTION]

    def choose(self, choosing: Sequence[int], action: Tensor) -> None:
        """Send UAVs to the landing points to which their actions lead.

        Args:
            choosing: numbers of these UAVs.
            action: actions of all UAVs, [1, N, ...].
        """
        valid = torch.tensor([[uav in choosing for uav in range(len(self.uavs))]])
        before = self._state(choosing)
        state = self.node.simulation.decide(before, action, valid)
        vehicles = self.node.simulation.vehicles
        length = vehicles.length(before.goal, state.goal)
        duration = (2 * vehicles.vertical + vehicles.shortest_time(length)) * (length > 0)
        for uav in choosing:
            values = action[0, uav].tolist()
            origin, goal = int(before.goal[0, uav]), int(state.goal[0, uav])
            self.told[uav].append(
                Decision(self.step, self.clock, values, origin, goal, float(duration[0, uav]))
            )
        self.chosen = self.chosen | valid
        mask = valid.view(*valid.shape, *[1] * (action.dim() - 2))
        self.action = torch.where(mask, action, self.action)

    def choices(self) -> Choices:
        """What the UAVs have chosen so far, for ``take_back``."""
        return Choices([deque(each, TOLD) for each in self.told], self.action, self.chosen, self.hidden_after)

    def take_back(self, before: Choices) -> None:
        """Take back what UAVs have chosen in this step since ``choices``, because they were not told."""
        self.told, self.action, self.chosen, self.hidden_after = before

    def decision(self, uav: int) -> Decision | None:
        """What a UAV was told last."""
        return self.told[uav][-1] if self.told[uav] else None

    def _forget_choices(self) -> None:
        self.action = self.node.env.full_action_spec[keys.ACTION].zero()
        self.chosen = torch.zeros(1, len(self.uavs), dtype=torch.bool)


def _no_hidden(policy: Any, n_uavs: int) -> Tensor | None:
    """Hidden states of a recurrent policy at the beginning, [1, N, H]; None if it is not recurrent."""
    modules = policy.modules() if isinstance(policy, torch.nn.Module) else ()
    sizes = [each.cell.hidden_size for each in modules if isinstance(each, AgentGRU)]
    return torch.zeros(1, n_uavs, sizes[0]) if sizes else None
