"""The service over HTTP: what it answers, and what it refuses."""

import contextlib
import functools
import json
import random
import socket
import threading
import time

import httpx2
import pytest
import uvicorn
from starlette.testclient import TestClient

from damian_fleet import door
from damian_fleet.fleet import LEASE
from damian_fleet.program import config_of, make_fleets
from damian_fleet.rows import MOST_ROWS
from damian_fleet.service import MAX_BODY, Clock, make_app
from damian_fleet.store import Fleets

TOKEN = "a-token-of-the-service"
NOW = 1.75e9
PLACE = {"A": (52.8110, -4.1283), "B": (52.8133, -4.1264)}
NORTH = "/fleets/north"


def row(uav: str, **changed):
    lat, lon = PLACE[uav]
    return {"ID": uav, "time": NOW, "lat": lat, "lon": lon, "battery": 80} | changed


WORDS = ["region=llanbedr", "motion=polynomial", "database=':memory:'"]
made = functools.cache(lambda: make_fleets(*config_of(WORDS)).make)


@pytest.fixture
def client():
    hands = {"now": NOW}
    clock = Clock(NOW, lambda: NOW, lambda: hands["now"] - NOW)
    with TestClient(
        make_app(Fleets(made(), ":memory:", {}), TOKEN, clock), raise_server_exceptions=False
    ) as client:
        client.headers["Authorization"] = f"Bearer {TOKEN}"
        client.wait = lambda seconds: hands.update(now=hands["now"] + seconds)
        assert client.put(NORTH, json={"uavs": ["A", "B"]}).status_code == 201
        yield client


def begin(client) -> dict:
    assert client.post(f"{NORTH}/reports", json=[row("A"), row("B")]).status_code == 200
    return client.post(f"{NORTH}/advice", json={"uavs": ["A"]}).json()["advice"][0]


def test_reports_go_in_and_landing_points_come_out(client):
    assert client.post(f"{NORTH}/advice", json={"uavs": ["A"]}).status_code == 409
    told = begin(client)
    assert (told["state"], told["altitude"]) == ("fly", 20.0)
    said = {"ID": "A", "answer": told["answer"], "status": "accepted"}
    assert client.post(f"{NORTH}/acknowledgements", json=said).json() == {"status": ["accepted"]}
    both = client.post(f"{NORTH}/advice", json={"uavs": ["A", "B"]}).json()["advice"]
    assert both[0] == told | {"state": "bound"}
    assert (both[1]["ID"], both[1]["state"]) == ("B", "fly")
    table = "ID,time,lat,lon,vx\n" + f"A,{NOW + 1},52.8110,-4.1283,3\n"
    headers = {"Content-Type": "text/csv; charset=utf-8"}
    client.wait(2)
    found = client.post(f"{NORTH}/reports", content=table, headers=headers).json()
    assert found == {"accepted": 1, "found": ["new"], "ignored": ["vx"]}
    for uavs, held in ((None, ["A", "B"]), ([], []), (["B"], ["B"])):
        said = {"command": "hold", "uavs": uavs}
        assert client.post(f"{NORTH}/command", json=said).json() == {"uavs": held}
    assert client.post(f"{NORTH}/uavs", json={"join": ["C"]}).json() == {"uavs": ["A", "B"]}
    assert client.get("/fleets").json() == {"fleets": ["north"]}
    assert client.put(NORTH, json={"uavs": ["A", "B"]}).status_code == 200
    assert client.put(NORTH, json={"uavs": ["A"]}).status_code == 422
    assert client.put("/fleets/x.y", json={"uavs": ["A"]}).status_code == 422
    assert client.delete(NORTH).status_code == 204
    assert client.get(NORTH).status_code == 404
    assert client.put(NORTH, json={"uavs": ["X"]}).status_code == 201


def test_looking_changes_nothing(client):
    begin(client)
    paths = [
        route
        for route, does in client.get("/openapi.json").json()["paths"].items()
        if "get" in does
    ]
    assert len(paths) >= 6
    before = client.get(f"{NORTH}/journal").text
    for _ in range(2):
        client.wait(3)
        for path in paths:
            assert client.get(path.format(name="north")).status_code == 200, path
    assert client.get(f"{NORTH}/journal").text == before
    a, b = client.get(NORTH).json()["uavs"]
    assert (a["age"], b["advice"]["state"]) == (6.0, "none")
    fence = client.get(f"{NORTH}/geofence").json()
    lon, lat = fence["geometry"]["coordinates"][0][0]
    assert (fence["type"], round(lat), round(lon)) == ("Feature", 53, -4)


def test_two_reports_of_one_second_count_and_one_that_comes_twice_counts_once(client):
    begin(client)

    def found(**changed) -> str:
        return client.post(f"{NORTH}/reports", json=row("A", **changed)).json()["found"][0]

    assert [found(source_spotted=1), found(source_spotted=1), found()] == [
        "new",
        "duplicate",
        "duplicate",
    ]
    assert [found(number=7), found(number=8), found(number=7)] == ["new", "new", "duplicate"]
    one = {"number": 9, "time": None, "AoI": 1}
    client.wait(1)
    assert found(**one) == "new"
    client.wait(1)
    assert found(**one) == "duplicate", "by its number, though it came later"
    assert client.get(NORTH).json()["uavs"][0]["duplicates"] == 4


@pytest.mark.parametrize(
    ("says", "flies"),
    [
        ({"FLA": 0.03}, False),
        ({"FLA": 0.4, "motors": 0}, False),
        ({"FLA": 0.4, "motors": 1}, True),
        ({"FLA": 0.6}, True),
        ({"FLA": 8.0, "on ground": 1, "motors": 1}, False),
        ({"FLA": 0.0, "on_ground": "0"}, True),
    ],
)
def test_the_autopilot_says_what_is_on_the_ground(client, says, flies):
    begin(client)
    client.post(f"{NORTH}/reports", json=row("B", time=NOW + 0.5, **says))
    assert client.get(NORTH).json()["uavs"][1]["flies"] == flies


def test_who_has_the_wrong_token_learns_nothing(client):
    answers = [
        client.request(method, path, headers={"Authorization": token})
        for method, path in (
            ("GET", NORTH),
            ("GET", "/fleets/nowhere"),
            ("POST", f"{NORTH}/advice"),
        )
        for token in ("Bearer wrong", "", f"Basic {TOKEN}")
    ]
    said = {(each.status_code, each.json()["error"]) for each in answers}
    assert said == {(401, "the token is missing or wrong")}
    for path in ("/time", "/health"):
        assert client.get(path, headers={"Authorization": ""}).status_code == 200


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"lat": 528110000}, "lat: 528110000: Value error, give degrees, not degrees times 10^7"),
        ({"time": 1.75e12}, "time: 1750000000000.0: Value error, give seconds, not milliseconds"),
        ({"lat": None, "latitude": 52.8}, "latitude: it is not a column here: give lat [deg]"),
        (
            {"battery": None, "percentage": 0.8},
            "percentage: it is not a column here: give battery [%], 100",
        ),
        (
            {"altitude(feet)": 60},
            "altitude(feet): it is not a column here: give fla [m], 0.3048 times",
        ),
        ({"battery": 101}, "battery: 101: Input should be less than or equal to 100"),
        ({"lat": 53.9}, "lat, lon: 53.9, -4.1264 is 1"),
        (
            {"time": NOW + 60},
            "time: 1750000060 s is 60.0 s after it came in: set the clock of the UAV",
        ),
        ({"ID": "C"}, "ID: 'C' is not a UAV of this fleet: A, B"),
    ],
)
def test_a_report_is_refused_with_its_column_and_what_would_be_right(client, changed, message):
    answer = client.post(f"{NORTH}/reports", json=[row("A"), row("B", **changed)])
    assert answer.status_code == 422
    assert answer.json()["error"].startswith(f"row 2: {message}")
    assert client.get(NORTH).json()["uavs"][0]["reports"] == 0, "all or none"


@pytest.mark.parametrize("path", ["reports", "acknowledgements", "command", "uavs"])
def test_any_nonsense_is_refused_and_changes_nothing(client, path):
    answer = begin(client)["answer"]
    draw = random.Random(3)
    good = {
        "ID": "A",
        "answer": answer,
        "status": "accepted",
        "command": "hold",
        "join": ["C"],
        "leave": [],
    }
    before = client.get(f"{NORTH}/journal").text
    junk = [b"[]", b"null", b"3", b"1e999", b'"\\ud800"', b"[" * 20_000]
    junk += [b'{"command": "hold", "uavs": ["Z"]}']
    for _ in range(40):
        broken = dict(good)
        for key in {*draw.sample([*broken], 3), "status", "command", "join"}:
            broken[key] = draw.choice(
                ["=1", "x" * 99, 7.5, [[]], {"A": {}}, True, "\u202e", ["A", "A", 1]]
            )
        junk += [json.dumps([broken]).encode(), draw.randbytes(40)]
    for number, body in enumerate(junk):
        kind = {"Content-Type": "text/csv" if number % 5 == 4 else "application/json"}
        told = client.post(f"{NORTH}/{path}", content=body, headers=kind)
        assert told.status_code in (400, 422), (body, told.text)
        assert told.json()["error"].isprintable()
    assert client.get(f"{NORTH}/journal").text == before
    assert client.post(f"{NORTH}/{path}", content=b" " * (MAX_BODY + 1)).status_code == 413
    assert client.post(f"{NORTH}/{path}", content=iter([b"{}"])).status_code == 411


@pytest.mark.parametrize("jump", [3600.0, -3600.0])
def test_a_jump_of_the_system_clock_is_shown_and_the_service_keeps_its_time(jump):
    hands = {"system": NOW, "monotonic": 5.0}
    clock = Clock(NOW - 9, lambda: hands["system"], lambda: hands["monotonic"])
    hands |= {"system": NOW + 2 + jump, "monotonic": 7.0}
    assert (clock(), clock.system_ahead) == (NOW + 2, jump)
    assert Clock(NOW + 9e6, lambda: hands["system"])() == pytest.approx(NOW + 9e6), (
        "after what is stored"
    )


def test_one_bridge_speaks_for_a_uav_and_for_a_vehicle_until_it_is_gone(client):
    begin(client)

    def report(uav: str, bridge: str, vehicle: str = "", after: float = 1.0):
        client.wait(after)
        said = row(uav, bridge=bridge, vehicle=vehicle) | {"time": None, "AoI": 0}
        return client.post(f"{NORTH}/reports", json=said)

    def says(answer) -> str:
        assert answer.status_code == 409
        return answer.json()["error"]

    assert report("A", "first", "board 1").json()["ignored"] == []
    assert says(report("A", "second", "board 2")).startswith(
        "bridge: first speaks for UAV A, not second: end"
    )
    assert "the vehicle of B is UAV A: let that leave" in says(report("B", "third", "board 1"))
    assert report("B", "third", "board 3").status_code == 200
    for path, said in (
        ("advice", {"uavs": ["A"], "bridge": "second"}),
        ("acknowledgements", {"ID": "A", "answer": "x", "status": "landed", "bridge": "second"}),
        ("acknowledgements", {"ID": "A", "answer": "x", "status": "landed"}),
        ("uavs", {"leave": ["A"], "bridge": "second"}),
    ):
        assert "first speaks for UAV A" in says(client.post(f"{NORTH}/{path}", json=said)), path
    told = report("A", "first", "board 1").json()
    assert told["warning"].startswith("bridge "), "it is told as well"
    assert "warning" not in report("A", "first", "board 1").json()
    assert "is UAV A" in says(report("B", "third", "board 1", after=LEASE + 1)), (
        "where A stands, it is"
    )
    assert report("B", "third", "board 3").status_code == 200
    assert report("A", "second", "board 2").status_code == 200
    assert says(report("A", "first", "board 1")).startswith("bridge: second speaks for UAV A")
    said = {"leave": ["A"], "bridge": "second"}
    assert client.post(f"{NORTH}/uavs", json=said).json() == {"uavs": ["B"]}
    client.post(f"{NORTH}/uavs", json={"join": ["A"]})
    assert report("A", "first", "board 1").status_code == 200, "it has been handed over"


def test_a_bridge_keeps_its_uav_for_a_flight(client):
    client.wait(1)
    client.post(f"{NORTH}/reports", json=[row("A", bridge="first"), row("B")])
    told = client.post(f"{NORTH}/advice", json={"uavs": ["A"], "bridge": "first"}).json()["advice"][
        0
    ]
    said = {"ID": "A", "answer": told["answer"], "status": "accepted", "bridge": "first"}
    assert client.post(f"{NORTH}/acknowledgements", json=said).json() == {"status": ["accepted"]}
    client.wait(2 * told["duration"])
    answer = client.post(f"{NORTH}/reports", json=row("A", number=3, bridge="second"))
    assert answer.status_code == 409
    client.wait(120)
    assert (
        client.post(f"{NORTH}/reports", json=row("A", number=3, bridge="second")).status_code == 200
    )


@pytest.mark.parametrize("kind", ["application/json", "text/csv"])
def test_many_rows_are_refused_before_others_wait_for_them(client, kind):
    rows = [row("A", number=n) for n in range(MOST_ROWS + 1)]
    table = "\n".join(["ID,lat,lon", *["A,52.8110,-4.1283"] * len(rows), ""])
    body = json.dumps(rows) if kind == "application/json" else table
    answer = client.post(f"{NORTH}/reports", content=body, headers={"Content-Type": kind})
    assert (answer.status_code, str(MOST_ROWS) in answer.json()["error"]) == (413, True)


def test_strangers_are_few_and_do_not_stay(monkeypatch):
    monkeypatch.setattr(door, "MOST_STRANGERS", 3)
    monkeypatch.setattr(door, "PATIENCE", 1.0)
    app = make_app(Fleets(made(), ":memory:", {}), TOKEN)
    config = uvicorn.Config(
        app, port=0, log_level="error", http=door.door(TOKEN), limit_concurrency=8
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    address = server.servers[0].sockets[0].getsockname()[:2]
    silent = [socket.create_connection(address) for _ in range(20)]
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with httpx2.Client(base_url="http://{}:{}".format(*address), headers=headers) as known:
        for _ in range(2):
            assert known.get("/fleets").status_code == 200
            for (
                each
            ) in silent:  # all have been closed the second time, but not who has shown the token
                each.settimeout(5)
                with contextlib.suppress(ConnectionResetError):
                    assert each.recv(1) == b""
        assert len(server.server_state.connections) == 1
    for each in silent:
        each.close()
    server.should_exit = True
    thread.join()
