"""A copter and a service that do and say what a test scripts, and a bridge between them in virtual
time."""

from collections.abc import Callable
from typing import Any

from damian_fleet.bridge import Answer, Bridge, Memory, Request
from damian_fleet.vehicles import Copter, mavlink

HOME = (52.811, -4.1283)
GOAL = (52.8115, -4.1283)
BEGIN = 1_750_000_000.0
TICK = 0.25


class Vehicle(Copter):
    """Hears and says nothing if it is ``deaf`` or ``silent``, and gives ``results`` instead of
    obeying."""

    def __init__(self, system: int = 1) -> None:
        self.results: dict[int, int] = {}
        self.orders: list[Any] = []
        self.silent = self.deaf = False
        self.mute: tuple[str, ...] = ()
        """Types of messages that get lost."""
        self.kind = (2, 3)
        self.sensors = (0, 0)
        self.receiver = None
        self.acknowledges_to = None
        super().__init__(HOME, system=system, drain=0.0)

    def commands(self, *numbers: int) -> list[int]:
        """The commands that it has heard, but those that ask for telemetry."""
        heard = [each.command for each in self.orders if each.command not in (511, 512)]
        return [each for each in heard if not numbers or each in numbers]

    def step(self, now: float, messages: Any = ()) -> list[Any]:
        sent = super().step(now, [] if self.deaf else messages)
        return [each for each in sent if not self.silent and each.get_type() not in self.mute]

    def obey(self, command: Any, *rest: Any) -> int:
        self.orders.append(command)
        result = self.results.get(command.command)
        return super().obey(command, *rest) if result is None else result

    def send(self, *messages: Any) -> None:
        for each in messages:
            if each.get_type() == "COMMAND_ACK" and self.acknowledges_to:
                each.target_system, each.target_component = self.acknowledges_to
            elif each.get_type() == "HEARTBEAT":
                each.type, each.autopilot = self.kind
            elif each.get_type() == "GPS_RAW_INT" and self.receiver is not None:
                each.fix_type = self.receiver
            elif each.get_type() == "SYS_STATUS":
                present, healthy = self.sensors
                each.onboard_control_sensors_present = present
                each.onboard_control_sensors_health = healthy
        super().send(*messages)

    def switch_motors(self) -> None:
        """On, or off, as somebody does who is not the bridge."""
        if self.armed:
            self.disarm(force=True)
        else:
            self.armed = True
            self.on_ground_since = self.now


class Service:
    """Sends the UAV to and fro, and keeps what it is told; ``bad`` changes its answers."""

    def __init__(self) -> None:
        self.command = ""
        self.reason = "held"
        self.status = ""
        self.n = 0
        self.reports: list[dict[str, Any]] = []
        self.facts: list[tuple[str, str]] = []
        self.offer: dict[str, Any] | None = None
        self.log: list[str] = []
        self.bad: Callable[[Request, Answer], Answer] = lambda _, answer: answer
        self.members: list[str] | None = None

    def answer(self, request: Request, now: float) -> Answer:
        name = request.path.rsplit("/", 1)[-1]
        self.log.append(f"{request.method} {name}")
        status = 200
        body = {}
        if name == "time":
            body = {"time": BEGIN + now}
        elif name == "reports":
            self.reports.append(request.body | {"came": BEGIN + now})
        elif name == "advice":
            body = {"advice": [self.advise()]}
        elif name == "acknowledgements":
            answer = request.body["answer"]
            said = request.body["status"]
            self.facts.append((answer, said))
            if self.offer is not None and answer == self.offer["answer"]:
                self.status = "landed" if self.offer["state"] == "hold" else said
            body = {"status": [said if said != "accepted" else self.status]}
        elif name == "uavs":
            self.members = [*(self.members or []), *request.body.get("join", [])]
            self.members = [
                each for each in self.members if each not in request.body.get("leave", [])
            ]
        elif request.method == "PUT":
            self.members = list(request.body["uavs"])
            status = 201
        elif self.members is None:
            status = 404
            body = {"error": "no fleet"}
        else:
            body = {"dt": 2.0, "uavs": [{"ID": each} for each in self.members]}
        return self.bad(request, Answer(status, body, request.number))

    def advise(self) -> dict[str, Any]:
        is_over = self.offer is None or self.status in ("landed", "aborted", "lapsed")
        kind = self.command or "fly"
        if is_over or (self.command and self.offer["state"] != self.command):
            self.n = self.n + 1
            self.status = "offered"
            self.offer = {"answer": f"x-{self.n}", "ID": "A", "state": kind}
            self.offer |= {"reason": self.reason if self.command else None}
            if kind != "hold":
                lat, lon = (HOME, GOAL)[self.n % 2]
                self.offer |= {
                    "lat": lat,
                    "lon": lon,
                    "altitude": 5.0,
                    "speed": 5.0,
                    "duration": 30.0,
                }
        return self.offer | ({"state": "bound"} if self.status in ("accepted", "taken off") else {})


class World:
    """Bridge, vehicle and service in one virtual time; ``system`` as of ``Bridge``."""

    def __init__(self, system: int | None = None) -> None:
        self.vehicle = Vehicle()
        self.service = Service()
        self.now = 0.0
        self.bridge = Bridge("A", "north", system=system)
        self.states: list[str] = []
        self.others: Callable[[float], list[Any]] = lambda _: []
        """What others say on the link of the vehicle."""
        self._out: list[Any] = []
        self._answers: list[Answer] = []

    def run(self, seconds: float, until: Callable[[], Any] = lambda: False) -> bool:
        for _ in range(round(seconds / TICK)):
            if until():
                return True
            self.now = round(self.now + TICK, 3)
            messages = [*self.vehicle.step(self.now, packed(self._out)), *self.others(self.now)]
            self._out, requests = self.bridge.step(self.now, messages, self._answers)
            self._answers = [self.service.answer(each, self.now) for each in requests]
            if [self.bridge.state] != self.states[-1:]:
                self.states.append(self.bridge.state)
        return bool(until())

    def until(self, state: str) -> "World":
        assert self.run(120, lambda: self.bridge.state == state), (
            self.bridge.state,
            self.bridge.why,
        )
        return self

    def until_said(self, answer: str, how: str) -> bool:
        """Whether the service is told within two flights how an answer ended."""
        return self.run(200, lambda: (answer, how) in self.service.facts)

    def heal(self) -> "World":
        """Let everything go as it should from now on."""
        self.vehicle.results = {}
        self.service.bad = lambda _, answer: answer
        return self

    def start_again(self) -> "World":
        """Start the bridge again, with what it remembers."""
        stored = self.bridge.memory.model_dump_json()
        self.bridge = Bridge("A", "north", memory=Memory.model_validate_json(stored))
        self._out = []
        self._answers = []
        return self


def packed(messages: list[Any]) -> list[Any]:
    """Messages of the bridge as they come in."""
    station = mavlink.MAVLink(None, 255, 191)
    for message in messages:
        message.pack(station)
    return messages
