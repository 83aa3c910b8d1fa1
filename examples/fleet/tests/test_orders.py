"""What UAVs are told in the field: by acknowledgement only, and nothing unsafe."""

import math
from dataclasses import replace

import pytest
from field import EAST, SCENARIO, WEST, Field
from reports import START
from shapely import LineString, box

from damian.common.errors import InputError
from damian.world.config import ActionConfig, BatteryConfig
from damian.world.regions.geodesy import to_latlon
from damian_fleet.fleet import GRACE


def begun(*places: int, **changed) -> Field:
    """A field whose UAVs have reported from landing points, and whose steps last 1 s."""
    made = Field(uavs="ABC"[: len(places)], **changed)
    for uav, point in zip("ABC", places, strict=False):
        made.report(uav, point)
    return made


@pytest.fixture
def field() -> Field:
    return begun(200, 300)


def told(field: Field, uav: str, after: float = 0.0) -> tuple[str, str | None]:
    answer = field.ask(uav, after)
    return answer.state, answer.reason


def test_an_answer_that_got_lost_moves_nobody_and_is_given_again_while_it_holds(field):
    first = field.ask("A", 1)
    assert (first.state, first.reason, first.altitude) == ("fly", None, 20.0)
    assert field.ask("A", 5) == first.model_copy(update={"age": 6.0})
    assert field.booked("A") == 200
    later = field.ask("A", 6)
    assert (later.answer != first.answer, later.distance) == (True, first.distance), (
        "from where it stands"
    )
    assert field.say("A", first.answer, "accepted") == "lapsed"
    assert field.booked("A") == 200
    assert field.say("A", later.answer, "accepted") == "accepted"
    assert field.booked("A") == field.east_of(200) != 200
    bound = later.model_copy(update={"state": "bound", "age": 32.0})
    assert field.ask("A", 20) == bound, "one answer stays the same"


STORIES = [
    (["accepted", "accepted", "taken off", "landed"], "landed", True),
    (["refused", "accepted"], "refused", False),
    (["taken off", "accepted"], "taken off", True),
    (["landed", "taken off", "refused"], "landed", True),
    (["accepted", "aborted", "landed", "taken off"], "aborted", False),
    (["aborted", "accepted"], "refused", False),
]


@pytest.mark.parametrize(("said", "status", "moved"), STORIES)
def test_an_order_goes_only_forward_whatever_is_said(field, said, status, moved):
    answer = field.ask("A", 1).answer
    assert [field.say("A", answer, word, 1) for word in said][-1] == status
    assert (field.booked("A") != 200) == moved
    assert field.say("B", answer, "accepted") == "unknown", "it is not an answer to B"
    with pytest.raises(InputError, match="ID: 'C' is not a UAV of this fleet"):
        field.say("C", answer, "accepted")


@pytest.mark.parametrize("says_so", [True, False])
def test_whoever_has_landed_or_reports_to_be_there_chooses_again(field, says_so):
    answer = field.ask("A", 1)
    there = field.east_of(200)
    field.say("A", answer.answer, "accepted")
    field.now += 1
    field.report("A", 200)
    assert field.ask("A", answer.duration).state == "bound", "it had not taken off when it reported"
    if says_so:
        assert field.say("A", answer.answer, "landed") == "landed"
    else:
        field.report("A", there)
    assert field.booked("A") == there
    field.wishes[0] = WEST
    again = field.ask("A", 1)
    assert (again.state, again.reason, again.answer != answer.answer) == ("fly", None, True)


def test_after_an_abort_a_uav_holds_until_it_has_reported_where_it_stands(field):
    answer = field.ask("A", 1)
    field.say("A", answer.answer, "accepted")
    field.say("A", answer.answer, "taken off", 2)
    field.say("A", answer.answer, "aborted", 5)
    assert told(field, "A", 1) == ("hold", "aborted")
    assert field.ask("A").lat is None, "nobody knows where"
    assert told(field, "B") == ("fly", None)
    field.now += 1
    field.report("A", 205, FLA=30)
    assert told(field, "A", 1) == ("hold", "airborne"), "a pilot flies it"
    field.report("A", 205, FLA=0.03)
    assert told(field, "A", 10)[0] == "fly"


def test_nobody_is_sent_where_another_one_may_stand_or_land(field):
    leads = field.fleet.node.simulation.candidates.goals()[0].tolist()
    here, beside, goal, action = next(
        (here, beside, there[EAST], action)
        for here, there in enumerate(leads)
        for beside, others in enumerate(leads)
        for action, other in enumerate(others)
        if other == there[EAST] != here != beside != other
    )
    field.now, field.wishes[1] = START + 1, action
    field.report("A", here)
    field.report("B", beside)
    offered = field.ask("A", 1)
    assert (offered.lat, offered.lon) == field.fleet.ground.place(goal)
    assert told(field, "B") == ("hold", "conflict"), "it is offered to A"
    assert field.say("A", offered.answer, "accepted", 5) == "accepted"
    assert {goal, here} <= field.fleet.booked(field.fleet.uavs["A"]), "A may not have taken off yet"
    assert told(field, "B", 1) == ("hold", "conflict")
    field.say("A", offered.answer, "taken off")
    assert field.fleet.booked(field.fleet.uavs["A"]) == {goal}
    field.now += 2 * offered.duration + GRACE
    field.report("B", beside)
    again = field.ask("B")
    assert (again.lat, again.lon) != field.fleet.ground.place(goal), "however late A is"


@pytest.mark.parametrize(("levels", "state"), [([20.0], "hold"), ([20.0, 25.0], "fly")])
def test_paths_that_cross_at_the_same_level_are_not_flown(levels, state):
    crossing = replace(SCENARIO, actions=ActionConfig(distances=[120.0], headings=[90.0, 0.0]))
    field = Field(scenario=crossing, levels=levels)
    points = field.fleet.ground.points
    middle = points.mean(0)
    for uav, off in (("A", (-60.0, 0.0)), ("B", (0.0, -60.0))):
        field.report(uav, int(((points - middle - off) ** 2).sum(1).argmin()))
    field.wishes = [EAST, WEST]
    assert field.ask("A", 1).state == "fly"
    assert told(field, "B") == (state, "conflict" if state == "hold" else None)


@pytest.mark.parametrize(
    ("level", "reserve", "state"), [(19.9, 20.0, "hold"), (None, 20.0, "hold"), (None, 0.0, "fly")]
)
def test_a_uav_below_its_reserve_never_flies_on(level, reserve, state):
    field = Field(uavs="A", reserve=reserve)
    field.report("A", 200, battery=level)
    answer = field.ask("A", 1)
    assert (answer.state, answer.reason) == (state, "battery" if state == "hold" else None)
    assert field.ask("A", 5).answer == answer.answer, "one answer while it holds"


@pytest.mark.parametrize("what", ["battery", "place", "nothing"])
def test_an_answer_is_not_accepted_if_it_is_not_safe_any_more(field, what):
    answer = field.ask("A", 0.1)
    field.now += 0.1
    if what == "battery":
        field.report("A", 200, battery=19.0)
    elif what == "place":
        field.report("B", field.east_of(200))
    assert field.say("A", answer.answer, "accepted") == (
        "accepted" if what == "nothing" else "lapsed"
    )


def test_a_flight_begins_where_the_uav_stands_beside_its_landing_point(field):
    lat, lon = field.fleet.ground.place(200)
    field.now += 1
    field.report("A", 200, lat=lat - 10 / 111_320, lon=lon)
    east, heading = field.fleet.ground.way(200, field.east_of(200))
    told = field.ask("A", 1)
    assert told.reason is None
    assert (told.distance, heading) == (pytest.approx(math.hypot(east, 10), abs=0.1), 90.0)
    assert told.heading == pytest.approx(math.degrees(math.atan2(east, 10)), abs=0.1)


def test_a_uav_returns_on_its_reserve_if_it_reaches_home_and_no_flight_ends_below_it():
    energy = replace(SCENARIO, battery=BatteryConfig(enabled=True, capacity_kwh=0.02))
    field = begun(200, scenario=energy, reserve=40.0)
    there = field.east_of(200)
    drain = field.fleet._flight(
        field.fleet.uavs["A"], tuple(field.fleet.ground.points[200]), there
    )[1]
    assert 5 < drain < 35
    field.report("A", 200, battery=40.0 + drain / 2, time=START + 0.5)
    assert told(field, "A", 1) == ("hold", "battery"), "the flight would end below"
    for level, expected in ((drain + 1, "return"), (drain - 1, "hold")):
        field.now += 11
        field.report("A", there, battery=level)
        assert told(field, "A") == (expected, "battery")
        assert (field.ask("A").lat is None) == (expected == "hold")
    field.now += 11
    field.report("A", there, battery=drain + 1)
    answer = field.ask("A").answer
    assert [field.say("A", answer, each) for each in ("accepted", "taken off")][-1] == "taken off"
    field.now += 0.1
    field.report("A", there, battery=drain + 1, FLA=5.0)
    newest = field.fleet.tracker.logs["A"].newest
    assert (newest.point, newest.target) == (there, 200), (
        "of this flight, though it began in the same step"
    )
    assert field.ask("A", 1).state == "bound", "it has taken off for home, and is not told to hold"
    field.command("hold", ["A"])
    assert field.ask("A", 11).state == "hold", "a person wants it so"


def test_a_silent_uav_holds_but_in_flight_it_may_be_silent(field):
    answer = field.ask("A", 59)
    field.say("A", answer.answer, "accepted")
    assert [field.ask("A", after).state for after in (2, answer.duration)] == ["bound", "bound"]
    assert (told(field, "A", 70), told(field, "B")) == (("bound", None), ("hold", "silent"))
    for uav, point in (("A", 205), ("B", 300)):
        field.report(uav, point)
    assert told(field, "B")[0] == "fly", "it is heard again"
    assert field.ask("A", 11).state == "bound", "it may take off yet"
    field.now += answer.duration
    field.report("A", 205)
    assert told(field, "A")[0] == "fly", "it stands elsewhere"


@pytest.mark.parametrize("phase", [[], ["accepted"], ["accepted", "taken off"]])
def test_a_person_is_heard_in_every_phase(field, phase):
    answer = field.ask("A", 1)
    for word in phase:
        field.say("A", answer.answer, word)
    if len(phase) == 2:
        field.report("A", 200, FLA=3.0)  # it climbs
    assert field.command("hold", None) == ["A", "B"]
    if not phase:
        assert field.say("A", answer.answer, "accepted") == "lapsed", "the hold came first"
    held = field.ask("A", 1)
    assert field.say("A", held.answer, "accepted") == "landed"
    assert [told(field, uav) for uav in "AB"] == [("hold", "held")] * 2
    assert told(field, "A", 15) == ("hold", "held"), "until it is over"
    field.command("resume", None)
    assert field.ask("A", 1).state == ("bound" if phase else "fly")


def test_a_person_sends_uavs_home(field):
    answer = field.ask("A", 1)
    field.say("A", answer.answer, "accepted")
    field.command("return", ["A"])
    recalled = field.ask("A", 2)
    home = field.fleet.ground.place(200)
    assert (recalled.state, (recalled.lat, recalled.lon), recalled.heading) == (
        "return",
        home,
        None,
    )
    field.fleet.uavs["A"].home = field.east_of(200)
    assert field.ask("A", 11).state == "bound", "it is on its way home already"
    field.fleet.uavs["A"].home = 200
    field.say("A", answer.answer, "landed", 30)
    field.report("A", field.east_of(200))
    field.report("B", 200)
    beside = field.ask("A", 1)
    assert (beside.state, (beside.lat, beside.lon) != home) == ("return", True), (
        "another one stands there"
    )
    field.say("A", beside.answer, "refused")
    field.now += 11
    field.report("B", 300)
    back = field.ask("A")
    assert (back.state, back.reason, (back.lat, back.lon)) == ("return", "returning", home)
    field.say("A", back.answer, "accepted")
    assert field.booked("A") == 200
    field.say("A", back.answer, "landed", 30)
    field.report("A", 200)
    assert told(field, "A", 1) == ("hold", "returning")


def test_uavs_join_with_their_first_reports_and_leave(field):
    answer = field.ask("B", 1)
    field.say("B", answer.answer, "accepted")
    for _ in range(2):  # said twice: the first answer got lost
        assert field.change(["C"], []) == ["A", "B"]
    assert field.ask("A").state == "fly", "nobody waits for C"
    assert field.report("C", 100) == ["new"]
    assert [*field.fleet.uavs] == ["A", "B", "C"]
    assert (field.ask("C", 1).state, field.ask("C").altitude) == ("fly", 30.0)
    for _ in range(2):
        assert field.change([], ["A"]) == ["B", "C"]
    assert field.booked("B") == field.east_of(300), "it is still on its way"
    assert field.ask("B", 1).state == "bound"
    assert [uav.level for uav in field.fleet.uavs.values()] == [25.0, 30.0]
    with pytest.raises(InputError, match="uavs: a fleet has 1 to 100 UAVs"):
        field.change([], ["B", "C"])
    with pytest.raises(InputError, match="ID: 'A' is not a UAV"):
        field.report("A", 200)


def test_a_fleet_begins_when_whoever_has_not_reported_leaves():
    field = Field(uavs="ABC")
    for uav in "AB":
        field.report(uav, 200 if uav == "A" else 300)
    with pytest.raises(InputError, match="no advice yet: no report of C has come in"):
        field.ask("A")
    field.change([], ["C"])
    assert field.ask("A", 1).state == "fly"


def test_nobody_is_sent_on_a_way_that_is_not_straight():
    """The straight way to the east leads over a zone where nobody flies."""
    field = Field(uavs="A")
    points = field.fleet.ground.points
    x, y = points[200] + (points[field.east_of(200)] - points[200]) / 2
    zone = [[x - 5, y - 5], [x + 5, y - 5], [x + 5, y + 5], [x - 5, y + 5]]
    closed = replace(SCENARIO, region=replace(SCENARIO.region, zones=[zone]))
    field = Field(uavs="A", scenario=closed)
    here = int(((field.fleet.ground.points - points[200]) ** 2).sum(1).argmin())
    field.report("A", here)
    assert told(field, "A", 1) == ("hold", "detour")
    field.wishes[0] = WEST
    assert told(field, "A", 11)[0] == "fly", "it chooses again"


def holed(*uavs: str) -> tuple[Field, float, float]:
    """A field with a zone of 60 m, and the middle of that, in its own metres."""
    x, y = Field(uavs="A").fleet.ground.points[200].tolist()
    zone = [[x - 30, y - 30], [x + 30, y - 30], [x + 30, y + 30], [x - 30, y + 30]]
    closed = replace(SCENARIO, region=replace(SCENARIO.region, zones=[zone]))
    return Field(uavs=uavs or "A", scenario=closed), x, y


def stand(field: Field, x: float, y: float) -> None:
    """A reports from a place."""
    region = field.fleet.ground.region
    lat, lon = (float(each) for each in to_latlon(x, y, region.origin))
    field.now += 11
    field.report("A", 0, lat=lat, lon=lon)


@pytest.mark.parametrize(
    ("aside", "bends"),
    [(0.0, False), (-7.0, True), (-14.0, True), (5.0, False)],
    ids=["the point", "in the margin", "over the zone", "farther away"],
)
def test_a_way_is_checked_from_where_the_uav_stands_with_a_margin(aside, bends):
    """Past the upper edge of a zone, whose margin is 10 m."""
    field, x, y = holed()
    points = field.fleet.ground.points
    fleet = field.fleet
    goal = min(
        range(len(points)), key=lambda i: abs(points[i][0] - x - 90) + abs(points[i][1] - y - 41)
    )
    stand(field, x - 60, y + 41 + aside - (points[goal][1] - y - 41))
    field.ask("A")
    told = fleet._decision(fleet.uavs["A"], None, goal)
    middle = (told.start[1] + points[goal][1]) / 2 - y
    assert told.start[0] == pytest.approx(x - 60, abs=0.1)
    assert (fleet._bends(told), middle < 40) == (bends, bends)


def test_a_uav_is_led_home_around_a_zone_by_way_of_landing_points():
    field, x, y = holed()
    fleet = field.fleet
    stand(field, x + 70, y)  # its home
    stand(field, x - 70, y)
    field.command("return", ["A"])
    region = fleet.ground.region.polygon
    zone = box(x - 30, y - 30, x + 30, y + 30)
    here = (x - 70, y)
    hops = 0
    while (told := field.ask("A", 11)).state == "return":
        goal = fleet.ground.local((told.lat, told.lon))
        way = LineString([here, goal])
        assert region.covers(way)
        assert way.distance(zone) > 0
        for word in ("accepted", "taken off", "landed"):
            field.say("A", told.answer, word, 1)
        here = goal
        hops = hops + 1
        stand(field, *here)
    assert math.dist(here, (x + 70, y)) < 20
    assert hops > 1


def test_an_offer_is_not_accepted_from_where_its_way_crosses_a_zone():
    field, x, y = holed()
    stand(field, x - 70, y + 60)
    told = field.ask("A", 1)
    assert told.state == "fly"
    gx, gy = field.fleet.ground.points[field.fleet.uavs["A"].offer.goal]
    lat, lon = (
        float(each) for each in to_latlon(2 * x - gx, 2 * y - gy, field.fleet.ground.region.origin)
    )
    field.now += 1
    field.report("A", 0, lat=lat, lon=lon)
    assert field.say("A", told.answer, "accepted") == "lapsed"


def test_two_that_stand_by_one_landing_point_do_not_hold_each_other_for_ever():
    field = begun(200, 300)
    x, y = field.fleet.ground.points[200].tolist()
    for uav, off in (("A", 0.0), ("B", 14.0)):
        lat, lon = (float(each) for each in to_latlon(x, y + off, field.fleet.ground.region.origin))
        field.now += 1
        field.report(uav, 0, lat=lat, lon=lon)
    assert {field.booked(uav) for uav in "AB"} == {200}
    assert told(field, "A", 1) == ("fly", None), "away from the other one"
