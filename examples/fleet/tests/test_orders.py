"""What UAVs are told in the field: by acknowledgement only, nothing unsafe, and the same after a restart."""

import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from reporting import START, read_json
from test_fleet import LLANBEDR, SEEN, scenario_of

from damian import keys
from damian.baselines.script import script_policy
from damian.common.errors import InputError
from damian.field.node import Node, for_uavs
from damian.field.playback import episodes_of
from damian.field.rows import validated
from damian.world.config import ActionConfig, BatteryConfig, MotionConfig
from damian_fleet.answers import Acknowledgement
from damian_fleet.fleet import Fleet
from damian_fleet.journal import Change, Command
from damian_fleet.known import UavLog
from damian_fleet.rules import FieldRules
from damian_fleet.session import SNAPSHOT, AdviceSession

FLIGHTS = MotionConfig(kind="polynomial", max_speed=20.0, max_acceleration=10.0)
EAST, WEST = 0, 1
ACTIONS = ActionConfig(distances=[60.0], headings=[90.0, -90.0])
SCENARIO = scenario_of(region=LLANBEDR, observation=replace(SEEN, age=False), motion=FLIGHTS, actions=ACTIONS)


class Field:
    """A session with a fleet, whose policy sends UAV ``i`` by ``wishes[i]``."""

    def __init__(
        self, folder: Path | None, uavs="AB", scenario=SCENARIO, policy_of=None, **rules: Any
    ) -> None:
        self.wishes, self.nodes, self.now = [EAST] * 4, {}, START
        self.scenario, self.policy_of, self.folder = scenario, policy_of, folder
        self.rules = FieldRules(**rules)
        self.session = self.open()
        self.session.create("north", [*uavs])

    def open(self) -> AdviceSession:
        return AdviceSession(self.make, self.folder, {"policy": "script"})

    def parts(self, n: int):
        if n not in self.nodes:
            node = Node(for_uavs(self.scenario, n))
            self.nodes[n] = node, self.policy_of(node.env) if self.policy_of else self.wish
        return self.nodes[n]

    def make(self, uavs: list[str], mark: str) -> Fleet:
        node, policy = self.parts(len(uavs))
        return Fleet(node, uavs, policy, rules=self.rules, parts=self.parts, mark=mark)

    def wish(self, read):
        n = read[keys.ACTION_MASK].shape[1]
        return read.set(keys.ACTION, torch.tensor([self.wishes[:n]]))

    @property
    def fleet(self) -> Fleet:
        return self.session.fleet("north")

    def report(self, uav: str, point: int, **said: Any) -> list[str]:
        lat, lon = self.fleet.ground.place(point)
        row = {"ID": uav, "time": self.now, "lat": lat, "lon": lon, "battery": 90.0} | said
        return self.session.report("north", read_json(row), self.now)

    def ask(self, uav: str, after: float = 0.0):
        self.now += after
        return self.session.advise("north", self.now, [uav], only=True)[0]

    def say(self, uav: str, answer: str | None, status: str, after: float = 0.0) -> str:
        self.now += after
        row = Acknowledgement(**{"id": uav, "answer": answer or "", "status": status})
        return self.session.acknowledge("north", [row], self.now)[0]

    def command(self, command: str, uavs: list[str] | None) -> list[str]:
        said = validated(Command, {"command": command, "uavs": uavs})
        return self.session.command("north", said, self.now)

    def change(self, join: list[str], leave: list[str]) -> list[str]:
        return self.session.change_members("north", Change(join=join, leave=leave), self.now)

    def booked(self, uav: str) -> int:
        return self.fleet._standing(self.fleet.number[uav], False)


def east_of(field: Field, point: int) -> int:
    """Where the policy sends a UAV from a landing point."""
    return int(field.fleet.node.simulation.candidates.goals()[0, point, EAST])


@pytest.fixture
def field(tmp_path):
    made = Field(tmp_path)
    for uav, point in (("A", 200), ("B", 300)):
        made.report(uav, point)
    return made


def test_an_answer_that_got_lost_moves_nobody_and_is_given_again_while_it_holds(field):
    first = field.ask("A", 1)
    assert (first.state, first.reason, first.altitude) == ("fly", None, 20.0)
    assert field.ask("A", 5) == first.model_copy(update={"age": 6.0})
    assert field.booked("A") == 200
    later = field.ask("A", 6)
    assert (later.answer != first.answer, later.distance) == (True, first.distance), "from where it stands"
    assert field.say("A", first.answer, "accepted") == "lapsed"
    assert field.booked("A") == 200
    assert field.say("A", later.answer, "accepted") == "accepted"
    assert field.booked("A") == east_of(field, 200) != 200
    assert field.ask("A", 20).model_dump(exclude={"age", "until", "state"}) == later.model_dump(
        exclude={"age", "until", "state"}
    ), "on its way"


STORIES = [
    (["accepted", "accepted", "taken off", "landed"], "landed", True),
    (["refused", "accepted", "landed"], "refused", False),
    (["taken off", "accepted"], "taken off", True),
    (["landed", "taken off", "refused"], "landed", True),
    (["accepted", "aborted", "landed", "taken off"], "aborted", False),
    (["aborted"], "offered", False),
]


@pytest.mark.parametrize(("said", "status", "moved"), STORIES)
def test_an_order_goes_only_forward_whatever_is_said(field, said, status, moved):
    answer = field.ask("A", 1).answer
    for word in said:
        found = field.say("A", answer, word, 1)
    assert found == status
    assert (field.booked("A") != 200) == moved
    assert field.say("B", answer, "accepted") == "unknown", "it is not an answer to B"
    with pytest.raises(InputError, match="ID: 'C' is not a UAV of this fleet"):
        field.say("C", answer, "accepted")


def test_whoever_has_landed_or_reports_to_be_there_chooses_again(field):
    field.now += 1
    field.report("A", int(field.fleet.node.simulation.candidates.goals()[0, 200, WEST]))
    for says_so in (True, False):
        answer, here = field.ask("A", 1), field.booked("A")
        field.say("A", answer.answer, "accepted")
        field.now += 1
        field.report("A", here)
        assert field.ask("A", answer.duration).state == "bound", "it had not taken off when it reported"
        if says_so:
            assert field.say("A", answer.answer, "landed") == "landed"
            assert field.ask("A").state == "fly", "a new answer"
            assert field.ask("A").answer != answer.answer
        else:
            field.report("A", east_of(field, here))
        assert field.booked("A") == east_of(field, here)
        field.wishes[0] = WEST
        again = field.ask("A", 1)
        assert (again.state, again.reason) == ("fly", None)
        field.now, field.wishes[0] = field.now + 10, EAST
        if says_so:
            field.report("A", int(field.fleet.node.simulation.candidates.goals()[0, 200, WEST]))


def test_after_an_abort_a_uav_holds_until_it_has_reported_where_it_is(field):
    answer = field.ask("A", 1)
    field.say("A", answer.answer, "accepted")
    field.say("A", answer.answer, "aborted", 5)
    assert (field.ask("A", 1).state, field.ask("A").reason) == ("hold", "aborted")
    assert field.ask("A").lat is None, "nobody knows where"
    field.now += 1
    field.report("A", 205)
    assert field.ask("A", 1).state == "fly"


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
    assert (field.ask("B").state, field.ask("B").reason) == ("hold", "conflict"), "it is offered to A"
    assert field.say("A", offered.answer, "accepted", 5) == "accepted"
    assert {goal, here} <= field.fleet._booked(0), "A may not have taken off yet"
    assert field.ask("B", 1).reason == "conflict"
    field.say("A", offered.answer, "taken off")
    assert field.fleet._booked(0) == {goal}


@pytest.mark.parametrize(("highest", "state"), [(20.0, "hold"), (25.0, "fly")])
def test_paths_that_cross_at_the_same_level_are_not_flown(tmp_path, highest, state):
    crossing = replace(SCENARIO, actions=ActionConfig(distances=[120.0], headings=[90.0, 0.0]))
    field = Field(tmp_path, scenario=crossing, highest_level=highest)
    points = field.fleet.ground.points
    middle = points.mean(0)
    for uav, off in (("A", (-60.0, 0.0)), ("B", (0.0, -60.0))):
        field.report(uav, int(((points - middle - off) ** 2).sum(1).argmin()))
    field.wishes = [EAST, WEST]
    assert field.ask("A", 1).state == "fly"
    second = field.ask("B")
    assert (second.state, second.reason) == (state, "conflict" if state == "hold" else None)


def test_a_uav_below_its_reserve_never_flies_on(field):
    for level in (2.0, 19.9, None):
        field.now += 11
        answer = field.ask("A")
        field.say("A", answer.answer, "accepted")
        field.report("B", 300, battery=level)
        field.report("A", 200 if answer.state == "hold" else east_of(field, 200), battery=2.0)
        assert [(each.state, each.reason) for each in (field.ask("A"), field.ask("B"))] == [
            ("hold", "battery")
        ] * 2
        assert field.ask("A").answer == field.ask("A", 5).answer, "one answer while it holds"
    field.now += 11
    field.report("B", 300, battery=20.0)
    answer = field.ask("B", 0.1)
    assert answer.state == "fly"
    field.now += 0.1
    field.report("B", 300, battery=19.0)
    assert field.say("B", answer.answer, "accepted") == "lapsed", "an answer from before"


def test_a_battery_that_was_never_reported_is_not_full(tmp_path):
    for reserve, state in ((20.0, "hold"), (0.0, "fly")):
        field = Field(tmp_path / str(reserve), uavs="A", reserve=reserve)
        field.report("A", 200, battery=None)
        assert field.ask("A", 1).state == state


def test_a_uav_returns_on_its_reserve_if_it_reaches_home_and_no_flight_ends_below_it(tmp_path):
    energy = replace(SCENARIO, battery=BatteryConfig(enabled=True, capacity_kwh=0.02))
    field = Field(tmp_path, uavs="A", scenario=energy, reserve=40.0)
    field.report("A", 200)
    drain = field.fleet._flight(0, 200, east_of(field, 200))[1]
    assert 5 < drain < 35
    field.report("A", 200, battery=40.0 + drain / 2, time=START + 0.5)
    assert (field.ask("A", 1).state, field.ask("A").reason) == ("hold", "battery"), (
        "the flight would end below"
    )
    there = east_of(field, 200)
    for level, told in ((drain + 1, ("return", "battery")), (drain - 1, ("hold", "battery"))):
        field.now += 11
        field.report("A", there, battery=level)
        answer = field.ask("A")
        assert (answer.state, answer.reason) == told
        assert (answer.lat is None) == (told[0] == "hold")
    field.now += 11
    field.report("A", there, battery=drain + 1)
    assert (answer := field.ask("A")).state == "return"
    assert [field.say("A", answer.answer, each) for each in ("accepted", "taken off")][-1] == "taken off"
    field.now += 0.1
    field.report("A", there, battery=drain + 1, FLA=5.0)
    newest = field.fleet.logs[0].newest
    assert (newest.point, newest.target) == (there, 200), "of this flight, though it began in the same step"
    assert field.ask("A", 1).state == "bound", "it has taken off for home, and is not told to hold"
    field.command("hold", ["A"])
    assert field.ask("A", 11).state == "hold", "a person wants it so"


def test_a_silent_uav_holds_but_in_flight_it_may_be_silent(field):
    answer = field.ask("A", 59)
    assert answer.state == "fly"
    field.say("A", answer.answer, "accepted")
    assert [field.ask("A", after).state for after in (2, answer.duration)] == ["bound", "bound"]
    assert (field.ask("A", 70).state, field.ask("A").reason) == ("hold", "silent"), "it should have landed"
    assert (field.ask("B").state, field.ask("B").reason) == ("hold", "silent")
    field.report("B", 300)
    assert field.ask("B").state == "fly", "it is heard again"


def test_a_flight_that_is_long_over_without_a_word_ends_in_a_hold(tmp_path):
    field = Field(tmp_path, uavs="A", oldest_report=1000.0)
    field.report("A", 200)
    answer = field.ask("A", 1)
    field.say("A", answer.answer, "accepted")
    assert field.ask("A", 2 * answer.duration + 59).state == "bound"
    assert (field.ask("A", 3).state, field.ask("A").reason) == ("hold", "lost")
    field.report("A", 205)
    assert field.ask("A").state == "fly"


def test_a_report_from_before_all_that_is_kept_changes_nothing(field):
    for _ in range(40):
        field.now += 5
        field.report("A", 200, battery=None)
    kept = len(field.fleet.logs[0].reports)
    assert 16 <= kept < 20
    assert field.report("A", 300, time=START + 1, battery=5.0) == ["old"]
    assert field.report("A", 205, time=field.now - 12, battery=None) == ["late"]
    assert field.fleet.logs[0].newest.battery == 90.0


def test_a_person_holds_resumes_and_returns_uavs(field):
    before = field.ask("A", 1)
    assert field.command("hold", None) == ["A", "B"]
    assert field.say("A", before.answer, "accepted") == "lapsed", "the hold came first"
    assert [(field.ask(uav).state, field.ask(uav).reason) for uav in "AB"] == [("hold", "held")] * 2
    field.command("resume", ["A"])
    answer = field.ask("A", 1)
    assert (answer.state, field.ask("B").state) == ("fly", "hold")
    field.say("A", answer.answer, "accepted")
    field.command("return", ["A"])
    recalled = field.ask("A", 2)
    home = field.fleet.ground.place(200)
    assert (recalled.state, (recalled.lat, recalled.lon), recalled.heading) == ("return", home, None)
    field.say("A", answer.answer, "landed", 30)
    field.report("A", east_of(field, 200))
    back = field.ask("A", 11)
    assert (back.state, back.reason, (back.lat, back.lon)) == ("return", "returning", home)
    field.say("A", back.answer, "accepted")
    assert field.booked("A") == 200
    field.say("A", back.answer, "landed", 30)
    field.report("A", 200)
    assert (field.ask("A", 1).state, field.ask("A").reason) == ("hold", "home")
    with pytest.raises(InputError, match="command: 'dance': Input should be 'hold', 'resume' or 'return'"):
        field.command("dance", None)


def test_uavs_join_with_their_first_reports_and_leave(field):
    levels = {}
    answer = field.ask("B", 1)
    field.say("B", answer.answer, "accepted")
    assert field.change(["C"], []) == ["A", "B"]
    assert field.ask("A").state == "fly", "nobody waits for C"
    levels = dict(zip(field.fleet.uavs, field.fleet.levels, strict=True))
    assert field.report("C", 100) == ["new"]
    assert field.fleet.uavs == ["A", "B", "C"]
    assert (field.ask("C", 1).state, field.ask("C").altitude) == ("fly", 30.0)
    assert field.change([], ["A"]) == ["B", "C"]
    assert field.booked("B") == east_of(field, 300), "it is still on its way"
    assert (field.ask("B").state, field.fleet.levels) == ("bound", [levels["B"], 30.0])
    for join, leave, problem in (
        (["B"], [], "join: B belongs to the fleet"),
        ([], ["X"], "leave: 'X' is not a UAV of this fleet"),
        ([], ["B", "C"], "uavs: a fleet has 1 to 100 UAVs"),
    ):
        with pytest.raises(InputError, match=problem):
            field.change(join, leave)
    with pytest.raises(InputError, match="ID: 'A' is not a UAV"):
        field.report("A", 200)


def same(one: Any, other: Any) -> bool:
    """Whether two stored states are equal, bit for bit."""
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, dict):
        keys_of = one.keys() - {"ground"}
        return keys_of == other.keys() - {"ground"} and all(same(one[key], other[key]) for key in keys_of)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return same(vars(one), vars(other)) if isinstance(one, UavLog) else one == other


@pytest.mark.parametrize("seed", range(12))
def test_whatever_happens_nothing_is_unsafe_and_a_restart_remembers_it_all(tmp_path, seed, caplog):
    """Reports and answers get lost or come late, clocks stand still, people hold and send home."""
    draw = random.Random(seed)
    few_levels = {"highest_level": 20.0} if seed % 2 else {}
    field = Field(tmp_path, uavs="ABC", policy_of=script_policy, **few_levels)
    given: list[tuple[str, str]] = []
    for uav, point in zip("ABC", (100, 200, 300), strict=True):
        field.report(uav, point)
    for turn in range(120):
        field.now += draw.choice([0.0, 0.3, 1.0, 4.0, 30.0 if turn % 20 == 0 else 2.0])
        uavs = field.fleet.uavs
        uav, kind = draw.choice(uavs), draw.random()
        if kind < 0.35:
            point = field.booked(uav) if draw.random() < 0.8 else draw.randrange(400)
            battery = draw.choice([90.0, 90.0, 90.0, 10.0])
            late, flies = draw.choice([0.0, 0.0, 2.5]), draw.choice([0.0, 0.0, 20.0])
            field.report(uav, point, battery=battery, time=field.now - late, fla=flies)
        elif kind < 0.65:
            for each in field.session.advise("north", field.now, draw.choice([None, [uav]])):
                number = field.fleet.number[each.ID]
                danger = field.fleet.danger(number)
                assert each.state != "fly" or danger is None
                assert each.state != "bound" or danger in (None, "returning", "battery"), danger
                given += [(each.ID, each.answer)] if each.answer else []
        elif kind < 0.92 and given:
            said = draw.choice(["accepted", "accepted", "taken off", "landed", "refused", "aborted"])
            sender, answer = draw.choice(given[-6:])
            if sender in uavs:
                field.say(sender, answer, said)
        elif kind < 0.97:
            command = draw.choice(["hold", "resume", "resume", "return"])
            field.command(command, draw.choice([None, [uav]]))
        elif "D" in uavs:
            field.change([], ["D"])
        elif "D" not in field.fleet.joining:
            field.change(["D"], [])
        else:
            field.report("D", draw.randrange(400))
        check_apart(field.fleet)
        if turn in (40, 80):
            field.session._save("north")
    field.fleet.advance(field.now)
    state, names = field.fleet.state(), {path.name for path in tmp_path.iterdir()}
    assert {"north.jsonl", f"north{SNAPSHOT}"} <= names
    field.session._unsaved.clear()  # as if it was killed
    field.session.close()
    for turn in range(2):  # from the snapshot, and from the whole journal
        field.session = field.open()
        field.fleet.advance(field.now)
        assert same(field.fleet.state(), state)
        field.session._unsaved.clear()
        field.session.close()
        assert ("it is not read" in caplog.text) == (turn == 1), "the snapshot is used, if it is good"
        (tmp_path / f"north{SNAPSHOT}").write_bytes(b"damaged")
    for episode in episodes_of(tmp_path / "north.jsonl", lambda n: field.parts(n)[0], {}):
        assert episode.names in ([*"ABC"], [*"ABCD"])
        assert len({*map(len, (episode.believed, episode.age, episode.reward, episode.true))}) == 1


def check_apart(fleet: Fleet) -> None:
    """No two UAVs have been offered the same landing point, and none one that is booked for another."""
    for uav in range(len(fleet.uavs)):
        offer = fleet.offer(uav)
        if offer is None or not offer.is_live(fleet.clock) or not offer.moves or offer.time < fleet.clock:
            continue
        for other in fleet._others(uav):
            assert offer.goal not in fleet._booked(other), (fleet.uavs[uav], fleet.uavs[other])
