"""The service over HTTP: what it answers, what it refuses, and that it goes on after anything."""

import json
import random

import pytest
from starlette.testclient import TestClient
from test_fleet import LLANBEDR, TASKS, scenario_of

from damian import keys
from damian.advice.desk import Desk
from damian.advice.fleet import Fleet
from damian.advice.node import Node, for_uavs
from damian.advice.service import MAX_BODY, fleet_token, make_app
from damian.baselines.greedy import greedy_policy

TOKEN = "a-token-of-the-service"
NOW = 1.75e9
UAVS = ["A", "B", "C"]


@pytest.fixture(scope="module")
def parts():
    node = Node(for_uavs(scenario_of(region=LLANBEDR), 3))
    return node, greedy_policy(node.env)


@pytest.fixture
def desk(parts, tmp_path):
    node, policy = parts
    return Desk(lambda uavs: Fleet(node, uavs, policy), tmp_path / "journals", {"policy": "greedy"})


class Clock:
    """A clock that stands still unless it is set."""

    now = NOW

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def client(desk, clock):
    app = make_app(desk, TOKEN, clock)
    with TestClient(
        app, raise_server_exceptions=False, headers={"Authorization": f"Bearer {TOKEN}"}
    ) as client:
        yield client


@pytest.fixture
def fleet(client):
    """The path of a fleet that is there."""
    assert client.put("/fleets/north", json={"uavs": UAVS}).status_code == 201
    return "/fleets/north"


def row(uav: str, point: int, desk, **changed):
    lat, lon = next(iter(desk.fleets.values())).ground.place(point)
    return {"ID": uav, "time": NOW, "lat": lat, "lon": lon, "source_spotted": 0, "battery": 80.0} | changed


def rows(desk, **changed):
    return [row(uav, 40 * i, desk, **changed) for i, uav in enumerate(UAVS)]


def test_reports_go_in_and_landing_points_come_out(client, fleet, desk, clock):
    assert client.get(f"{fleet}/advice").status_code == 409
    done = client.post(f"{fleet}/reports", json=rows(desk))
    assert (done.status_code, done.json()) == (200, {"accepted": 3, "found": ["new"] * 3})
    answer = client.get(f"{fleet}/advice").json()["advice"]
    assert [each["ID"] for each in answer] == UAVS
    assert all(each["state"] == "fly" and each["distance"] > 0 for each in answer)
    assert len({(each["lat"], each["lon"]) for each in answer}) == 3
    assert client.get(f"{fleet}/advice").json()["advice"] == answer, "nobody chooses twice in a step"
    clock.now += 5
    assert {each["state"] for each in client.get(f"{fleet}/advice?uav=B").json()["advice"]} <= {"fly", "hold"}
    assert [e["ID"] for e in client.get(f"{fleet}/advice?uav=B").json()["advice"]] == ["B"]
    assert [e["step"] for e in client.get(f"{fleet}/advice").json()["advice"]] == [5, 5, 5]


def test_tables_go_in_and_come_out_as_csv(client, fleet, desk):
    lines = ["ID,source time,lat,lon,source spotted,track,takeoff-landing time,battery,AoI,FLA"]
    for i, uav in enumerate(UAVS):
        lat, lon = desk.fleets["north"].ground.place(40 * i)
        lines.append(f"{uav},NA,{lat},{lon},0,90,NA,NA,{i},0")
    headers = {"Content-Type": "text/csv; charset=utf-8"}
    assert client.post(f"{fleet}/reports", content="\n".join(lines), headers=headers).status_code == 200
    head, *table = client.get(f"{fleet}/advice?format=csv").text.splitlines()
    assert head == "ID,state,lat,lon,heading,distance,duration,arrival,step,age"
    assert [line.split(",")[0] for line in table] == UAVS
    assert [float(line.split(",")[-1]) for line in table] == [0.0, 1.0, 2.0]


def test_late_double_and_missing_reports_are_told_apart(client, fleet, desk, clock):
    client.post(f"{fleet}/reports", json=rows(desk))
    clock.now += 10
    later = row("A", 7, desk, time=NOW + 9)
    older = row("A", 3, desk, time=NOW + 4)
    found = [client.post(f"{fleet}/reports", json=each).json()["found"] for each in (later, older, later)]
    assert found == [["new"], ["late"], ["duplicate"]]
    client.get(f"{fleet}/advice")
    assert desk.fleets["north"].held[0].point == 7
    status = client.get(fleet).json()
    assert [each["age"] for each in status["uavs"]] == [1.0, 10.0, 10.0]
    assert status["uavs"][0] | {"reports": 4, "late": 1, "duplicates": 1} == status["uavs"][0]


REFUSED = {
    "an unknown UAV": ({"ID": "Z"}, "row 2: ID: 'Z' is no UAV of this fleet: A, B, C"),
    "the future": ({"time": NOW + 60}, "row 2: time: 1750000060 s is 60.0 s after it came in: set the clock"),
    "far away": ({"lat": 10.0}, "row 2: lat, lon: 10, -4.1"),
    "no number": ({"battery": "full"}, "row 2: battery: 'full' is not a number between 0 and 100 %"),
    "out of range": ({"battery": 101}, "row 2: battery: 101 is not a number between 0 and 100 %"),
    "no place": ({"lat": None, "lon": None}, "row 2: lat, lon: they are missing"),
    "half a place": ({"lat": None}, "row 2: lat: it is missing [deg]"),
    "two places": ({"x": 1.0}, "row 2: lat, x: give either degrees or metres"),
    "another unit": (
        {"target x": 1.0},
        "row 2: target x, y: the place of the UAV is lat, lon: give target lat",
    ),
    "a source without a time": (
        {"source lat": 52.8, "source lon": -4.1},
        "row 2: source time: it is missing: when the source was detected at this place [s]",
    ),
    "no flag": ({"source_spotted": "maybe"}, "row 2: source spotted: 'maybe' is not 1 or 0"),
    "no time": ({"time": "noon"}, "row 2: time: 'noon' is neither seconds nor a time such as"),
    "an unknown column": ({"speed": 3}, "row 2: 'speed' is no column; they are id, time, aoi, lat"),
    "a time of receipt": ({"receive time": NOW}, "row 2: receive time: only damian advise reports=FILE"),
    "readings": ({"readings": [1.0]}, "row 2: readings: 1 numbers are not 0, as in the training"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_row_is_refused_with_its_place_column_value_and_unit(client, fleet, desk, case):
    changed, message = REFUSED[case]
    good, wrong = row("A", 0, desk), row("B", 40, desk) | changed
    answer = client.post(f"{fleet}/reports", json=[good, wrong])
    assert answer.status_code == 422
    assert answer.json()["error"].startswith(message)
    assert not desk.fleets["north"].logs[0].known, "all rows are taken, or none"


def test_who_has_the_wrong_token_learns_nothing(client, fleet, desk):
    client.put("/fleets/south", json={"uavs": ["S"]})
    own = {"Authorization": f"Bearer {fleet_token(TOKEN, 'south')}"}
    answers = [
        client.get(path, headers=headers)
        for path in (fleet, "/fleets/nowhere", f"{fleet}/advice")
        for headers in ({"Authorization": "Bearer wrong"}, {"Authorization": ""}, own)
    ]
    assert {(each.status_code, each.text) for each in answers} == {
        (401, '{"error":"the token is missing or wrong"}')
    }
    assert client.get("/fleets/south", headers=own).status_code == 200
    assert client.delete("/fleets/south", headers=own).status_code == 401
    assert client.put("/fleets/west", json={"uavs": ["W"]}, headers=own).status_code == 401
    assert client.get("/fleets/nowhere").status_code == 404


def test_fleets_do_not_see_each_other(client, fleet, desk):
    client.put("/fleets/south", json={"uavs": UAVS})
    client.post(f"{fleet}/reports", json=rows(desk))
    assert client.get("/fleets/south/advice").status_code == 409
    assert all(each["reports"] == 0 for each in client.get("/fleets/south").json()["uavs"])


def test_a_fleet_is_created_once_and_can_be_ended(client, fleet, desk):
    assert client.put(fleet, json={"uavs": UAVS}).status_code == 200
    assert client.put(fleet, json={"uavs": ["X"]}).status_code == 422
    client.post(f"{fleet}/reports", json=rows(desk))
    assert client.delete(fleet).status_code == 204
    assert client.get(fleet).status_code == 404
    assert client.put(fleet, json={"uavs": ["X"]}).status_code == 201


@pytest.mark.parametrize("uavs", [None, [], "A", ["A", "A"], [""], ["x" * 65], [["A"]], ["A"] * 101, [True]])
def test_wrong_uavs_are_refused(client, uavs):
    answer = client.put("/fleets/north", json={"uavs": uavs})
    assert answer.status_code == 422
    assert answer.json()["error"].startswith("uavs: ")


def test_a_huge_body_is_refused(client, fleet):
    answer = client.post(f"{fleet}/reports", content=b"[" + b" " * MAX_BODY * 10)
    assert (answer.status_code, answer.json()) == (
        413,
        {"error": f"the body is larger than {MAX_BODY} bytes"},
    )


def nonsense(generator: random.Random, desk) -> tuple[bytes, str, str]:
    """A body, a content type and a token, at least one of which is wrong."""
    good = json.dumps(rows(desk))
    junk = [
        "NaN",
        "1e999",
        "-1",
        "[]",
        "{}",
        '"x"',
        "null",
        "true",
        "1" * 5000,
        '"\\ud800"',
        '"' + "y" * 3000 + '"',
    ]
    keys = ["ID", "time", "lat", "lon", "battery", "source_spotted", "previous", "readings", "motions", "FLA"]
    kinds = {
        "bytes": generator.randbytes(generator.randrange(200)),
        "cut": good[: generator.randrange(len(good))].encode(),
        "nested": b"[" * generator.randrange(1, 20_000),
        "value": f'[{{"{generator.choice(keys)}": {generator.choice(junk)}}}]'.encode(),
        "uav": json.dumps([rows(desk)[0] | {"ID": f"Z{generator.random()}"}]).encode(),
        "token": good.encode(),
    }
    kind = generator.choice([*kinds])
    for key in [generator.choice(keys)] if kind == "value" and generator.random() < 0.5 else []:
        broken = rows(desk)[0]
        broken[key] = json.loads(generator.choice([j for j in junk if len(j) < 4000 and j != "NaN"]))
        broken["nothing"] = 1
        kinds[kind] = json.dumps(broken).encode()
    content = generator.choice(["application/json", "text/csv", "application/x-ndjson", "x/y", ""])
    return (
        kinds[kind],
        content if kind in ("bytes", "cut", "nested") else "",
        "" if kind == "token" else TOKEN,
    )


@pytest.mark.parametrize("n", [400, pytest.param(10_000, marks=pytest.mark.slow)])
def test_after_any_nonsense_the_service_goes_on(client, fleet, desk, n):
    generator, codes = random.Random(1), set()
    for _ in range(n):
        body, content, token = nonsense(generator, desk)
        headers = {"Authorization": f"Bearer {token}"} | ({"Content-Type": content} if content else {})
        answer = client.post(f"{fleet}/reports", content=body, headers=headers)
        codes.add(answer.status_code)
        assert 400 <= answer.status_code < 500, (body, answer.text)
        assert answer.json()["error"].isprintable()
    assert codes == {401, 422}
    assert not any(log.known for log in desk.fleets["north"].logs)
    assert client.post(f"{fleet}/reports", json=rows(desk)).status_code == 200
    assert client.get(f"{fleet}/advice").status_code == 200


@pytest.mark.parametrize("method", ["GET", "POST", "PUT", "DELETE", "PATCH", "HEAD", "OPTIONS"])
@pytest.mark.parametrize(
    "path", ["/", "/fleets", "/fleets/", "/fleets/north", "/fleets/%00/advice", "/x" * 2000]
)
def test_any_path_and_method_is_answered(client, fleet, method, path):
    assert client.request(method, path).status_code < 500


def test_a_wrong_question_for_advice_is_refused(client, fleet, desk):
    client.post(f"{fleet}/reports", json=rows(desk))
    for query in ("?uav=Z", "?format=xml", "?uavs=A", "?uav="):
        assert client.get(f"{fleet}/advice{query}").status_code == 422


@pytest.mark.sample(2)
@pytest.mark.parametrize("task", ["history", "belief", "clocks", "flights"])
def test_a_journal_brings_everything_back(task, tmp_path):
    """The service is asked about and takes its steps at other times than when it is restored."""
    node = Node(for_uavs(scenario_of(**TASKS[task]), 3))
    policy, clock = greedy_policy(node.env), Clock()

    def make_desk() -> Desk:
        return Desk(lambda uavs: Fleet(node, uavs, policy), tmp_path, {"policy": "greedy"})

    desk, generator = make_desk(), random.Random(5)
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with TestClient(make_app(desk, TOKEN, clock), headers=headers) as client:
        client.put("/fleets/north", json={"uavs": UAVS})
        client.post("/fleets/north/reports", json=rows(desk))
        for step in range(60):
            clock.now = NOW + step * 0.7
            uav, late = generator.choice(UAVS), generator.choice([0, 0.3, 2.5])
            sent = row(
                uav, generator.randrange(200), desk, time=clock.now - late, source_spotted=step % 7 == 0
            )
            known = (
                {"track": 5.0 * step, "battery": 90.0 - step}
                if generator.random() < 0.5
                else {"battery": None}
            )
            assert client.post("/fleets/north/reports", json=sent | known).status_code == 200
            if generator.random() < 0.5:
                desk.advance(clock.now)
            if generator.random() < 0.5:
                client.get(f"/fleets/north/advice?uav={generator.choice(UAVS)}")
    one, other = desk.fleets["north"], make_desk().fleets["north"]
    assert (one.start, list(map(list, one.told))) == (other.start, list(map(list, other.told)))
    assert [log.known for log in one.logs] == [log.known for log in other.logs]
    for fleet in (one, other):
        fleet.advance(clock.now + 0.5)  # while all that is remembered still counts
    read = [fleet.observe([0]) for fleet in (one, other)]
    for key in (keys.OBSERVATION, keys.RECEIVED, keys.HISTORY):
        if key in read[0].keys(True):
            assert read[0][key].equal(read[1][key]), key
