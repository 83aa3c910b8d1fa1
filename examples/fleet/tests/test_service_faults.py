"""The service stays up: clocks that jump, no handles, a full disk, kill -9, nonsense; a client to copy."""

import asyncio
import errno
import http.client
import json
import logging
import os
import random
import re
import signal
import socket
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path

import pytest
from reporting import START
from starlette.testclient import TestClient
from test_orders import Field

from damian_fleet import api
from damian_fleet import journal as module
from damian_fleet.clock import Clock
from damian_fleet.service import Service, Sparse, make_app

TOKEN = "a-token-of-the-service"
PLACE = {"A": (52.8110, -4.1283), "B": (52.8133, -4.1264)}
DOCUMENT = Path(__file__).parents[1] / "README.md"


class Hands:
    """Two clocks that are set by hand."""

    system = monotonic = START


@pytest.fixture
def field(tmp_path):
    return Field(tmp_path)


@pytest.fixture
def hands():
    return Hands()


@pytest.fixture
def client(field, hands):
    clock = Clock(system=lambda: hands.system, monotonic=lambda: hands.monotonic)
    headers = {"Authorization": f"Bearer {TOKEN}"}
    app = make_app(field.session, TOKEN, clock)
    with TestClient(app, raise_server_exceptions=False, headers=headers) as client:
        yield client


def row(uav: str = "A", **changed):
    lat, lon = PLACE[uav]
    return {"ID": uav, "AoI": 0, "lat": lat, "lon": lon, "battery": 80} | changed


def begin(client) -> str:
    assert client.post("/fleets/north/reports", json=[row("A"), row("B")]).status_code == 200
    return client.get("/fleets/north/advice?uav=A").json()["advice"][0]["answer"]


def test_columns_that_are_not_understood_are_named_and_not_kept(client, tmp_path):
    table = "ID,AoI,lat,lon,battery,vx,alt\nA,0,52.8110,-4.1283,80,1.5,30\n"
    answer = client.post("/fleets/north/reports", content=table, headers={"Content-Type": "text/csv"})
    assert answer.json() == {"accepted": 1, "found": ["new"], "ignored": ["alt", "vx"]}
    assert "vx" not in (tmp_path / "north.jsonl").read_text(encoding="utf-8")


@pytest.mark.parametrize("jump", [3600.0, -3600.0])
def test_a_jump_of_the_system_clock_is_noted_and_nothing_stops(client, hands, jump, caplog):
    answer = begin(client)
    hands.system, hands.monotonic = hands.system + jump + 2, hands.monotonic + 2
    clock = Clock(system=lambda: hands.system, monotonic=lambda: hands.monotonic)
    assert clock.jumps == 0
    again = client.get("/fleets/north/advice?uav=A").json()["advice"][0]
    assert (again["answer"], again["age"]) == (answer, 2.0)
    hands.system += jump
    clock.watch()
    assert (clock.jumps, round(clock.ahead), len(caplog.messages)) == (1, jump, 1)
    assert clock() == START + jump + 2, "it keeps its time"
    said = client.get("/time").json()
    assert (said["time"], said["written"]) == (START + 2, "2023-11-14T22:13:22.000Z")
    assert Clock(START + 9e6, lambda: hands.system, lambda: 5.0)() == START + 9e6, "after a journal's end"


@pytest.mark.parametrize("code", [errno.EMFILE, errno.ENOSPC])
def test_without_handles_or_disk_nothing_is_taken_until_there_are_some(client, field, monkeypatch, code):
    answer = begin(client)
    accept = {"ID": "A", "answer": answer, "status": "accepted"}

    def full(*_):
        raise OSError(code, os.strerror(code))

    with monkeypatch.context() as none:
        none.setattr(module.os, "open", full)
        refused = [
            client.post("/fleets/north/acknowledgements", json=accept),
            client.post("/fleets/north/command", json={"command": "hold"}),
            client.post("/fleets/north/reports", json=row("B")),
            client.put("/fleets/south", json={"uavs": ["C"]}),
        ]
        assert [each.status_code for each in refused] == [507] * 4
        assert client.get("/health").status_code == 503
        assert os.strerror(code) in client.get("/health").json()["problem"]
    assert (field.fleet.offer(0).status, field.fleet.commands) == ("offered", ["", ""])
    assert client.post("/fleets/north/acknowledgements", json=accept).json() == {"status": ["accepted"]}
    assert client.get("/health").json()["status"] == "ok"


def test_a_log_is_not_flooded():
    through = Sparse()
    made = [logging.LogRecord("x", 40, "", 0, "text", (), None) for _ in range(100)]
    assert sum(map(through.filter, made)) == 10
    through.since -= 61
    assert through.filter(made[0])
    assert made[0].getMessage() == "text (before it, 90 lines were left out)"


@pytest.mark.parametrize("path", ["reports", "acknowledgements", "command", "uavs"])
def test_any_nonsense_is_refused_and_changes_nothing(client, field, path):
    answer, draw = begin(client), random.Random(3)
    good = {"ID": "A", "answer": answer, "status": "accepted", "command": "hold", "join": ["C"], "leave": []}
    before = (field.folder / "north.jsonl").read_bytes()
    junk = [b"", b"[]", b"null", b"3", b"1e999", b'"\\ud800"', b"[" * 20_000]
    junk += [b'{"uavs": ["Z"], "command": "hold", "leave": ["Z"]}']
    for _ in range(60):
        broken = dict(good)
        for key in {*draw.sample([*broken], 3), "status", "command", "join"}:
            broken[key] = draw.choice(["=1", "x" * 99, 7.5, [[]], {"A": {}}, True, "\u202e", ["A", "A", 1]])
        junk += [json.dumps([broken]).encode(), draw.randbytes(40)]
    for number, body in enumerate(junk):
        kind = {"Content-Type": "text/csv" if number % 5 == 4 else "application/json"}
        told = client.post(f"/fleets/north/{path}", content=body, headers=kind)
        assert told.status_code == 422, (body, told.text)
        assert told.json()["error"].isprintable()
    assert (field.folder / "north.jsonl").read_bytes() == before


def test_what_the_service_says_of_itself(client, field):
    begin(client)
    told = client.get("/openapi.json").json()
    text = json.dumps(told)
    for name in re.findall(r"#/components/schemas/(\w+)", text):
        assert name in told["components"]["schemas"], name
    for each in api.ENDPOINTS:
        assert each.method.lower() in told["paths"][each.path]
        assert each.path in client.get("/").text
        opened = client.request(each.method, each.path.format(name="north"), headers={"Authorization": ""})
        assert (opened.status_code == 200) == each.is_open, each
    assert client.get("/fleets").json() == {"fleets": ["north"]}
    fence = client.get("/fleets/north/geofence").json()
    assert (fence["type"], fence["geometry"]["type"]) == ("Feature", "Polygon")
    lon, lat = fence["geometry"]["coordinates"][0][0]
    assert (round(lat), round(lon)) == (53, -4)
    said = client.post("/fleets/north/uavs", json={"join": ["C"]}), client.get("/fleets/north")
    assert (said[0].json()["uavs"], said[1].json()["uavs"][0]["order"]) == (["A", "B"], "offered")


def test_answers_are_pushed_when_they_change(field):
    service = Service(field.session, TOKEN, lambda: field.now)

    async def listen() -> list[dict]:
        stream, seen = service.pushed("north", ["A"]), []

        async def following() -> dict:
            event = await stream.__anext__()
            while event.startswith(":"):
                event = await stream.__anext__()
            return json.loads(event.split("data: ")[1])

        seen.append(await following())
        field.say("A", seen[0]["answer"], "accepted")
        seen.append(await following())
        field.command("hold", ["A"])
        seen.append(await following())
        field.session.end("north", field.now)
        with pytest.raises(StopAsyncIteration):
            await stream.__anext__()
        return seen

    for uav, point in (("A", 200), ("B", 300)):
        field.report(uav, point)
    states = [each["state"] for each in asyncio.run(listen())]
    assert states == ["fly", "bound", "hold"]


# The program itself.


class Program:
    """The service as a process of its own, in a folder."""

    def __init__(self, folder: Path, *words: str, handles: int | None = None) -> None:
        code = "from damian_fleet.program import main; main()"
        if handles:
            code = f"import resource as r; r.setrlimit(r.RLIMIT_NOFILE, ({handles}, {handles})); {code}"
        given = ["region=llanbedr", "policy=script", f"token={TOKEN}", "port=0", "journal=journals", *words]
        self.log = (folder / "log.txt").open("a")
        self.process = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", code, *given],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=self.log,
            text=True,
        )
        assert self.process.stdout is not None
        line = next(line for line in self.process.stdout if line.startswith("listening"))
        self.port = int(line.rpartition(":")[2])

    def ask(self, method: str, path: str, body=None) -> tuple[int, dict]:
        headers = {"Authorization": f"Bearer {TOKEN}"}
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)) as connection:
            connection.request(method, path, None if body is None else json.dumps(body), headers)
            with connection.getresponse() as answer:
                return answer.status, json.loads(answer.read() or b"{}")

    def stop(self, sign: signal.Signals = signal.SIGTERM) -> None:
        self.process.send_signal(sign)
        self.process.wait(60)
        assert self.process.stdout is not None
        self.process.stdout.close()
        self.log.close()


def test_nothing_that_was_acknowledged_is_lost_by_kill_under_load(tmp_path):
    kept: dict[str, str] = {}
    answers: dict[str, str] = {}
    for turn in range(4):
        program = Program(tmp_path, "answer_time=2")
        for name, status in kept.items():
            rows = program.ask("GET", f"/fleets/{name}")[1]["uavs"]
            assert rows[0]["order"] in (status, "landed"), "what it was told last, and what became of it"
            told = program.ask("GET", f"/fleets/{name}/advice?uav=A")[1]["advice"][0]
            assert told["answer"] == answers[name]
        if turn == 3:
            program.stop()
            break

        def fly(name: str, program: Program, enough: threading.Semaphore) -> None:
            try:
                program.ask("PUT", f"/fleets/{name}", {"uavs": ["A", "B"]})
                program.ask("POST", f"/fleets/{name}/reports", [row("A"), row("B")])
                told = program.ask("GET", f"/fleets/{name}/advice?uav=A")[1]["advice"][0]
                said = {"ID": "A", "answer": told["answer"], "status": "accepted"}
                done = program.ask("POST", f"/fleets/{name}/acknowledgements", said)[1]
                if told["state"] == "fly" and done == {"status": ["accepted"]}:
                    kept[name], answers[name] = "accepted", told["answer"]
                    enough.release()
                while True:
                    program.ask("POST", f"/fleets/{name}/reports", row("B"))
            except (OSError, http.client.HTTPException, ValueError):
                return  # it was killed

        kept.clear()
        enough = threading.Semaphore(0)
        flights = [threading.Thread(target=fly, args=(f"f{turn}-{i}", program, enough)) for i in range(6)]
        for each in flights:
            each.start()
        assert all(enough.acquire(timeout=60) for _ in range(3))
        program.stop(signal.SIGKILL)
        for each in flights:
            each.join()


def test_more_connections_than_handles_are_turned_away_and_it_goes_on(tmp_path):
    program = Program(tmp_path, handles=180)
    assert program.ask("PUT", "/fleets/north", {"uavs": ["A", "B"]})[0] == 201
    idle = [socket.create_connection(("127.0.0.1", program.port)) for _ in range(400)]
    turned_away = sum(b"503" in each.recv(100) for each in idle[-100:])
    assert turned_away == 100
    for each in idle:
        each.close()
    assert program.ask("POST", "/fleets/north/reports", [row("A"), row("B")])[0] == 200
    program.stop()
    assert len((tmp_path / "log.txt").read_text(encoding="utf-8")) < 10_000


def test_the_client_of_the_document_flies(tmp_path):
    (text,) = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    program = Program(tmp_path, "motion=polynomial")
    text = text.replace(":8000", f":{program.port}").replace("3hR5...", TOKEN)
    text = re.sub(r"time\.sleep\(.*\)", "time.sleep(0.1)", text)
    command = [sys.executable, "-c", text]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    status = program.ask("GET", "/fleets/north")[1]["uavs"][0]
    program.stop()
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("landed at") == 3
    assert status["order"] == "landed"
    assert status["reports"] >= 3
