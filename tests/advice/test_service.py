"""The service over HTTP: what it answers, what it refuses, and that it goes on after anything."""

import json
import random

import pytest
from reporting import FREE
from starlette.testclient import TestClient
from test_fleet import LLANBEDR, TASKS, scenario_of

from damian import keys
from damian.advice.fleet import Fleet
from damian.advice.node import Node, for_uavs
from damian.advice.service import MAX_BODY, make_app
from damian.advice.session import AdviceSession
from damian.baselines.greedy import greedy_policy

TOKEN = "a-token-of-the-service"
NOW = 1.75e9
UAVS = ["A", "B", "C"]


@pytest.fixture(scope="module")
def parts():
    node = Node(for_uavs(scenario_of(region=LLANBEDR), 3))
    return node, greedy_policy(node.env)


@pytest.fixture
def session(parts, tmp_path):
    node, policy = parts
    return AdviceSession(
        lambda uavs, mark: Fleet(node, uavs, policy, rules=FREE, mark=mark),
        tmp_path / "journals",
        {"policy": "greedy"},
    )


class Clock:
    """A clock that stands still unless it is set."""

    now = NOW

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def client(session, clock):
    app = make_app(session, TOKEN, clock)
    with TestClient(
        app, raise_server_exceptions=False, headers={"Authorization": f"Bearer {TOKEN}"}
    ) as client:
        yield client


@pytest.fixture
def fleet(client):
    """The path of a fleet that is there."""
    assert client.put("/fleets/north", json={"uavs": UAVS}).status_code == 201
    return "/fleets/north"


def row(uav: str, point: int, session, **changed):
    lat, lon = next(iter(session.fleets.values())).ground.place(point)
    return {"ID": uav, "time": NOW, "lat": lat, "lon": lon, "source_spotted": 0, "battery": 80.0} | changed


def rows(session, **changed):
    return [row(uav, 40 * i, session, **changed) for i, uav in enumerate(UAVS)]


def test_reports_go_in_and_landing_points_come_out(client, fleet, session, clock):
    assert client.get(f"{fleet}/advice").status_code == 409
    done = client.post(f"{fleet}/reports", json=rows(session))
    assert (done.status_code, done.json()) == (200, {"accepted": 3, "found": ["new"] * 3})
    answer = client.get(f"{fleet}/advice").json()["advice"]
    assert [each["ID"] for each in answer] == UAVS
    assert all(each["state"] == "fly" and each["distance"] > 0 for each in answer)
    assert len({(each["lat"], each["lon"]) for each in answer}) == 3
    assert client.get(f"{fleet}/advice").json()["advice"] == answer, "nobody chooses twice in a step"
    clock.now += 5
    assert {each["state"] for each in client.get(f"{fleet}/advice?uav=B").json()["advice"]} <= {"fly", "hold"}
    assert [e["ID"] for e in client.get(f"{fleet}/advice?uav=B").json()["advice"]] == ["B"]
    later = row("A", 7, session, time=NOW + 4)
    table = f"{','.join(later)}\n{','.join(map(str, later.values()))}"
    headers = {"Content-Type": "text/csv; charset=utf-8"}
    found = [
        client.post(f"{fleet}/reports", content=table, headers=headers).json()["found"] for _ in range(2)
    ]
    assert found == [["new"], ["duplicate"]]
    head, *table = client.get(f"{fleet}/advice?format=csv").text.splitlines()
    assert (
        head
        == "answer,ID,state,reason,lat,lon,altitude,speed,heading,distance,duration,arrival,until,step,age"
    )
    assert [(line.split(",")[1], line.split(",")[-1]) for line in table] == [
        ("A", "1.0"),
        ("B", "5.0"),
        ("C", "5.0"),
    ]
    status = client.get(fleet).json()
    assert (status["step"], status["dt"], status["uavs"][0]["reports"]) == (5, 1.0, 3)
    assert status["uavs"][0] == status["uavs"][0] | {"ID": "A", "age": 1.0, "late": 0, "duplicates": 1}


def test_who_has_the_wrong_token_learns_nothing(client, fleet, session):
    answers = [
        client.get(path, headers=headers)
        for path in (fleet, "/fleets/nowhere", f"{fleet}/advice")
        for headers in ({"Authorization": "Bearer wrong"}, {"Authorization": ""})
    ]
    assert {(each.status_code, each.text) for each in answers} == {
        (401, '{"error":"the token is missing or wrong"}')
    }
    assert client.get("/fleets/nowhere").status_code == 404


def test_a_fleet_is_created_once_and_can_be_ended(client, fleet, session):
    assert client.put(fleet, json={"uavs": UAVS}).status_code == 200
    assert client.put(fleet, json={"uavs": ["X"]}).status_code == 422
    client.post(f"{fleet}/reports", json=rows(session))
    assert client.delete(fleet).status_code == 204
    assert client.get(fleet).status_code == 404
    assert client.put(fleet, json={"uavs": ["X"]}).status_code == 201


def test_a_huge_body_is_refused(client, fleet):
    answer = client.post(f"{fleet}/reports", content=b"[" + b" " * MAX_BODY * 10)
    assert answer.status_code == 413


@pytest.mark.parametrize("content", ["application/json", "text/csv"])
def test_after_any_nonsense_the_service_goes_on(client, fleet, session, content):
    generator, good = random.Random(1), json.dumps(rows(session)).encode()
    junk = [b"1e999", b"[" * 20_000, b'"\\ud800"', b'[{"lat": ' + b"1" * 5000 + b"}]", b"null", good[:-9]]
    for body in [*junk, *(generator.randbytes(50) for _ in range(50))]:
        answer = client.post(f"{fleet}/reports", content=body, headers={"Content-Type": content})
        assert answer.status_code == 422, (body, answer.text)
        assert answer.json()["error"].isprintable()
    assert not any(log.reports for log in session.fleet("north").logs)
    assert client.post(f"{fleet}/reports", json=rows(session)).status_code == 200
    assert client.get(f"{fleet}/advice").status_code == 200


@pytest.mark.sample(2)
@pytest.mark.parametrize("task", ["belief", "flights"])
def test_a_journal_brings_everything_back(task, tmp_path):
    """The service is asked about and takes its steps at other times than when it is restored."""
    node = Node(for_uavs(scenario_of(**TASKS[task]), 3))
    policy, clock = greedy_policy(node.env), Clock()

    def make_session() -> AdviceSession:
        return AdviceSession(
            lambda uavs, mark: Fleet(node, uavs, policy, rules=FREE, mark=mark),
            tmp_path,
            {"policy": "greedy"},
        )

    session, generator = make_session(), random.Random(5)
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with TestClient(make_app(session, TOKEN, clock), headers=headers) as client:
        client.put("/fleets/north", json={"uavs": UAVS})
        client.post("/fleets/north/reports", json=rows(session))
        for step in range(60):
            clock.now = NOW + step * 0.7
            uav, late = generator.choice(UAVS), generator.choice([0, 0.3, 2.5])
            sent = row(
                uav, generator.randrange(200), session, time=clock.now - late, source_spotted=step % 7 == 0
            )
            known = (
                {"track": 5.0 * step, "battery": 90.0 - step}
                if generator.random() < 0.5
                else {"battery": None}
            )
            assert client.post("/fleets/north/reports", json=sent | known).status_code == 200
            if generator.random() < 0.5:
                session.advance(clock.now)
            if generator.random() < 0.5:
                client.get(f"/fleets/north/advice?uav={generator.choice(UAVS)}")
    one, other = session.fleet("north"), make_session().fleet("north")
    assert (one.start, list(map(list, one.told))) == (other.start, list(map(list, other.told)))
    assert [log.reports for log in one.logs] == [log.reports for log in other.logs]
    for fleet in (one, other):
        fleet.advance(clock.now + 0.5)  # while all that is remembered still counts
    read = [fleet.observe([0]) for fleet in (one, other)]
    for key in (keys.OBSERVATION, keys.RECEIVED, keys.HISTORY):
        if key in read[0].keys(True):
            assert read[0][key].equal(read[1][key]), key
