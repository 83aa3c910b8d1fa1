"""``damian-mavlink``: bridges between the service ``damian-fleet`` and copters with ArduPilot.

For now, it is for simulation and supervised trials only.

    damian-mavlink --fleet north --vehicle A=udpin:127.0.0.1:14551 --vehicle B=udpin:127.0.0.1:14552

A thread for each vehicle hands what comes in to its ``Bridge`` and sends what that returns; another one makes
its requests, so that a slow service stops nothing. What must outlive a restart lies in ``--memory``.
"""

import argparse
import contextlib
import json
import logging
import math
import os
import queue
import signal
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path

os.environ.setdefault("MAVLINK20", "1")
from pymavlink import mavutil

from damian_fleet.bridge import STATION, Answer, Bridge, Memory, Request

PATIENCE = 5.0
"""How long the service may take to answer [s]."""
TICK = 0.05
"""Time between two steps of a bridge [s]."""
_LOG = logging.getLogger("damian_mavlink")


def ask(url: str, token: str, request: Request) -> Answer:
    """The answer of a service; without status if there is none, without content if that is no JSON."""
    data = None if request.body is None else json.dumps(request.body).encode()
    headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
    made = urllib.request.Request(url.rstrip("/") + request.path, data, headers, method=request.method)
    status = content = None
    with contextlib.suppress(Exception):  # whatever a proxy or a broken line sends
        try:
            answer = urllib.request.urlopen(made, timeout=PATIENCE)
        except urllib.error.HTTPError as error:
            answer = error
        with answer:
            status, text = answer.status, answer.read(1_000_000)
        content = json.loads(text or b"{}")
    return Answer(status, content, request.number)


def requester(url: str, token: str, asked: "queue.Queue[Request]", answers: "queue.Queue[Answer]") -> None:
    """Make the requests of a bridge, the newest if several wait: the others have been given up."""
    while True:
        request = asked.get()
        while not asked.empty():
            request = asked.get()
        answers.put(ask(url, token, request))


def serve(bridge: Bridge, address: str, url: str, token: str, memory: Path) -> None:
    """Let a bridge work until it has left its fleet; an error of ours is logged, and ends no flight."""
    link = mavutil.mavlink_connection(address, *STATION, autoreconnect=True)
    asked: queue.Queue[Request] = queue.Queue()
    answers: queue.Queue[Answer] = queue.Queue()
    threading.Thread(target=requester, args=(url, token, asked, answers), daemon=True).start()
    stored, quiet = "", -math.inf
    while bridge.state != "left":
        try:
            messages = list(iter(link.recv_msg, None))
            come = [answers.get() for _ in range(answers.qsize())]
            commands, requests = bridge.step(time.monotonic(), messages, come)
            for command in commands:
                link.mav.send(command)
            for request in requests:
                asked.put(request)
            if (now := bridge.memory.model_dump_json()) != stored:
                unfinished = memory.with_suffix(".part")
                unfinished.write_text(now, encoding="utf-8")
                unfinished.replace(memory)
                stored = now
        except Exception:
            if time.monotonic() > quiet + 10:
                quiet = time.monotonic()
                _LOG.exception("%s: an error of the bridge", bridge.uav)
        time.sleep(TICK)
    link.close()


def main() -> None:
    """Bridge each vehicle until all have left; Ctrl-C lets them land and leave, a second one ends at once."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--service", default="http://127.0.0.1:8000")
    parser.add_argument("--token", default=os.environ.get("DAMIAN_TOKEN", ""), help="or DAMIAN_TOKEN")
    parser.add_argument("--fleet", required=True)
    each = "ID=CONNECTION or ID=CONNECTION#SYSTEM, for each UAV"
    parser.add_argument("--vehicle", action="append", required=True, help=each)
    parser.add_argument("--listen", type=float, default=0.0, help="before it reports, after landing [s]")
    parser.add_argument(
        "--memory", type=Path, default=Path("mavlink"), help="what outlives a restart: a folder"
    )
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    given.memory.mkdir(parents=True, exist_ok=True)
    named = dict(text.partition("=")[::2] for text in given.vehicle)
    threads, bridges = [], []
    for uav, place in named.items():
        address, _, system = place.partition("#")
        if not (uav and address and (system or "1").isdecimal()):
            parser.error(f"--vehicle: {uav}={place} is not as A=udpin:127.0.0.1:14551#1")
        path = given.memory / f"{given.fleet}.{urllib.parse.quote(uav, safe=' ')}.json"
        try:
            memory = Memory.model_validate_json(path.read_text(encoding="utf-8")) if path.exists() else None
        except ValueError as error:
            parser.error(f"{path}: it is not the memory of a bridge; remove it to begin anew: {error}")
        own = given.listen, int(system) if system else None, memory
        bridges.append(Bridge(uav, given.fleet, [*named], *own))
        work = bridges[-1], address, given.service, given.token, path
        threads.append(threading.Thread(target=serve, args=work, daemon=True))

    def leave(*_: object) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        for bridge in bridges:
            bridge.leaving = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, leave)
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


if __name__ == "__main__":
    main()
