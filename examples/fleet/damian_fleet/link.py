"""``damian-mavlink``: bridges between the service ``damian-fleet`` and copters with ArduPilot.

For now, it is for simulation and supervised trials only.

    damian-mavlink --fleet north --vehicle A=udpin:127.0.0.1:14551 --vehicle B=udpin:127.0.0.1:14552

A thread for each vehicle hands what comes in to its ``Bridge`` and sends what that returns; another
one makes its requests, so that a slow service stops nothing. What must outlive a restart lies in
``--memory``.
"""

import argparse
import contextlib
import fcntl
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
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("MAVLINK20", "1")
from typing import Any

from pymavlink import mavutil

from damian_fleet.bridge import STATION, Answer, Bridge, Memory, Request

PATIENCE = 5.0
"""How long the service may take to answer [s]."""
TICK = 0.05
"""Time between two steps of a bridge [s]."""
_LOG = logging.getLogger("damian_mavlink")


def ask(url: str, token: str, request: Request) -> Answer:
    """The answer of a service; without status if there is none, without content if that is no
    JSON."""
    data = None if request.body is None else json.dumps(request.body).encode()
    headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
    made = urllib.request.Request(
        url.rstrip("/") + request.path, data, headers, method=request.method
    )
    status = content = None
    with contextlib.suppress(Exception):  # whatever a proxy or a broken line sends
        try:
            answer = urllib.request.urlopen(made, timeout=PATIENCE)
        except urllib.error.HTTPError as error:
            answer = error
        with answer:
            status = answer.status
            text = answer.read(1_000_000)
        content = json.loads(text or b"{}")
    return Answer(status, content, request.number)


def requester(
    url: str, token: str, asked: "queue.Queue[Request]", answers: "queue.Queue[Answer]"
) -> None:
    """Make the requests of a bridge, the newest if several wait: the others have been given up."""
    while True:
        request = asked.get()
        while not asked.empty():
            request = asked.get()
        answers.put(ask(url, token, request))


def serve(bridge: Bridge, address: str, url: str, token: str, memory: Path) -> None:
    """Let a bridge work until it has left its fleet; an error of ours is logged, and ends no
    flight."""
    link = mavutil.mavlink_connection(address, *STATION, autoreconnect=True)
    asked: queue.Queue[Request] = queue.Queue()
    answers: queue.Queue[Answer] = queue.Queue()
    threading.Thread(target=requester, args=(url, token, asked, answers), daemon=True).start()
    stored = ""
    quiet = -math.inf
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


def parsed_vehicles(given: Sequence[str]) -> dict[str, tuple[str, int | None]]:
    """Address and MAVLink system (None: the first that is heard) of each UAV of ``--vehicle``."""
    vehicles: dict[str, tuple[str, int | None]] = {}
    ports: dict[str, str] = {}
    for text in given:
        uav, _, place = text.partition("=")
        address, _, system = place.partition("#")
        if not (uav and address and (system or "1").isdecimal()):
            raise ValueError(f"{text} is not as A=udpin:127.0.0.1:14551#1")
        if uav in vehicles:
            raise ValueError(f"{uav} is given twice: give each UAV a name of its own")
        kind, _, end = address.partition(":")
        port = end.rpartition(":")[2] if kind in ("udp", "udpin", "tcpin") else address
        if port in ports:
            raise ValueError(
                f"{ports[port]} and {uav} are both on {port}: give each vehicle a port of its own"
            )
        ports[port], vehicles[uav] = uav, (address, int(system) if system else None)
    return vehicles


def memory_of(path: Path) -> tuple[Memory | None, Any]:
    """What a bridge remembers, and the file that keeps other bridges from it while it is open."""
    lock = path.with_suffix(".lock").open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        raise ValueError(f"{path}: another bridge works with this memory: end that one") from None
    try:
        return Memory.model_validate_json(
            path.read_text(encoding="utf-8")
        ) if path.exists() else None, lock
    except ValueError as error:
        lock.close()
        problem = "it is not the memory of a bridge; remove it to begin anew"
        raise ValueError(f"{path}: {problem}: {error}") from None


def main() -> None:
    """Bridge each vehicle until all have left; Ctrl-C lets them land and leave, a second one ends
    at once."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--service", default="http://127.0.0.1:8000")
    parser.add_argument(
        "--token", default=os.environ.get("DAMIAN_TOKEN", ""), help="or DAMIAN_TOKEN"
    )
    parser.add_argument("--fleet", required=True)
    each = "ID=CONNECTION or ID=CONNECTION#SYSTEM, for each UAV"
    parser.add_argument("--vehicle", action="append", required=True, help=each)
    parser.add_argument(
        "--listen", type=float, default=0.0, help="before it reports, after landing [s]"
    )
    parser.add_argument(
        "--memory", type=Path, default=Path("mavlink"), help="what outlives a restart: a folder"
    )
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    given.memory.mkdir(parents=True, exist_ok=True)
    threads = []
    bridges = []
    locks = []
    try:
        vehicles = parsed_vehicles(given.vehicle)
    except ValueError as error:
        parser.error(f"--vehicle: {error}")
    for uav, (address, system) in vehicles.items():
        path = given.memory / f"{given.fleet}.{urllib.parse.quote(uav, safe=' ')}.json"
        try:
            memory, lock = memory_of(path)
        except ValueError as error:
            parser.error(str(error))
        locks.append(lock)
        bridges.append(Bridge(uav, given.fleet, [*vehicles], given.listen, system, memory))
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
    for lock in locks:
        lock.close()


if __name__ == "__main__":
    main()
