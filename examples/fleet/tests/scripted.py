"""A vehicle and a service that say what a test scripts."""

import os
from collections.abc import Callable
from typing import Any

os.environ.setdefault("MAVLINK20", "1")
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from damian_fleet.bridge import GUIDED, LAND, STATION, Answer, Request, way

STABILIZE, LOITER, RTL = 0, 5, 6
HOME, GOAL = (52.811, -4.1283), (52.8115, -4.1283)
BEGIN = 1_750_000_000.0
TICK = 0.1


class Vehicle:
    """Says what it is told to say; takes mode, arming, takeoff, reposition and landing as ArduCopter does."""

    def __init__(self, system: int = 1) -> None:
        self.mav = mavlink.MAVLink(None, system, 1)
        self.mode, self.armed, self.landed = STABILIZE, False, True
        self.place, self.height, self.pace, self.fall = list(HOME), 0.0, 0.0, 0.0
        self.goal: tuple[tuple[float, float], float] | None = None
        self.speed, self.target = 10.0, 0.0
        self.results: dict[int, int] = {}
        self.heard: list[tuple[float, Any]] = []
        self.silent = self.deaf = False
        self.booted, self.status = -100.0, 0
        self.fix, self.batteries, self.kind = True, {0: 80}, (2, 3)
        self.station = STATION
        self.said: list[Any] = []
        self.extra: list[Any] = []

    def commands(self, *numbers: int) -> list[int]:
        """The commands that it has heard, but those that ask for telemetry."""
        heard = [each.command for _, each in self.heard if each.command != 511]
        return [each for each in heard if not numbers or each in numbers]

    def step(self, now: float, messages: list[Any]) -> list[Any]:
        said: list[Any] = []
        for message in [] if self.deaf else messages:
            if message.get_type().startswith("COMMAND") and message.target_system == self.mav.srcSystem:
                self.heard.append((now, message))
                result = self.results.get(message.command)
                result = self.obey(message) if result is None else result
                said.append(mavlink.MAVLink_command_ack_message(message.command, result, 0, 0, *self.station))
            elif message.get_type() == "TIMESYNC" and message.tc1 == 0:
                said.append(mavlink.MAVLink_timesync_message(int((now - self.booted) * 1e9), message.ts1))
        self.fly()
        n = round(now / TICK)
        flags = 1 | (128 if self.armed else 0)
        if n % 10 == 0:
            said.append(
                mavlink.MAVLink_heartbeat_message(
                    *self.kind, flags, self.mode, self.status or (3 if self.landed else 4), 3
                )
            )
            for number, left in self.batteries.items():
                said.append(
                    mavlink.MAVLink_battery_status_message(number, 0, 0, 0, [0] * 10, -1, -1, -1, left)
                )
        if n % 3 == 0:
            place = [round(each * 1e7) for each in (self.place if self.fix else (0, 0))]
            up, fall = round(self.height * 1000), round(self.fall * 100)
            boot = round((now - self.booted) * 1000)
            said.append(
                mavlink.MAVLink_global_position_int_message(
                    boot, *place, up, up, round(self.pace * 100), 0, fall, 0
                )
            )
        if n % 5 == 0:
            state = 1 if self.landed else 4 if self.mode == LAND else 3 if self.goal is None else 2
            said.append(mavlink.MAVLink_extended_sys_state_message(0, state))
        said, self.extra = said + self.extra, []
        return [] if self.silent else self.wired(said)

    def wired(self, messages: list[Any]) -> list[Any]:
        """Messages as they come in."""
        parser, found = mavlink.MAVLink(None), []
        for message in messages:
            found += parser.parse_buffer(message.pack(self.mav)) or []
            self.mav.seq = (self.mav.seq + 1) % 256
        return found

    def obey(self, message: Any) -> int:
        command = message.command
        if command == 176:
            self.mode = int(message.param2)
        elif command == 400:
            self.armed = bool(message.param1)
        elif command == 22:
            if self.mode != GUIDED or not self.armed or not self.landed:
                return 4
            self.landed, self.target, self.goal, self.speed = False, message.param7, None, 10.0
        elif command == 192:
            if self.mode != GUIDED:
                return 2
            if self.goal is None:
                self.speed = 10.0  # the position controller begins with the default
            self.goal, self.target = (message.x / 1e7, message.y / 1e7), message.z
        elif command == 178:
            self.speed = message.param2
        elif command == 21:
            self.mode = LAND
        return 0

    def fly(self) -> None:
        self.pace = self.fall = 0.0
        if self.landed:
            return
        if self.mode in (LAND, RTL):
            self.fall = 1.0
            self.height -= TICK
            if self.height <= 0:
                self.height, self.landed, self.armed, self.goal = 0.0, True, False, None
        elif self.mode == GUIDED:
            self.height += max(-0.3, min(0.3, self.target - self.height))
            if self.goal is not None:
                away = way(tuple(self.place), self.goal)[0]
                self.pace = min(self.speed, away)
                share = min(1.0, self.pace * TICK / away) if away else 0.0
                self.place = [a + share * (b - a) for a, b in zip(self.place, self.goal, strict=True)]


class Service:
    """Sends the UAV to and fro, and keeps what it is told."""

    def __init__(self) -> None:
        self.goals, self.level, self.command = [GOAL, HOME], 20.0, ""
        self.reports: list[dict[str, Any]] = []
        self.facts: list[tuple[str, str]] = []
        self.offer: dict[str, Any] | None = None
        self.status = ""
        self.n, self.reason = 0, "held"
        self.log: list[str] = []
        self.bad: Callable[[Request, Answer], Answer] = lambda _, answer: answer
        self.members: list[str] | None = None

    def answer(self, request: Request, now: float) -> Answer:
        name = request.path.rsplit("/", 1)[-1]
        self.log.append(f"{request.method} {name}")
        status, body = 200, {}
        if name == "time":
            body = {"time": BEGIN + now}
        elif name == "reports":
            self.reports.append(request.body | {"came": BEGIN + now})
        elif name == "advice":
            body = {"advice": [self.advise()]}
        elif name == "acknowledgements":
            answer, said = request.body["answer"], request.body["status"]
            self.facts.append((answer, said))
            if self.offer is not None and answer == self.offer["answer"]:
                self.status = "landed" if self.offer["state"] == "hold" else said
            body = {"status": [said if said != "accepted" else self.status]}
        elif name == "uavs":
            self.members = [*(self.members or []), *request.body.get("join", [])]
            self.members = [each for each in self.members if each not in request.body.get("leave", [])]
        elif request.method == "PUT":
            self.members, status = list(request.body["uavs"]), 201
        elif self.members is None:
            status, body = 404, {"error": "no fleet"}
        else:
            body = {"dt": 2.0, "uavs": [{"ID": each} for each in self.members]}
        return self.bad(request, Answer(status, body, request.number))

    def advise(self) -> dict[str, Any]:
        is_over = self.offer is None or self.status in ("landed", "aborted", "lapsed")
        kind = self.command or "fly"
        if is_over or (self.command and self.offer["state"] != self.command):
            self.n += 1
            place = self.goals[self.n % 2 - 1]
            told = {
                "answer": f"x-{self.n}",
                "ID": "A",
                "state": kind,
                "reason": self.reason if self.command else None,
            }
            if kind != "hold":
                told |= {
                    "lat": place[0],
                    "lon": place[1],
                    "altitude": self.level,
                    "speed": 5.0,
                    "duration": 30.0,
                }
            self.offer, self.status = told, "offered"
        bound = self.status in ("accepted", "taken off")
        return self.offer | ({"state": "bound"} if bound else {})
