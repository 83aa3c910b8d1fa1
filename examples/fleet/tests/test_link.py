"""The program: sockets, requests, and what outlives a restart."""

import json
import os
import signal
import socket
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from scripted import Service, Vehicle, mavlink

from damian_fleet.bridge import Answer, Memory, Request
from damian_fleet.link import ask, main, memory_of, parsed_vehicles


@pytest.fixture
def served(request):
    """Serves what a function makes of a request: status and content, or bytes that are no HTTP."""

    def serve(answer):
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
                said = answer(self.command, self.path, json.loads(body or b"null"))
                if isinstance(said, bytes):
                    self.wfile.write(said)
                    return
                self.send_response(said[0])
                self.send_header("Content-Length", str(len(said[1])))
                self.end_headers()
                self.wfile.write(said[1])

            do_POST = do_PUT = do_GET

            def log_message(self, *_):
                """Quiet."""

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        request.addfinalizer(server.server_close)
        request.addfinalizer(server.shutdown)
        return f"http://127.0.0.1:{server.server_port}"

    return serve


@pytest.mark.parametrize(
    ("said", "status", "content"),
    [
        ((200, b'{"time": 1}'), 200, {"time": 1}),
        ((422, b'{"error": "x"}'), 422, {"error": "x"}),
        ((502, b"<html>502 Bad Gateway</html>"), 502, None),
        ((200, b"<html>"), 200, None),
        ((200, b"\xff\xfe"), 200, None),
        (b"garbage\r\n\r\n", None, None),
        (b"", None, None),
    ],
)
def test_what_is_no_json_over_http_is_no_answer(said, status, content, served):
    url = served(lambda *_: said)
    assert ask(url, "token", Request("GET", "/time", number=7)) == Answer(status, content, 7)


def test_a_service_that_is_not_there_is_no_answer():
    assert ask("http://127.0.0.1:9", "token", Request("POST", "/x", {}, number=7)) == Answer(
        None, None, 7
    )


def test_the_program_bridges_over_udp_and_http_until_it_is_interrupted(
    served, tmp_path, monkeypatch
):
    service = Service()
    vehicle = Vehicle()
    now = [0.0]
    service.command = "hold"

    def answer(method, path, body):
        found = service.answer(Request(method, path, body), now[0])
        return found.status, json.dumps(found.body).encode()

    own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    own.bind(("127.0.0.1", 0))
    own.setblocking(False)

    def fly():
        parser = mavlink.MAVLink(None)
        bridge = None
        heard = []
        while service.members != []:
            try:
                data, bridge = own.recvfrom(2048)
                heard += parser.parse_buffer(data) or []
            except BlockingIOError:
                time.sleep(0.01)
                now[0] = round(now[0] + 0.1, 3)
                for message in vehicle.step(now[0], heard) if bridge else []:
                    own.sendto(message.get_msgbuf(), bridge)
                heard = []
            if service.facts and not done:
                done.append(os.kill(os.getpid(), signal.SIGINT))

    done = []
    port = own.getsockname()[1]
    words = [
        "--service",
        served(answer),
        "--fleet",
        "north",
        "--memory",
        str(tmp_path),
        "--token",
        "x",
    ]
    words += ["--vehicle", f"A=udpout:127.0.0.1:{port}#1"]
    monkeypatch.setattr("sys.argv", ["damian-mavlink", *words])
    thread = threading.Thread(target=fly)
    thread.start()
    main()
    thread.join()
    own.close()
    assert service.members == []
    memory = Memory.model_validate_json((tmp_path / "north.A.json").read_text(encoding="utf-8"))
    assert (memory.system, memory.number) == (1, service.reports[-1]["number"] + 1)


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        (["A=udpin:127.0.0.1:1", "A=udpin:127.0.0.1:2"], "A is given twice"),
        (["A=udpin:127.0.0.1:1", "B=udpin:0.0.0.0:1#2"], "A and B are both on 1"),
        (["A=udp:127.0.0.1:1", "B=udpin:127.0.0.1:1"], "A and B are both on 1"),
        (["A=/dev/ttyUSB0", "B=/dev/ttyUSB0"], "A and B are both on /dev/ttyUSB0"),
        (["A="], "A= is not as A=udpin:127.0.0.1:14551#1"),
    ],
)
def test_vehicles_that_are_one_are_refused_by_name(given, problem):
    with pytest.raises(ValueError, match=problem):
        parsed_vehicles(given)
    good = ["A=udpin:127.0.0.1:1#7", "B=udpin:127.0.0.1:2", "C=tcp:10.0.0.1:1"]
    assert parsed_vehicles(good)["A"] == ("udpin:127.0.0.1:1", 7)


def test_a_memory_is_of_one_bridge(tmp_path):
    path = tmp_path / "north.A.json"
    memory, lock = memory_of(path)
    with pytest.raises(ValueError, match="another bridge works with this memory"):
        memory_of(path)
    lock.close()
    path.write_text("{", encoding="utf-8")
    with pytest.raises(ValueError, match="it is not the memory of a bridge"):
        memory_of(path)
    assert memory is None
