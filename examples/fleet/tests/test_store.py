"""Nothing that was acknowledged is lost, no answer changes, and nothing is decided again."""

import http.client
import json
import random
import signal
import subprocess
import sys
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from field import SCENARIO, Field

from damian import keys
from damian.baselines.script import script_policy
from damian.common.errors import InputError, RunError
from damian.field.fitting import fit, read_log
from damian.field.playback import episodes_of
from damian_fleet.fleet import Fleet
from damian_fleet.store import Fleets

TOKEN = "a-token-of-the-service"
PLACE = {"A": (52.8110, -4.1283), "B": (52.8133, -4.1264)}


def known(fleet: Fleet) -> dict[str, Any]:
    """All that a fleet knows, to be compared."""
    tracker = fleet.tracker
    memories = [{name: value.tolist() for name, value in each.items()} for each in tracker.before or []]
    seen = tracker.observe()[keys.OBSERVATION].tolist() if tracker.has_begun else None
    return {
        "uavs": fleet.uavs,
        "rest": (fleet.left, {*fleet.joining}, fleet.clock, fleet.n_answers, fleet.last_arrival),
        "tracker": (tracker.step, tracker.start, tracker.held, tracker.pending, tracker.action.tolist()),
        "reports": {uav: log.reports for uav, log in tracker.logs.items()},
        "computed": (memories, seen),
    }


def check_apart(fleet: Fleet) -> None:
    """No two UAVs are bound for one landing point, and none is offered one that is booked for another."""
    bound = [uav.open_order.goal for uav in fleet.uavs.values() if uav.open_order]
    assert len({*bound}) == len(bound)
    for uav in fleet.uavs.values():
        offer = uav.offer
        if offer is not None and offer.is_live(fleet.clock) and offer.moves and offer.time == fleet.clock:
            assert all(offer.goal not in fleet.booked(other) for other in fleet._others(uav))


@pytest.mark.parametrize("seed", range(4))
def test_whatever_happens_nothing_is_unsafe_and_a_restart_remembers_it_all(tmp_path, seed):
    """Reports and answers get lost or come late, clocks stand still, people hold and send home."""
    draw = random.Random(seed)
    levels = {"highest_level": 20.0} if seed % 2 else {}
    field = Field(tmp_path / "fleets.db", "ABC", SCENARIO, script_policy, **levels)
    given: dict[str, dict[str, Any]] = {}
    for uav, point in zip("ABC", (100, 200, 300), strict=True):
        field.report(uav, point)
    for turn in range(70):
        field.now += draw.choice([0.0, 0.3, 1.0, 4.0, 30.0 if turn % 20 == 0 else 2.0])
        uavs = [*field.fleet.uavs]
        uav, kind = draw.choice(uavs), draw.random()
        if kind < 0.35:
            point = field.booked(uav) if draw.random() < 0.8 else draw.randrange(400)
            battery, flies = draw.choice([90.0, 90.0, 90.0, 10.0]), draw.choice([0.0, 0.0, 20.0])
            late = draw.choice([0.0, 0.0, 2.5])
            field.report(uav, point, battery=battery, time=field.now - late, fla=flies)
        elif kind < 0.65:
            for told in field.fleets.advise("north", draw.choice([None, [uav]]), field.now):
                danger = field.fleet.danger(field.fleet.uavs[told.ID])
                assert told.state != "fly" or danger is None
                assert told.state != "bound" or danger in (None, "returning", "battery"), danger
                if told.answer:
                    said = told.model_dump(exclude={"state", "age"})
                    assert given.setdefault(told.answer, said) == said, "an answer never changes"
        elif kind < 0.92 and given:
            word = draw.choice(["accepted", "accepted", "taken off", "landed", "refused", "aborted"])
            told = draw.choice([*given.values()][-6:])
            if told["ID"] in uavs:
                field.say(told["ID"], told["answer"], word)
        elif kind < 0.97:
            field.command(draw.choice(["hold", "resume", "resume", "return"]), draw.choice([None, [uav]]))
        elif "D" in uavs:
            field.change([], ["D"])
        elif "D" not in field.fleet.joining:
            field.change(["D"], [])
        else:
            field.report("D", draw.randrange(400))
        check_apart(field.fleet)
        if turn % 35 == 34:
            field.fleet.advance(field.now)
            before, status = known(field.fleet), field.fleets.status("north", field.now)
            field.restart()
            field.fleet.advance(field.now)
            assert known(field.fleet) == before
            assert field.fleets.status("north", field.now) == status
    path = tmp_path / "north.jsonl"
    path.write_text("\n".join([*field.fleets.journal("north"), ""]), encoding="utf-8")
    for episode in episodes_of(path, lambda n: field.parts(n)[0], {}):
        assert episode.names in ([*"ABC"], [*"ABCD"])
    assert len(fit(read_log(path))) > 10


def test_a_restart_never_decides_again(tmp_path):
    """What was answered is there, though the policy would choose something else now."""
    field = Field(tmp_path / "fleets.db")
    for uav, point in (("A", 200), ("B", 300)):
        field.report(uav, point)
    told = [field.ask("A", 1), field.ask("B")]
    field.say("A", told[0].answer, "accepted")
    field.wish = lambda _: pytest.fail("it was asked again")
    field.restart()
    assert [field.booked(uav) for uav in "AB"] == [field.east_of(200), 300]
    again = [field.ask("A"), field.ask("B")]
    assert again == [told[0].model_copy(update={"state": "bound", "age": 1.0}), told[1]]


def test_a_request_that_cannot_be_stored_changes_nothing(tmp_path):
    field = Field(tmp_path / "fleets.db")
    for uav in "AB":
        field.report(uav, 200 if uav == "A" else 300)
    (pages,) = field.fleets._base.execute("PRAGMA page_count").fetchone()
    field.fleets._base.execute(f"PRAGMA max_page_count = {pages}")  # as if the disk was full
    lat, lon = field.fleet.ground.place(200)
    many = [{"ID": "A", "time": field.now + i / 1e3, "lat": lat, "lon": lon} for i in range(900)]
    before = known(field.fleet)
    with pytest.raises(RunError, match="database: it cannot be written: database or disk is full"):
        field.send(*many)
    assert (known(field.fleet), field.fleets.problem is None) == (before, False)
    field.fleets._base.execute("PRAGMA max_page_count = 1000000")
    assert field.send(*many).count("new") == 900
    assert field.fleets.problem is None
    with pytest.raises(InputError, match="is not a name of up to 64 letters"):
        field.fleets.create("../x", ["A"])


def test_a_database_is_of_one_service_and_of_one_policy(tmp_path):
    field = Field(tmp_path / "fleets.db")
    with pytest.raises(InputError, match=r"database: .*fleets.db cannot be used: database is locked"):
        field.open()
    field.scenario = replace(SCENARIO, region=replace(SCENARIO.region, lattice_step=60.0))
    field.restart()
    with pytest.raises(RunError, match="database: fleet north is of other landing points"):
        field.fleets.fleet("north")
    field.fleets.close()
    with pytest.raises(InputError) as error:
        Fleets(field.make, field.path, {"policy": "sampled", "region": "llanbedr"})
    message = "policy: script then, sampled now; region: not given then, llanbedr now: give the same"
    assert str(error.value) == f"database: fleet north is of other settings: {message}"
    (tmp_path / "text.db").write_text("this is not a database, however long it may be", encoding="utf-8")
    with pytest.raises(InputError, match="file is not a database"):
        Fleets(field.make, tmp_path / "text.db", {})


# The program itself.


class Program:
    """The service as a process of its own, in a folder."""

    def __init__(self, folder: Path, *words: str) -> None:
        code = "from damian_fleet.program import main; main()"
        given = ["region=llanbedr", "motion=polynomial", "policy=script", f"token={TOKEN}", "port=0", *words]
        self.process = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", code, *given],
            cwd=folder,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        line = next(line for line in self.process.stdout if line.startswith("listening"))
        self.port = int(line.rpartition(":")[2])

    def ask(self, method: str, path: str, body=None) -> tuple[int, Any]:
        headers = {"Authorization": f"Bearer {TOKEN}"}
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)) as connection:
            connection.request(method, path, None if body is None else json.dumps(body), headers)
            with connection.getresponse() as answer:
                return answer.status, json.loads(answer.read() or b"{}")

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(60)
        assert self.process.stdout is not None
        self.process.stdout.close()


def row(uav: str) -> dict[str, Any]:
    return {"ID": uav, "lat": PLACE[uav][0], "lon": PLACE[uav][1], "battery": 80}


def test_nothing_that_was_acknowledged_is_lost_by_kill_under_load(tmp_path):
    told: dict[str, dict[str, Any]] = {}
    counted: dict[str, int] = {}

    def fly(name: str, program: Program, enough: threading.Semaphore) -> None:
        try:
            program.ask("PUT", f"/fleets/{name}", {"uavs": ["A", "B"]})
            program.ask("POST", f"/fleets/{name}/reports", [row("A"), row("B")])
            (answer,) = program.ask("POST", f"/fleets/{name}/advice", {"uavs": ["A"]})[1]["advice"]
            said = {"ID": "A", "answer": answer["answer"], "status": "accepted"}
            if program.ask("POST", f"/fleets/{name}/acknowledgements", said)[1] == {"status": ["accepted"]}:
                told[name] = answer
            while True:
                program.ask("POST", f"/fleets/{name}/reports", row("B"))
                counted[name] = counted.get(name, 1) + 1
                enough.release()
        except (OSError, http.client.HTTPException, ValueError):
            return  # it was killed

    for turn in range(2):
        program, enough = Program(tmp_path), threading.Semaphore(0)
        for name, answer in told.items():
            (again,) = program.ask("POST", f"/fleets/{name}/advice", {"uavs": ["A"]})[1]["advice"]
            assert again == answer | {"state": "bound", "age": again["age"]}
            uavs = program.ask("GET", f"/fleets/{name}")[1]["uavs"]
            assert (uavs[0]["order"], uavs[1]["reports"] >= counted[name]) == ("accepted", True)
        if turn == 0:
            threads = [threading.Thread(target=fly, args=(f"f{i}", program, enough)) for i in range(3)]
            for each in threads:
                each.start()
            assert all(enough.acquire(timeout=60) for _ in range(40))
        program.kill()
    assert len(told) == 3
