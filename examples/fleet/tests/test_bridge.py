"""The bridge in virtual time, against a scripted vehicle and a scripted service."""

from collections.abc import Callable
from typing import Any

import pytest
from scripted import BEGIN, GOAL, HOME, LOITER, RTL, STABILIZE, TICK, Service, Vehicle, mavlink

from damian_fleet.bridge import GUIDED, LAND, Answer, Bridge, Memory, Request


class World:
    """Bridge, vehicle and service in one virtual time."""

    def __init__(self, **bridge: Any) -> None:
        self.vehicle, self.service, self.now = Vehicle(), Service(), 0.0
        self.bridge = Bridge("A", "north", **bridge)
        self.states: list[str] = []
        self._out: list[Any] = []
        self._answers: list[Answer] = []

    def run(self, seconds: float, until: Callable[[], Any] = lambda: False) -> bool:
        for _ in range(round(seconds / TICK)):
            if until():
                return True
            self.now = round(self.now + TICK, 3)
            messages = self.vehicle.step(self.now, self._out)
            self._out, requests = self.bridge.step(self.now, messages, self._answers)
            self._answers = [self.service.answer(each, self.now) for each in requests]
            if [self.bridge.state] != self.states[-1:]:
                self.states.append(self.bridge.state)
        return bool(until())

    def heal(self) -> "World":
        """Let everything go as it should from now on."""
        self.vehicle.results, self.service.bad = {}, lambda _, answer: answer
        return self

    def start_again(self) -> "World":
        """Start the bridge again, with what it remembers."""
        stored = self.bridge.memory.model_dump_json()
        self.bridge = Bridge("A", "north", memory=Memory.model_validate_json(stored))
        self._out, self._answers = [], []
        return self

    def until(self, state: str) -> "World":
        assert self.run(120, lambda: self.bridge.state == state), (self.bridge.state, self.bridge.why)
        return self


FLIGHT = ["ground", "accept", "guided", "arm", "climb", "cruise", "landing"]
TOLD = ["accepted", "taken off", "landed"]


def test_it_reports_asks_accepts_flies_lands_and_reports_again():
    world = World()
    world.vehicle.batteries = {0: 95, 1: 40}
    assert world.run(200, lambda: len(world.service.facts) >= 6)
    world.run(20)
    assert world.states[: 2 + 2 * len(FLIGHT)] == ["connect", "join", *FLIGHT, *FLIGHT]
    assert world.service.facts[:6] == [(f"x-{n}", fact) for n in (1, 2) for fact in TOLD]
    assert world.vehicle.commands()[:6] == [176, 400, 22, 192, 178, 21]
    reports = world.service.reports
    assert [row["number"] - reports[0]["number"] for row in reports] == [*range(len(reports))]
    assert {row["battery"] for row in reports} == {40}, "the lowest of its batteries"
    assert [row["on ground"] for row in reports[:3]] == [1, 0, 1]
    log = world.service.log
    assert log.index("POST reports") < log.index("POST advice") < log.index("POST acknowledgements")
    assert all(row["came"] - 1 < row["time"] <= row["came"] for row in reports)
    newest = reports[-1]
    assert len(newest["landed"]) == 3
    assert newest["landed"] == sorted(newest["landed"], reverse=True)
    assert newest["previous"][0] == pytest.approx(GOAL, abs=2e-5)
    assert newest["motions"] == 2


def test_the_speed_is_that_of_the_answer():
    world = World().until("cruise")
    world.run(3)
    assert (world.vehicle.speed, world.vehicle.commands()[-2:]) == (5.0, [192, 178])


REFUSE = {"guided": {176: 1}, "arm": {400: 1}}
"""Results by which a state lasts: temporarily rejected."""


def MISSING(_: Request, answer: Answer) -> Answer:
    """No link to the service."""
    return Answer(None, None, answer.number)


def UNCONFIRMED(request: Request, answer: Answer) -> Answer:
    """No answer to what is accepted."""
    return MISSING(request, answer) if request.path.endswith("acknowledgements") else answer


def in_state(state: str) -> World:
    """A world in a state that lasts."""
    world = World()
    world.vehicle.results = REFUSE.get(state, {})
    world.service.command = "hold" if state == "ground" else ""
    world.service.bad = {"join": MISSING, "accept": UNCONFIRMED}.get(state, world.service.bad)
    world.until(state).run(1.5)
    assert world.bridge.state == state
    return world


def watches(world: World) -> bool:
    """Whether the bridge gives the vehicle to the pilot, and commands nothing afterwards."""
    assert world.run(5, lambda: world.bridge.state == "watch"), (world.bridge.state, world.bridge.why)
    before = len(world.vehicle.commands())
    world.heal().run(60)
    return len(world.vehicle.commands()) == before and world.bridge.state == "watch"


def motors(vehicle: Vehicle) -> None:
    """Switched on, or off as by a crash check: then it lies on the ground."""
    vehicle.armed, vehicle.landed, vehicle.height, vehicle.fall = not vehicle.armed, True, 0.0, 6.0
    vehicle.fly = lambda: None


ACTS = {
    "loiter": lambda vehicle: setattr(vehicle, "mode", LOITER),
    "rtl": lambda vehicle: setattr(vehicle, "mode", RTL),
    "motors": motors,
    "restart": lambda vehicle: setattr(vehicle, "booted", 0.0),
    "failsafe": lambda vehicle: setattr(vehicle, "status", 5),
}
SEEN = [(state, act) for state in ["join", *FLIGHT] for act in ACTS]
SEEN = [each for each in SEEN if each[1] != "failsafe" or each[0] in ("join", "ground", "accept", "guided")]


@pytest.mark.parametrize(("state", "act"), [each for each in SEEN if each != ("arm", "motors")])
def test_after_an_act_of_somebody_else_it_commands_nothing(state, act):
    world = in_state(state)
    ACTS[act](world.vehicle)
    assert watches(world)


@pytest.mark.parametrize(("command", "state"), [(176, "guided"), (400, "arm"), (22, "climb")])
def test_what_is_refused_before_the_flight_gives_the_vehicle_back(command, state):
    world = World()
    world.vehicle.results = {command: 4}
    world.until(state)
    assert watches(world)
    assert world.vehicle.commands(command) == [command]


def test_the_pilot_hands_over_by_guided_on_the_ground_with_motors_off():
    world = in_state("cruise")
    vehicle = world.vehicle
    vehicle.mode = LOITER
    world.until("watch").run(12)
    before = len(vehicle.commands())
    for mode in (GUIDED, LAND):  # in flight it is no handing over
        vehicle.mode, vehicle.target = mode, vehicle.height
        world.run(30)
    assert vehicle.landed
    assert world.service.reports[-1]["on ground"], "where it stands now"
    vehicle.mode = GUIDED
    assert (world.bridge.state, len(vehicle.commands())) == ("watch", before)
    n_reports = len(world.service.reports)
    world.until("ground").until("accept")
    assert len(world.service.reports) > n_reports
    assert world.run(90, lambda: world.service.facts[-1][1] == "landed")


def test_a_command_that_comes_late_is_no_handing_over():
    world = World()
    world.vehicle.results = {176: 1}
    world.until("guided").vehicle.mode = LOITER
    world.until("watch").run(2)
    world.vehicle.mode = GUIDED
    world.run(40)
    assert (world.bridge.state, world.vehicle.commands(400)) == ("watch", [])


def test_it_commands_its_own_vehicle_alone():
    world, other = World(), Vehicle(2)
    obey = world.vehicle.step

    def step(now, messages):
        other.mode, other.landed = RTL, False
        return [*obey(now, messages), *other.step(now, messages)]

    world.vehicle.step = step
    assert world.run(120, lambda: len(world.service.facts) == 3)
    assert (other.commands(), other.heard) == ([], [])


@pytest.mark.parametrize(
    ("kind", "name"), [((2, 12), "AUTOPILOT_PX4"), ((1, 3), "FIXED_WING"), ((6, 8), "GCS")]
)
def test_what_is_no_copter_with_ardupilot_is_refused_by_name(kind, name, caplog):
    world = World()
    world.vehicle.kind = kind
    world.run(40)
    assert (world.bridge.state, world.vehicle.heard) == ("connect", [])
    assert name in caplog.text


def test_acknowledgements_for_other_stations_do_not_count():
    world = World()
    world.vehicle.station = (255, 190)
    world.until("cruise").run(5)
    assert world.vehicle.commands(192, 178)[:2] == [192, 192], "again, because nobody has acknowledged it"
    assert world.run(90, lambda: world.service.facts[-1][1] == "landed")


def test_a_position_before_the_fix_is_none_and_it_flies_afterwards():
    world = World()
    world.vehicle.fix = False
    world.run(20)
    assert (world.bridge.state, world.service.reports) == ("connect", [])
    world.vehicle.fix = True
    assert world.run(250, lambda: world.service.facts.count(("x-3", "landed")) == 1)
    assert max(abs(place[0] - HOME[0]) for place in world.bridge.memory.stops) < 0.01


def test_a_position_without_a_fix_of_the_receiver_is_none():
    world = World(system=1)
    for fix, state in ((1, "connect"), (3, "cruise")):
        world.vehicle.extra = [mavlink.MAVLink_gps_raw_int_message(0, fix, 0, 0, 0, 0, 0, 0, 0, 0)]
        world.run(30, lambda: world.bridge.state == "cruise")
        assert world.bridge.state == state


def test_a_jump_is_no_position_until_it_lasts():
    world = World()
    world.service.command = "hold"
    world.until("ground").run(5)
    for lasting, is_taken in ((5, False), (30, True)):
        world.vehicle.place = [HOME[0] + 0.1, HOME[1]]
        world.run(lasting)
        assert (world.service.reports[-1]["lat"] > HOME[0] + 0.05) == is_taken
        world.vehicle.place = list(HOME)
        world.run(3)


BAD = {
    "html": lambda _, answer: Answer(502, None, answer.number),
    "unreachable": MISSING,
    "time-out": lambda _, answer: Answer(200, {}, -1),
    "text": lambda _, answer: Answer(200, "garbage", answer.number),
    "empty": lambda _, answer: Answer(200, {}, answer.number),
    "no numbers": lambda _, answer: Answer(
        200, {"time": "x", "status": [], "advice": [{"state": "hold", "answer": []}]}, answer.number
    ),
    "no time": lambda request, answer: (
        Answer(503, {"error": "busy"}, answer.number) if request.path == "/time" else answer
    ),
}


@pytest.mark.parametrize("bad", BAD.values(), ids=list(BAD))
def test_an_error_of_the_service_is_a_missing_answer(bad):
    world = in_state("cruise")
    world.service.bad = bad
    assert world.run(90, lambda: world.vehicle.landed), "the flight in hand ends at its goal"
    world.run(30)
    world.heal()
    assert world.run(150, lambda: world.service.facts[-1] == ("x-2", "landed"))
    assert world.service.facts.index(("x-1", "landed")) < world.service.facts.index(("x-2", "taken off"))


def test_the_policy_may_hold_and_that_is_a_decision():
    world = World()
    world.service.command, world.service.reason = "hold", None
    world.until("ground").run(10)
    n_holds = len(world.service.facts)
    assert n_holds > 2
    assert world.bridge.memory.motions == n_holds == len(world.bridge.memory.landed) - 1
    assert "accept" not in world.states


@pytest.mark.parametrize("state", ["guided", "arm", "climb", "cruise"])
def test_an_operator_is_heard_in_every_state_of_a_flight(state):
    world = in_state(state)
    world.service.command, world.vehicle.results = "hold", {}
    assert world.run(5, lambda: world.bridge.state == "landing")
    assert world.run(60, lambda: world.bridge.state == "ground")
    assert world.service.facts[-2:] == [("x-2", "accepted"), ("x-1", "aborted")]
    world.run(30)
    assert (world.bridge.state, world.vehicle.armed) == ("ground", False)
    world.service.command = ""
    assert world.run(120, lambda: world.service.facts[-1][1] == "landed")


def test_after_a_lost_link_it_reports_before_it_asks():
    world = in_state("cruise")
    world.vehicle.silent = world.vehicle.deaf = True
    world.vehicle.fly = lambda: None
    world.run(10)
    n_sent, world.service.log = len(world.vehicle.heard), []
    world.run(10)
    assert "POST advice" not in world.service.log
    assert len(world.vehicle.heard) == n_sent
    world.vehicle.silent = world.vehicle.deaf = False
    healed = BEGIN + world.now
    assert world.run(10, lambda: "POST advice" in world.service.log)
    assert world.service.reports[-1]["time"] > healed


def test_after_a_long_silence_of_the_service_it_reports_before_it_asks():
    world = in_state("ground")
    world.service.bad = MISSING
    world.run(30)
    world.service.log, healed = [], BEGIN + world.heal().now
    assert world.run(10, lambda: "POST advice" in world.service.log)
    assert world.service.reports[-1]["time"] > healed


def test_it_joins_a_fleet_that_flies_and_leaves_it_after_its_flight():
    world = World()
    world.service.members = ["B", "C"]
    world.until("cruise")
    assert world.service.members == ["B", "C", "A"]
    world.bridge.leaving = True
    world.until("left")
    assert world.service.facts == [("x-1", fact) for fact in TOLD]
    assert world.service.members == ["B", "C"]


def test_it_leaves_a_vehicle_that_the_pilot_has():
    world = in_state("ground")
    world.vehicle.mode = LOITER
    world.until("watch").bridge.leaving = True
    world.until("left")
    assert world.service.members == []


@pytest.mark.parametrize("state", ["guided", "arm", "climb", "cruise", "landing", "watch", "hold"])
def test_started_again_it_goes_on_as_it_was(state):
    world = in_state("cruise" if state in ("watch", "hold") else state)
    if state == "watch":
        world.vehicle.mode = LAND
    elif state == "hold":
        world.service.command = "hold"
    world.run(5 if state in ("watch", "hold") else 0)
    n_reports, before = len(world.service.reports), len(world.vehicle.commands())
    world.start_again().heal().run(60)
    world.service.command = ""
    if state == "watch":
        assert (world.bridge.state, len(world.vehicle.commands())) == ("watch", before)
    else:
        end = "landed" if state in ("climb", "cruise", "landing") else "aborted"
        assert world.run(60, lambda: ("x-1", end) in world.service.facts)
        assert world.run(150, lambda: world.service.facts[-1][1] == "landed")
    assert world.service.reports[n_reports]["number"] == world.service.reports[0]["number"] + n_reports


@pytest.mark.parametrize("act", ["loiter", "motors"])
@pytest.mark.parametrize("state", ["ground", "guided", "climb", "cruise", "landing"])
def test_what_somebody_does_while_it_is_off_counts(state, act):
    world = in_state(state)
    ACTS[act](world.vehicle)
    world.start_again()
    assert watches(world)


def test_an_older_message_on_a_longer_way_does_not_count():
    world = World()
    world.until("guided")
    old = world.vehicle.wired([mavlink.MAVLink_heartbeat_message(2, 3, 1, STABILIZE, 3, 3)])
    world.until("arm").run(0.5)
    world.bridge.step(world.now, old)
    assert world.run(90, lambda: world.service.facts[-1][1] == "landed")


@pytest.mark.parametrize(
    ("come", "facts"),
    [("lapsed", []), ("refused", []), ("unknown", []), ("landed", []), ("taken off", [("x-1", "aborted")])],
)
def test_what_the_service_does_not_confirm_is_not_flown(come, facts):
    world = World()
    world.service.bad = lambda request, answer: (
        answer._replace(body={"status": [come]}) if "status" in answer.body else answer
    )
    world.until("accept").until("ground")
    assert world.vehicle.commands() == []
    world.heal().run(1)
    assert world.service.facts[1 : 1 + len(facts)] == facts
    assert world.run(90, lambda: world.service.facts[-1][1] == "landed")


def test_without_a_memory_a_flight_is_left_to_the_pilot():
    world = in_state("cruise")
    world.bridge = Bridge("A", "north")
    assert watches(world)


@pytest.mark.parametrize(
    ("state", "bad", "then"),
    [
        ("accept", {}, "ground"),
        ("guided", {176: 0}, "landing"),
        ("arm", {400: 0}, "landing"),
        ("climb", {22: 0}, "landing"),
        ("cruise", {192: 0}, "landing"),
        ("cruise", {192: 2}, "landing"),
    ],
)
def test_a_state_without_its_effect_ends_at_its_limit(state, bad, then):
    world = World()
    world.vehicle.results = bad
    world.service.bad = UNCONFIRMED if state == "accept" else world.service.bad
    world.until(state)
    assert world.run(125, lambda: world.bridge.state != state)
    assert world.bridge.state == then
    world.heal()
    assert world.run(200, lambda: world.service.facts[-1][1] == "landed")


def test_motors_that_stay_on_after_the_landing_are_the_pilots():
    world = in_state("landing")
    world.vehicle.results, fly = {400: 4}, world.vehicle.fly

    def stays_on():
        fly()
        world.vehicle.armed = True

    world.vehicle.fly = stays_on
    world.run(70)
    assert world.bridge.state == "watch"


@pytest.mark.parametrize("state", ["connect", "join", "ground", "cruise", "landing", "watch"])
def test_what_waits_says_so(state, caplog):
    caplog.set_level("INFO")
    world = World() if state == "connect" else in_state("ground" if state == "watch" else state)
    if state == "watch":
        world.vehicle.mode = LOITER
    world.vehicle.silent = state in ("connect", "cruise", "landing")
    world.run(75)
    assert caplog.text.count(f"A: {state} for ") in (1, 2)


def test_what_the_vehicle_says_is_logged_and_its_own_checks_are_waited_for(caplog):
    caplog.set_level("INFO")
    world = World()
    bit = mavlink.MAV_SYS_STATUS_PREARM_CHECK
    world.run(1)
    world.vehicle.extra = [
        mavlink.MAVLink_statustext_message(4, b"PreArm: Compass not calibrated"),
        mavlink.MAVLink_sys_status_message(bit, bit, 0, 0, 0, -1, -1, 0, 0, 0, 0, 0, 0),
    ]
    world.run(40)
    assert "PreArm: Compass not calibrated" in caplog.text
    assert (world.bridge.state, world.vehicle.commands()) == ("ground", [])
    world.vehicle.extra = [mavlink.MAVLink_sys_status_message(bit, bit, bit, 0, 0, -1, -1, 0, 0, 0, 0, 0, 0)]
    world.until("cruise")
