"""The service over HTTP: what it answers, and what it refuses."""

import pytest
from reporting import FREE
from starlette.testclient import TestClient
from test_fleet import LLANBEDR, scenario_of

from damian.baselines.script import script_policy
from damian.field.node import Node, for_uavs
from damian_fleet.fleet import Fleet
from damian_fleet.service import MAX_BODY, make_app
from damian_fleet.session import AdviceSession

TOKEN = "a-token-of-the-service"
NOW = 1.75e9
UAVS = ["A", "B", "C"]


@pytest.fixture(scope="module")
def parts():
    node = Node(for_uavs(scenario_of(region=LLANBEDR), 3))
    return node, script_policy(node.env)


@pytest.fixture
def session(parts, tmp_path):
    node, policy = parts
    return AdviceSession(
        lambda uavs, mark: Fleet(node, uavs, policy, rules=FREE, mark=mark),
        tmp_path / "journals",
        {"policy": "script"},
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
