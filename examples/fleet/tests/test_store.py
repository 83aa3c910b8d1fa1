"""Nothing that was acknowledged is lost, no answer changes, and nothing is decided again."""

import contextlib
import random
import subprocess
import sys
import threading
from dataclasses import replace
from typing import Any

import httpx2
import pytest
from field import SCENARIO, Field

from damian import keys
from damian.baselines.script import script_policy
from damian.common.errors import InputError, RunError
from damian.delays.clocks import in_order
from damian.delays.logs import delays_of, read_log
from damian_fleet.fleet import Fleet, Held
from damian_fleet.playback import episodes_of
from damian_fleet.store import Fleets

TOKEN = "a-token-of-the-service"
PLACE = {"A": (52.8110, -4.1283), "B": (52.8133, -4.1264)}


def known(fleet: Fleet) -> dict[str, Any]:
    """All that a fleet knows, to be compared."""
    tracker = fleet.tracker
    memories = [
        {name: value.tolist() for name, value in each.items()} for each in tracker.before or []
    ]
    seen = tracker.observe()[keys.OBSERVATION].tolist() if tracker.has_begun else None
    return {
        "uavs": fleet.uavs,
        "rest": ({*fleet.joining}, fleet.clock, fleet.n_answers),
        "tracker": (
            tracker.step,
            tracker.start,
            tracker.held,
            tracker.pending,
            tracker.action.tolist(),
        ),
        "reports": {uav: log.reports for uav, log in tracker.logs.items()},
        "computed": (memories, seen),
    }


@pytest.mark.parametrize("seed", range(4))
def test_whatever_happens_a_restart_remembers_it_all(tmp_path, seed):
    """Reports and answers get lost or come late, clocks stand still, people hold and send home."""
    draw = random.Random(seed)
    levels = {"levels": [20.0]} if seed % 2 else {}
    field = Field(tmp_path / "fleets.db", "ABC", SCENARIO, script_policy, **levels)
    given: dict[str, str] = {}
    for uav, point in zip("ABC", (100, 200, 300), strict=True):
        field.report(uav, point)
    for turn in range(70):
        field.now += draw.choice([0.0, 0.3, 1.0, 4.0, 30.0 if turn % 20 == 0 else 2.0])
        uavs = [*field.fleet.uavs]
        uav = draw.choice(uavs)
        kind = draw.random()
        if kind < 0.35:
            point = field.booked(uav) if draw.random() < 0.8 else draw.randrange(400)
            battery = draw.choice([90.0, 90.0, 90.0, 10.0])
            flies = draw.choice([0.0, 0.0, 20.0])
            late = draw.choice([0.0, 0.0, 2.5])
            field.report(uav, point, battery=battery, time=field.now - late, fla=flies)
        elif kind < 0.65:
            for told in field.ask_all(draw.choice([uavs, [uav]])):
                assert told.state != "fly" or field.fleet.danger(field.fleet.uavs[told.ID]) is None
                given |= {told.answer: told.ID} if told.answer else {}
        elif kind < 0.92 and given:
            word = draw.choice(
                ["accepted", "accepted", "taken off", "landed", "refused", "aborted"]
            )
            answer = draw.choice([*given][-6:])
            if given[answer] in uavs:
                field.say(given[answer], answer, word)
        elif kind < 0.97:
            field.command(
                draw.choice(["hold", "resume", "resume", "return"]), draw.choice([None, [uav]])
            )
        elif "D" in uavs:
            field.change([], ["D"])
        elif "D" not in field.fleet.joining:
            field.change(["D"], [])
        else:
            field.report("D", draw.randrange(400))
        if turn % 35 == 34:
            field.fleet.advance(field.now)
            before = known(field.fleet)
            status = field.fleet.status(field.now)
            field.restart()
            field.fleet.advance(field.now)
            assert known(field.fleet) == before
            assert field.fleet.status(field.now) == status
    path = tmp_path / "north.jsonl"
    path.write_text("\n".join([*field.fleets.journal("north"), ""]), encoding="utf-8")
    for episode in episodes_of(path, lambda n: field.parts(n)[0], {}):
        assert episode.names in ([*"ABC"], [*"ABCD"])
    assert len(delays_of(in_order(read_log(path)))) > 10


def test_a_restart_knows_which_bridge_speaks_for_a_uav(tmp_path):
    field = Field(tmp_path / "fleets.db")
    for uav, point in (("A", 200), ("B", 300)):
        field.report(uav, point, bridge=f"of {uav}", vehicle="")
    field.now += 500
    field.restart()
    with pytest.raises(Held, match="bridge: of A speaks for UAV A, not second"):
        field.report("A", 200, bridge="second")
    assert field.report("A", 200, bridge="of A") == ["new"]


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
    with pytest.raises(
        InputError, match=r"database: .*fleets.db cannot be used: database is locked"
    ):
        field.open()
    field.scenario = replace(SCENARIO, region=replace(SCENARIO.region, lattice_step=60.0))
    field.restart()
    with pytest.raises(RunError, match="database: fleet north is of other landing points"):
        field.fleets["north"]
    field.fleets.close()
    with pytest.raises(InputError) as error:
        Fleets(field.make, field.path, {"policy": "sampled", "region": "llanbedr"})
    message = "policy: script then, sampled now; region: None then, llanbedr now"
    assert str(error.value) == f"database: fleet north is of other settings: {message}"
    (tmp_path / "text.db").write_text(
        "this is not a database, however long it may be", encoding="utf-8"
    )
    with pytest.raises(InputError, match="file is not a database"):
        Fleets(field.make, tmp_path / "text.db", {})


def test_nothing_that_was_acknowledged_is_lost_by_kill(tmp_path):
    """The program is killed while it takes reports, twice."""
    told = {}
    counted = 0
    words = ["region=llanbedr", "motion=polynomial", f"token={TOKEN}", "port=0"]
    code = [sys.executable, "-W", "ignore", "-c", "from damian_fleet.program import main; main()"]
    rows = [
        {"ID": uav, "lat": place[0], "lon": place[1], "battery": 80} for uav, place in PLACE.items()
    ]
    for _ in range(2):
        with subprocess.Popen(
            [*code, *words], cwd=tmp_path, stdout=subprocess.PIPE, text=True
        ) as program:
            line = next(line for line in program.stdout if line.startswith("listening"))
            client = httpx2.Client(
                base_url=line.split()[-1], headers={"Authorization": f"Bearer {TOKEN}"}
            )
            if not told:
                client.put("/fleets/f", json={"uavs": [*PLACE]})
                client.post("/fleets/f/reports", json=rows)
            (again,) = client.post("/fleets/f/advice", json={"uavs": ["A"]}).json()["advice"]
            assert not told or again == told | {"state": "bound", "age": again["age"]}
            told = told or again
            said = {"ID": "A", "answer": told["answer"], "status": "accepted"}
            assert client.post("/fleets/f/acknowledgements", json=said).json() == {
                "status": ["accepted"]
            }
            assert client.get("/fleets/f").json()["uavs"][1]["reports"] >= counted
            threading.Timer(0.4, program.kill).start()
            with contextlib.suppress(httpx2.TransportError):
                while client.post("/fleets/f/reports", json=rows[1]).status_code == 200:
                    counted += 1
    assert counted > 20
