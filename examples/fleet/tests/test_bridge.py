"""The bridge in virtual time, against the copter model and a scripted service."""

import random

import pytest
import scripted
from scripted import BEGIN, GOAL, HOME, Vehicle, World

from damian_fleet.bridge import Answer, Bridge
from damian_fleet.reports import Report, validated
from damian_fleet.vehicles import BRAKE, GUIDED, LAND, LOITER, RTL, mavlink

FLIGHT = ["ground", "accept", "guided", "arm", "climb", "cruise", "landing"]
TOLD = ["accepted", "taken off", "landed"]
SET_MODE = 176
ARM = 400
TAKEOFF = 22
REPOSITION = 192
SPEED = 178
TO_LAND = 21
REFUSED = 4
TEMPORARILY = 1


def test_it_reports_asks_accepts_flies_lands_and_reports_again():
    world = World()
    world.vehicle.battery = [95.0, 40.0]
    world.until("cruise").run(3)
    assert world.vehicle.speed == 5.0, "that of the answer"
    assert world.until_said("x-2", "landed")
    assert world.vehicle.commands()[:6] == [SET_MODE, ARM, TAKEOFF, REPOSITION, SPEED, TO_LAND]
    assert world.states[: 2 + 2 * len(FLIGHT)] == ["connect", "join", *FLIGHT, *FLIGHT]
    assert world.service.facts == [(f"x-{n}", fact) for n in (1, 2) for fact in TOLD]
    world.run(5)
    reports = world.service.reports
    assert [row["number"] - reports[0]["number"] for row in reports] == [*range(len(reports))]
    assert {row["battery"] for row in reports} == {40}, "the lowest of its batteries"
    assert [row["on ground"] for row in reports[:3]] == [1, 0, 1]
    log = world.service.log
    assert log.index("POST reports") < log.index("POST advice") < log.index("POST acknowledgements")
    assert all(row["came"] - 1 < row["time"] <= row["came"] for row in reports)
    newest = reports[-1]
    assert (len(newest["landed"]), newest["motions"]) == (3, 2)
    assert newest["landed"] == sorted(newest["landed"], reverse=True)
    assert newest["previous"][0] == pytest.approx(GOAL, abs=2e-5)


LASTS = {"guided": {SET_MODE: TEMPORARILY}, "arm": {ARM: TEMPORARILY}}
"""Results by which a state lasts."""


def missing(_, answer):
    """No link to the service."""
    return Answer(None, None, answer.number)


def unconfirmed(request, answer):
    """No answer to what is accepted."""
    return missing(request, answer) if request.path.endswith("acknowledgements") else answer


def in_state(state: str) -> World:
    """A world in a state that lasts."""
    world = World()
    world.vehicle.results = LASTS.get(state, {})
    world.service.command = "hold" if state == "ground" else ""
    world.service.bad = {"join": missing, "accept": unconfirmed}.get(state, world.service.bad)
    world.until(state).run(1.5)
    assert world.bridge.state == state
    return world


def watches(world: World) -> bool:
    """Whether the bridge gives the vehicle to the pilot, and commands nothing before that, nor
    afterwards."""
    before = len(world.vehicle.commands())
    world.until("watch").heal().run(60)
    return len(world.vehicle.commands()) == before and world.bridge.state == "watch"


def go_to(vehicle: Vehicle, place=(HOME[0], HOME[1] + 0.001)) -> None:
    """Another station sends it somewhere."""
    x, y = (round(each * 1e7) for each in place)
    message = mavlink.MAVLink_command_int_message(1, 1, 6, REPOSITION, 0, 0, -1, 0, 0, 0, x, y, 5.0)
    message.pack(mavlink.MAVLink(None, 255, 190))
    vehicle.receive(message)
    vehicle.orders.pop()


ACTS = {
    "land": lambda vehicle: vehicle.change_mode(LAND),
    "loiter": lambda vehicle: vehicle.change_mode(LOITER),
    "rtl": lambda vehicle: vehicle.change_mode(RTL),
    "motors": Vehicle.switch_motors,
    "restart": lambda vehicle: vehicle.reboot(vehicle.now),
    "failsafe": lambda vehicle: vehicle.failsafe.add("battery"),
}
SEEN = [(state, act) for state in ["join", *FLIGHT] for act in ACTS]
SEEN = [
    each
    for each in SEEN
    if each[1] != "failsafe" or each[0] in ("join", "ground", "accept", "guided")
]


@pytest.mark.parametrize(("state", "act"), [each for each in SEEN if each != ("arm", "motors")])
def test_after_an_act_of_somebody_else_it_commands_nothing(state, act):
    world = in_state(state)
    ACTS[act](world.vehicle)
    world.run(1.25)  # until it is heard
    assert watches(world)


@pytest.mark.parametrize("state", ["climb", "cruise"])
def test_another_station_may_send_it_elsewhere(state):
    world = in_state("arm")
    world.heal().until("climb" if state == "climb" else "cruise").run(2)
    assert (world.bridge.state, world.vehicle.landed) == (state, False)
    go_to(world.vehicle)
    world.run(0.75)
    assert watches(world)
    assert abs(world.vehicle.place - world.vehicle.metres(HOME[0], HOME[1] + 0.001)) < 1


def test_a_mode_of_another_station_in_the_climb_is_the_pilots():
    world = in_state("arm").heal().until("climb")
    assert world.run(10, lambda: world.bridge.in_air)
    world.vehicle.enter(LOITER)
    world.run(0.5)
    before = len(world.vehicle.commands())
    assert world.run(1, lambda: world.bridge.state == "watch")
    assert watches(world)
    assert len(world.vehicle.commands()) == before


@pytest.mark.parametrize(
    "is_lost", [False, True], ids=["before its command", "whose own command got lost"]
)
def test_a_landing_that_may_be_of_somebody_else_is_the_pilots(is_lost):
    world = in_state("cruise")
    world.vehicle.switch = None  # no receiver: nobody sees a switch
    if is_lost:
        world.vehicle.results = {TO_LAND: TEMPORARILY}
        world.until("landing")
        assert world.run(3, lambda: world.vehicle.commands(TO_LAND))
    else:
        world.run(2)
        world.vehicle.mute = ("HEARTBEAT",)
        world.run(2.5)
        world.service.command = "hold"
        assert world.run(2, lambda: world.bridge.state == "landing")
        world.vehicle.mute = ()
    world.vehicle.enter(LAND)
    before = len(world.vehicle.commands(ARM, SET_MODE))
    assert is_lost or world.run(1.5, lambda: world.bridge.state == "watch"), "at once"
    world.until("watch").run(60)
    assert len(world.vehicle.commands(ARM, SET_MODE)) == before


@pytest.mark.parametrize("command", [SET_MODE, ARM, TAKEOFF, REPOSITION, TO_LAND])
def test_nothing_is_sent_again_until_mode_and_motors_are_heard_then_it_watches(command):
    world = World()
    world.vehicle.results = {command: TEMPORARILY}
    assert world.run(90, lambda: world.vehicle.commands(command))
    before = len(world.vehicle.commands())
    world.vehicle.mute = ("HEARTBEAT",)
    world.run(4.5)
    assert (len(world.vehicle.commands()), world.bridge.state == "watch") == (before, False)
    world.run(3)
    assert (len(world.vehicle.commands()), world.bridge.state) == (before, "watch")


def test_nothing_is_commanded_by_a_mode_that_is_old():
    world = in_state("cruise")
    world.run(3)
    world.vehicle.mute = ("HEARTBEAT",)
    world.run(2.5)
    world.service.command = "hold"
    before = len(world.vehicle.commands())
    assert world.run(2, lambda: world.bridge.state == "landing")
    world.run(0.5)
    assert len(world.vehicle.commands()) == before
    world.vehicle.mute = ()
    world.run(2)
    assert world.vehicle.commands()[before:] == [TO_LAND]


@pytest.mark.parametrize("cause", ["watches", "hears nothing"])
def test_a_copter_that_nobody_commands_is_landed_by_its_failsafe(cause):
    world = in_state("cruise")
    world.vehicle.station = 255
    world.run(3)
    if cause == "watches":
        world.bridge._hands_off("a mistake")
    else:
        world.vehicle.silent = True
    said = []
    world.others = lambda _: (
        said.extend(m.text for m in world._out if m.get_type() == "STATUSTEXT") or []
    )
    assert world.run(60, lambda: world.vehicle.mode == LAND)
    assert any("nobody commands it" in text for text in said)
    world.run(60)
    assert world.vehicle.landed


@pytest.mark.parametrize("mode", [LOITER, BRAKE])
def test_a_pilot_who_flies_keeps_it_whoever_watches(mode):
    world = in_state("cruise")
    world.vehicle.station = 255
    world.vehicle.change_mode(mode)
    world.until("watch").run(90)
    assert (world.vehicle.mode, world.vehicle.landed) == (mode, False)


def test_messages_up_to_five_seconds_late_are_no_boot_and_no_act():
    """At 50 messages a second, out of order."""
    draw = random.Random(5)
    world = in_state("cruise")
    under_way = []
    heard = world.vehicle.step

    def late(now, messages):
        sent = heard(now, messages)
        world.vehicle.mav.seq = (world.vehicle.mav.seq + 9) % 256
        under_way.extend((now + draw.uniform(0, 5), each) for each in sent)
        due = [each for at, each in sorted(under_way, key=lambda each: each[0]) if at <= now]
        under_way[:] = [each for each in under_way if each[0] > now]
        return due

    world.vehicle.step = late
    world.vehicle.station = 255
    assert world.run(120, lambda: world.vehicle.landed), "by its bridge, or else by its failsafe"
    assert (world.bridge.order.boots, "not heard" in world.bridge.why) == (0, True)
    world.vehicle.reboot(world.now)
    assert world.run(40, lambda: world.bridge.order.boots == 1)


def test_while_the_clock_of_the_vehicle_is_not_known_all_that_it_says_may_be_late():
    world = in_state("cruise")
    world.vehicle.mute = ("TIMESYNC",)
    world.start_again().run(4)
    assert world.bridge.state == "connect", "all that it has heard may be late"
    world.run(3)
    assert world.bridge.state == "cruise", "by its messages alone, after so long"


def test_another_bridge_has_it_and_both_say_so(caplog):
    caplog.set_level("INFO")
    world = in_state("ground")
    world.service.bad = lambda request, answer: (
        answer._replace(status=409, body={"error": "bridge: 1 speaks for UAV A"})
        if request.method == "POST"
        else answer
    )
    world.run(40)
    assert "the service says bridge: 1 speaks for UAV A" in caplog.text
    assert world.vehicle.commands() == []
    world.service.bad = lambda request, answer: answer._replace(
        body={**answer.body, "warning": "2 has tried"}
    )
    world.run(10)
    assert "the service warns: 2 has tried" in caplog.text


def test_it_reports_nothing_before_it_knows_which_vehicle_it_is_unless_that_cannot_tell():
    world = World()
    world.vehicle.mute = ("AUTOPILOT_VERSION",)
    world.run(30)
    assert (world.bridge.state, world.service.reports) == ("connect", [])
    world.vehicle.results = {mavlink.MAV_CMD_REQUEST_MESSAGE: 3}  # unsupported
    world.until("cruise")
    assert world.service.reports[-1]["vehicle"] is None
    world = World().until("cruise")
    assert (
        int.from_bytes(bytes.fromhex(world.service.reports[-1]["vehicle"]), "little")
        == world.vehicle.board
    )


def test_it_flies_beyond_2038(monkeypatch):
    monkeypatch.setattr(scripted, "BEGIN", 2.2e9)
    world = World()
    assert world.until_said("x-1", "landed")
    for row in world.service.reports:
        row.pop("came")
        validated(Report, row)


@pytest.mark.parametrize("act", ["loiter", "motors"])
@pytest.mark.parametrize("state", ["ground", "guided", "climb", "cruise", "landing"])
def test_what_somebody_does_while_it_is_off_counts(state, act):
    world = in_state(state)
    ACTS[act](world.vehicle)
    assert watches(world.start_again())


def test_without_a_memory_a_flight_is_left_to_the_pilot():
    world = in_state("cruise")
    world.bridge = Bridge("A", "north")
    assert watches(world)


@pytest.mark.parametrize(
    ("command", "state"), [(SET_MODE, "guided"), (ARM, "arm"), (TAKEOFF, "climb")]
)
def test_what_is_refused_before_the_flight_gives_the_vehicle_back(command, state):
    world = World()
    world.vehicle.results = {command: REFUSED}
    world.until(state).run(2)
    assert watches(world)
    assert world.vehicle.commands(command) == [command]


def test_the_pilot_hands_over_by_guided_on_the_ground_with_motors_off():
    world = in_state("cruise")
    vehicle = world.vehicle
    vehicle.change_mode(LOITER)
    world.until("watch").run(12)
    before = len(vehicle.commands())
    for mode in (GUIDED, LAND):  # in flight it is no handing over
        vehicle.change_mode(mode)
        world.run(30)
    assert (vehicle.landed, world.bridge.state, len(vehicle.commands())) == (True, "watch", before)
    assert world.service.reports[-1]["on ground"], "where it stands now"
    vehicle.change_mode(GUIDED)
    n_reports = len(world.service.reports)
    world.until("accept")
    assert len(world.service.reports) > n_reports
    assert world.until_said("x-2", "landed")


def test_a_command_that_comes_late_is_no_handing_over():
    world = in_state("guided")
    world.vehicle.change_mode(LOITER)
    world.until("watch").run(2)
    world.vehicle.change_mode(GUIDED)
    world.run(40)
    assert (world.bridge.state, world.vehicle.commands(ARM)) == ("watch", [])


def test_it_commands_its_own_vehicle_alone():
    world = World()
    other = Vehicle(2)
    other.change_mode(LOITER)
    world.others = other.step
    assert world.until_said("x-1", "landed")
    assert {each.target_system for each in world.vehicle.orders} == {1}


@pytest.mark.parametrize(
    ("kind", "name"), [((2, 12), "AUTOPILOT_PX4"), ((1, 3), "FIXED_WING"), ((6, 8), "GCS")]
)
def test_what_is_no_copter_with_ardupilot_is_refused_by_name(kind, name, caplog):
    world = World()
    world.vehicle.kind = kind
    caplog.set_level("INFO")
    world.run(40)
    assert (world.bridge.state, world.vehicle.orders) == ("connect", [])
    assert name in caplog.text


def test_acknowledgements_for_other_stations_do_not_count():
    world = World()
    world.vehicle.acknowledges_to = (255, 190)
    world.until("cruise").run(6)
    again = world.vehicle.commands(REPOSITION, SPEED)
    assert again[:2] == [REPOSITION, REPOSITION], "because nobody has acknowledged it"
    assert world.until_said("x-1", "landed")


@pytest.mark.parametrize(
    "says", [{"fix": False}, {"receiver": 1}], ids=["zeros", "said by the receiver"]
)
def test_a_position_before_the_fix_is_none_and_it_flies_afterwards(says):
    world = World(system=1)
    vars(world.vehicle).update(says)
    world.run(20)
    assert (world.bridge.state, world.service.reports) == ("connect", [])
    vars(world.vehicle).update(fix=True, receiver=None)
    assert world.until_said("x-2", "landed")
    assert max(abs(place[0] - HOME[0]) for place in world.bridge.memory.stops) < 0.01


def test_a_jump_is_no_position_until_it_lasts():
    world = in_state("ground")
    for lasting, is_taken in ((5, False), (30, True)):
        world.vehicle.glitch = 11_000.0
        world.run(lasting)
        assert (world.service.reports[-1]["lat"] > HOME[0] + 0.05) == is_taken
        world.vehicle.glitch = 0.0
        world.run(3)


NONSENSE = {"time": "x", "status": [], "advice": [{"state": "hold", "answer": []}]}
BAD = {
    "html": lambda _, answer: Answer(502, None, answer.number),
    "unreachable": missing,
    "time-out": lambda _, answer: Answer(200, {}, -1),
    "text": lambda _, answer: Answer(200, "garbage", answer.number),
    "empty": lambda _, answer: Answer(200, {}, answer.number),
    "no numbers": lambda _, answer: Answer(200, NONSENSE, answer.number),
}


@pytest.mark.parametrize("bad", BAD.values(), ids=list(BAD))
def test_an_error_of_the_service_is_a_missing_answer(bad):
    world = in_state("cruise")
    world.service.bad = bad
    assert world.run(90, lambda: world.vehicle.landed), "the flight in hand ends at its goal"
    world.run(30)
    world.service.log, healed = [], BEGIN + world.heal().now
    assert world.run(15, lambda: "POST advice" in world.service.log)
    assert world.service.reports[-1]["time"] > healed, "it reports before it asks"
    assert world.until_said("x-2", "landed")
    facts = world.service.facts
    assert facts.index(("x-1", "landed")) < facts.index(("x-2", "taken off"))


def test_the_policy_may_hold_and_that_is_a_decision():
    world = World()
    world.service.command = "hold"
    world.service.reason = None
    world.until("ground").run(10)
    n_holds = len(world.service.facts)
    assert n_holds > 2
    assert world.bridge.memory.motions == n_holds == len(world.bridge.memory.landed) - 1
    assert "accept" not in world.states


@pytest.mark.parametrize("state", ["guided", "arm", "climb", "cruise"])
def test_an_operator_is_heard_in_every_state_of_a_flight(state):
    world = in_state(state)
    world.service.command = "hold"
    world.vehicle.results = {}
    assert world.run(5, lambda: world.bridge.state == "landing")
    assert ("x-1", "aborted") not in world.service.facts, "it is in the air yet"
    world.until("ground").run(2)
    assert {("x-2", "accepted"), ("x-1", "aborted")} <= {*world.service.facts}
    world.run(30)
    assert (world.bridge.state, world.vehicle.armed) == ("ground", False)
    world.service.command = ""
    assert world.run(120, lambda: world.service.facts[-1][1] == "landed")


def test_after_a_lost_link_it_reports_before_it_asks():
    world = in_state("cruise")
    world.vehicle.speed = 0.5
    world.run(2)  # it has heard that its commands are followed
    world.vehicle.silent = world.vehicle.deaf = True
    world.run(10)
    n_sent = len(world.vehicle.orders)
    world.service.log = []
    world.run(10)
    assert ("POST advice" in world.service.log, len(world.vehicle.orders)) == (False, n_sent)
    world.vehicle.silent = world.vehicle.deaf = False
    healed = BEGIN + world.now
    assert world.run(10, lambda: "POST advice" in world.service.log)
    assert world.service.reports[-1]["time"] > healed


@pytest.mark.parametrize("has_pilot", [False, True])
def test_it_joins_a_fleet_that_flies_and_leaves_it_once_it_stands(has_pilot):
    world = World()
    world.service.members = ["B", "C"]
    world.until("cruise")
    assert world.service.members == ["B", "C", "A"]
    if has_pilot:
        world.vehicle.change_mode(LAND)
        world.until("watch")
    world.bridge.leaving = True
    world.until("left")
    told = ["accepted", "taken off", "aborted"] if has_pilot else TOLD
    assert world.service.facts == [("x-1", fact) for fact in told]
    assert world.service.members == ["B", "C"]


@pytest.mark.parametrize("state", ["guided", "arm", "climb", "cruise", "landing", "watch", "hold"])
def test_started_again_it_goes_on_as_it_was_and_tells_what_it_had_to_tell(state):
    world = in_state("cruise" if state in ("watch", "hold") else state)
    if state == "watch":
        world.vehicle.change_mode(LAND)
    elif state == "hold":
        world.service.command = "hold"
    world.run(5 if state in ("watch", "hold") else 0)
    world.service.bad = missing
    world.bridge._say_fact("x-1", "taken off")
    n_reports = len(world.service.reports)
    world.run(1)
    before = len(world.vehicle.commands())
    n_told = world.service.facts.count(("x-1", "taken off"))
    world.start_again().heal().run(60)
    assert world.service.facts.count(("x-1", "taken off")) > n_told, "nobody had confirmed it"
    world.service.command = ""
    if state in ("arm", "watch"):  # its motors may have been on, and somebody else has them off
        assert (world.bridge.state, len(world.vehicle.commands())) == ("watch", before)
    else:
        end = "landed" if state in ("climb", "cruise", "landing") else "aborted"
        assert world.until_said("x-1", end)
        assert world.run(200, lambda: world.service.facts[-1][1] == "landed")
    assert (
        world.service.reports[n_reports]["number"] == world.service.reports[0]["number"] + n_reports
    )


def test_an_older_message_on_a_longer_way_does_not_count():
    world = World().until("guided")
    old = [world.bridge.seen["HEARTBEAT"]]
    world.until("arm").run(0.5)
    assert old[0].custom_mode != GUIDED
    world.bridge.step(world.now, old)
    assert world.until_said("x-1", "landed")


@pytest.mark.parametrize(
    ("come", "facts"),
    [
        ("lapsed", []),
        ("refused", []),
        ("unknown", []),
        ("landed", []),
        ("taken off", [("x-1", "aborted")]),
    ],
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
    assert world.run(100, lambda: world.service.facts[-1][1] == "landed")


@pytest.mark.parametrize(
    ("state", "bad", "then"),
    [
        ("accept", {}, "ground"),
        ("guided", {SET_MODE: 0}, "landing"),
        ("arm", {ARM: 0}, "landing"),
        ("climb", {TAKEOFF: 0}, "watch"),  # the copter turns its motors off by itself
        ("cruise", {REPOSITION: 0}, "landing"),
        ("cruise", {REPOSITION: 2}, "landing"),
    ],
)
def test_a_state_without_its_effect_ends_at_its_limit(state, bad, then):
    world = World()
    world.vehicle.results = bad
    world.service.bad = unconfirmed if state == "accept" else world.service.bad
    world.until(state)
    assert world.run(125, lambda: world.bridge.state != state)
    assert world.bridge.state == then
    world.heal()
    assert then == "watch" or world.run(200, lambda: world.service.facts[-1][1] == "landed")


def test_motors_that_stay_on_after_the_landing_are_the_pilots():
    world = in_state("landing")
    world.vehicle.disarm = lambda *_: False
    world.run(70)
    assert world.bridge.state == "watch"


@pytest.mark.parametrize("state", ["connect", "join", "ground", "cruise", "landing", "watch"])
def test_what_waits_says_so(state, caplog):
    caplog.set_level("INFO")
    world = World() if state == "connect" else in_state("ground" if state == "watch" else state)
    if state == "watch":
        world.vehicle.change_mode(LOITER)
    world.run(2 * (state != "connect"))
    world.vehicle.silent = state in ("connect", "cruise", "landing")
    world.run(75)
    assert caplog.text.count(f"A: {state} for ") in (1, 2)


def test_what_the_vehicle_says_is_logged_and_its_own_checks_are_waited_for(caplog):
    caplog.set_level("INFO")
    world = World()
    bit = mavlink.MAV_SYS_STATUS_PREARM_CHECK
    world.vehicle.sensors = bit, 0
    world.until("ground").vehicle.text("PreArm: Compass not calibrated")
    world.run(40)
    assert "PreArm: Compass not calibrated" in caplog.text
    assert (world.bridge.state, world.vehicle.commands()) == ("ground", [])
    world.vehicle.sensors = bit, bit
    world.until("cruise")
