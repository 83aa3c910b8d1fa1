"""A bridge between the service ``damian-fleet`` and vehicles that speak MAVLink (ArduCopter).

For now, it is for simulation and supervised trials only: see docs/mavlink.md.

    damian-mavlink --service http://127.0.0.1:8000 --fleet north \
        --vehicle A=udpin:127.0.0.1:14551 --vehicle B=udpin:127.0.0.1:14552    # the token: DAMIAN_TOKEN

For each vehicle it does again and again what README.md calls a session: report, ask, accept, take off,
fly, land, and say so. What is missing is read off the telemetry, and each command is sent again until it is
acknowledged or its effect is seen, so that messages may be late or lost.
"""

import argparse
import json
import logging
import math
import os
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Callable
from datetime import datetime
from typing import Any, NamedTuple

os.environ.setdefault("MAVLINK20", "1")
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

GUIDED, LAND = 4, 9
"""Custom modes of ArduCopter."""
SILENCE = 5.0
"""Age of the newest telemetry above which the link to a vehicle counts as lost [s]."""
PATIENCE = 60.0
"""How long a vehicle may take to leave the ground; a flight may take twice as long as said, and this [s]."""
NEAR = 2.0, 10.0
"""How near to its goal a vehicle begins to land, and how near it must have landed to have got there [m]."""
LEVEL = 1.0
"""Difference to its flight level at which it has climbed enough [m]."""
KEPT = 200
"""Reports that wait for the service while it cannot be reached."""
EARTH = 6_378_137.0
"""Radius by which degrees become metres [m]."""
INTERVALS = {33: 0.25, 245: 0.5, 1: 1.0, 2: 5.0}
"""Messages that it asks for, and the time between two of them [s]: GLOBAL_POSITION_INT, EXTENDED_SYS_STATE,
SYS_STATUS, SYSTEM_TIME."""
Ask = Callable[[str, str, Any], tuple[int, Any]]
"""A request: method, path and body to status and content; raises OSError if the service is not reached."""
_LOG = logging.getLogger("bridge")


def over_http(url: str, token: str, patience: float = 3.0) -> Ask:
    """Requests to a service."""

    def ask(method: str, path: str, body: Any = None) -> tuple[int, Any]:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(url.rstrip("/") + path, data, method=method)
        request.add_header("Authorization", f"Bearer {token}")
        try:
            with urllib.request.urlopen(request, timeout=patience) as answer:
                return answer.status, json.load(answer)
        except urllib.error.HTTPError as error:
            return error.code, json.loads(error.read() or "{}")

    return ask


class ServiceClock:
    """The time of the service [s since 1970], by the local clock and ``GET /time``.

    Worked timeline: asked at 10.0 s, answered 1000.2 s, came in at 10.4 s: the service is 990 s ahead, give
    or take 0.2 s. Later answers count if they came as fast, or if the one that counts is older than a minute.
    """

    def __init__(self, ask: Ask, local: Callable[[], float] = time.monotonic) -> None:
        self.ask, self.local = ask, local
        self.ahead, self._doubt, self._at = 0.0, math.inf, -math.inf

    def __call__(self) -> float:
        return self.local() + self.ahead

    def watch(self) -> None:
        """Ask for the time; raises OSError if the service is not reached."""
        sent = self.local()
        said = self.ask("GET", "/time", None)[1]["time"]
        now = self.local()
        if now - sent <= self._doubt or now - self._at > 60:
            self.ahead, self._doubt, self._at = said - (sent + now) / 2, now - sent, now


class VehicleClock:
    """The time of a vehicle: from its boot time to that of the bridge.

    By TIMESYNC: the vehicle answers with its boot time, and the answer that came back fastest counts. Until
    there is one by SYSTEM_TIME, if the vehicle has the time of a satellite.
    """

    def __init__(self) -> None:
        self.booted: float | None = None
        """When the vehicle booted [s since 1970], as far as known."""
        self.round_trip = math.inf
        """That of the answer that counts [s]."""
        self.latest_trip = 1.0
        """That of the newest answer [s]."""
        self._at = -math.inf

    def timesync(self, boot: float, sent: float, now: float) -> None:
        """An answer with the boot time of the vehicle, to a question that was sent then; all [s]."""
        self.latest_trip = now - sent
        if self.latest_trip <= self.round_trip or now - self._at > 300:  # clocks drift apart
            self.booted, self.round_trip, self._at = (sent + now) / 2 - boot, self.latest_trip, now

    def system_time(self, unix: float, boot: float) -> None:
        """What the vehicle says of the time [s since 1970], 0 if it does not know, and since its boot [s]."""
        if unix > 0 and self.round_trip == math.inf:
            self.booted = unix - boot

    def time(self, boot: float) -> float | None:
        """Seconds since 1970 of a time since boot [s]; None if nothing is known yet."""
        return None if self.booted is None else self.booted + boot


class Goal(NamedTuple):
    """What an answer of the service asks a vehicle to do."""

    answer: str
    lat: float
    lon: float
    altitude: float
    speed: float | None
    duration: float
    distance: float
    given: float
    """When it was accepted [s]."""


class Flight(NamedTuple):
    """A flight that is over: what the service said and what the bridge saw."""

    answer: str
    end: str
    """``landed`` or ``aborted``."""
    said_time: float
    time: float
    """From acceptance to landing [s]."""
    said_distance: float
    distance: float
    """From where it took off to where it landed [m]."""


def battery_of(message: Any) -> float | None:
    """Battery level [%] in SYS_STATUS or BATTERY_STATUS; None if the autopilot does not know it."""
    return None if message is None or message.battery_remaining < 0 else float(message.battery_remaining)


def place_of(position: Any) -> tuple[float, float]:
    """Latitude and longitude [deg] in GLOBAL_POSITION_INT."""
    return position.lat / 1e7, position.lon / 1e7


def metres(place: tuple[float, float], home: tuple[float, float]) -> tuple[float, float]:
    """East and north of home [m] of a latitude and longitude [deg], which are near."""
    east = math.radians(place[1] - home[1]) * EARTH * math.cos(math.radians(home[0]))
    return east, math.radians(place[0] - home[0]) * EARTH


def way(origin: tuple[float, float], goal: tuple[float, float]) -> tuple[float, float]:
    """Distance [m] and heading, clockwise from north [deg], between near latitudes and longitudes [deg]."""
    east, north = metres(goal, origin)
    return math.hypot(east, north), math.degrees(math.atan2(east, north)) % 360


def payload_says(bridge: "Bridge") -> bool:
    """Whether the vehicle says so itself: the newest NAMED_VALUE_FLOAT ``spotted`` is 0.5 or more."""
    return bridge.named.get("spotted", 0.0) >= 0.5


class Bridge:
    """The bridge of one vehicle; ``poll`` again and again.

    Args:
        uav: ID of the UAV at the service.
        link: connection of ``pymavlink.mavutil``.
        ask: requests to the service; ``fleet`` is the name of the fleet there.
        clock: the time of the service [s since 1970].
        period: time between two reports of a vehicle on the ground [s], such as a step of the service.
        listen: how long a landed vehicle listens before it asks [s].
        spotted: whether the vehicle, which is this bridge, hears the source where it stands: your payload.
    """

    def __init__(
        self,
        uav: str,
        link: Any,
        ask: Ask,
        fleet: str,
        clock: Callable[[], float],
        period: float = 5.0,
        listen: float = 0.0,
        spotted: Callable[["Bridge"], bool] = payload_says,
    ) -> None:
        self.uav, self.link, self.ask, self.clock = uav, link, ask, clock
        self.path, self.period, self.listen, self.spotted = f"/fleets/{fleet}", period, listen, spotted
        self.timing, self.seen, self.named = VehicleClock(), {}, {}
        """Newest messages by their types, and newest named values."""
        self.state = "ground"
        """What it does: ground, takeoff, cruise, landing, or watch while somebody else flies."""
        self.goal: Goal | None = None
        self.flights: list[Flight] = []
        self.said: list[tuple[str, str]] = []
        """Answers and what the service has confirmed of them, in order."""
        self.stops: deque[tuple[float, float]] = deque(maxlen=16)
        """Where it was after each decision that it has followed, holding included, newest first [deg]."""
        self._motions, self._spotted = 0, False
        self._facts: deque[tuple[str, str]] = deque()
        self._reports: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self._target: tuple[int, int] | None = None
        self._order: dict[str, tuple[int, float]] = {}
        self._questions: deque[int] = deque(maxlen=32)
        self._accepted: set[int] = set()
        self._due: dict[Any, float] = {}
        self._heard = self._landed_at = self._turned = self._over = -math.inf
        self._heartbeat_at = -math.inf
        self._boot = self._reported = -1
        self._number, self._has_reported = 0, False
        self._origin: tuple[float, float] | None = None
        self._track: float | None = None
        self._offer: dict[str, Any] | None = None

    # Telemetry.

    @property
    def on_ground(self) -> bool:
        """Whether the vehicle said at last that it is on the ground."""
        state = self.seen.get("EXTENDED_SYS_STATE")
        return state is not None and state.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND

    @property
    def in_air(self) -> bool:
        """Whether it said at last that it is in the air."""
        state = self.seen.get("EXTENDED_SYS_STATE")
        return state is not None and state.landed_state in (2, 3, 4)

    @property
    def is_linked(self) -> bool:
        """Whether it is heard, and its place is known."""
        known = {"EXTENDED_SYS_STATE", "GLOBAL_POSITION_INT", "HEARTBEAT"} <= {*self.seen}
        return known and self.clock() - self._heard < SILENCE

    def _receive(self) -> None:
        while (message := self.link.recv_msg()) is not None:
            kind, now = message.get_type(), self.clock()
            if kind == "HEARTBEAT" and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID:
                self._target = message.get_srcSystem(), message.get_srcComponent()
                self._heartbeat_at = now
            if kind == "BAD_DATA" or self._target != (message.get_srcSystem(), message.get_srcComponent()):
                continue
            before, came = self._order.get(kind, (0, -math.inf))
            if now - came < SILENCE and 0 < (before - message.get_seq()) % 256 < 64:
                continue  # an older one, which came on a longer way
            self._order[kind] = message.get_seq(), now
            self._heard = now
            if kind in ("TIMESYNC", "SYSTEM_TIME", "GLOBAL_POSITION_INT"):
                self._note_time(kind, message)
            if kind == "COMMAND_ACK":
                self._note(message)
            elif kind == "NAMED_VALUE_FLOAT":
                self.named[message.name] = message.value
            elif kind != "BATTERY_STATUS" or message.id == 0:
                self.seen[kind] = message

    def _note_time(self, kind: str, message: Any) -> None:
        """Note what a message says of the clock of the vehicle."""
        if kind == "TIMESYNC":
            if message.tc1 and message.ts1 in self._questions:  # and not in those of another station
                self.timing.timesync(message.tc1 / 1e9, message.ts1 / 1e9, self.clock())
        elif kind == "SYSTEM_TIME":
            self.timing.system_time(message.time_unix_usec / 1e6, message.time_boot_ms / 1e3)
        else:
            if message.time_boot_ms < self._boot - 10_000:  # it has booted again
                self.timing, self._reported = VehicleClock(), -1
            self._boot = message.time_boot_ms

    def _note(self, ack: Any) -> None:
        """Note an acknowledgement of the vehicle; what it refuses begins again with its mode."""
        if ack.result == mavlink.MAV_RESULT_ACCEPTED:
            self._accepted.add(ack.command)
        elif ack.result != mavlink.MAV_RESULT_IN_PROGRESS:
            _LOG.info("%s refuses command %d with result %d", self.uav, ack.command, ack.result)
            if self.state == "takeoff":
                self._accepted.clear()

    @property
    def here(self) -> tuple[float, float]:
        """Where the vehicle is [deg]."""
        return place_of(self.seen["GLOBAL_POSITION_INT"])

    # Commands.

    def _is_due(self, what: Any, period: float) -> bool:
        """Whether something is due, which then is so again after a period [s]."""
        now = self.clock()
        if now < self._due.get(what, -math.inf) - 1e-6:
            return False
        self._due[what] = now + period
        return True

    def _command(self, command: int, *params: float, place: tuple[float, float] | None = None) -> bool:
        """Send a command, again if its acknowledgement is overdue; returns whether it is acknowledged."""
        if command in self._accepted:
            return True
        if self._target is None or not self._is_due(command, 1.0 + 1.5 * self.timing.latest_trip):
            return False
        own = (*params, *[0.0] * 7)[:7]
        mav = self.link.mav
        if place is None:
            mav.command_long_send(*self._target, command, 0, *own)
        else:
            x, y = (round(each * 1e7) for each in place)
            frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
            mav.command_int_send(*self._target, frame, command, 0, 0, *own[:4], x, y, own[6])
        return False

    def _keep_in_touch(self) -> None:
        """Heartbeats, clocks, and the messages that it needs."""
        if self._is_due("heartbeat", 1.0):
            kind, none = mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID
            self.link.mav.heartbeat_send(kind, none, 0, 0, mavlink.MAV_STATE_ACTIVE)
            self._questions.append(int(self.clock() * 1e9))
            self.link.mav.timesync_send(0, self._questions[-1])
        if self._target is not None and self._is_due("intervals", 10.0):
            for number, interval in INTERVALS.items():
                command, rate = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, interval * 1e6
                self.link.mav.command_long_send(*self._target, command, 0, number, rate, 0, 0, 0, 0, 0)

    # The service.

    def _request(self, method: str, path: str, body: Any = None) -> Any:
        """The answer of the service; None if there is none now, and ``{}`` if it will never take the body."""
        if self.clock() < self._due.get("service", -math.inf):
            return None
        try:
            code, answer = self.ask(method, self.path + path, body)
        except OSError as error:
            code, answer = 503, str(error)
        if code < 400:
            return answer
        _LOG.log(logging.DEBUG if code == 409 else logging.WARNING, "%s: the service: %s", self.uav, answer)
        if code == 422:
            return {}
        self._due["service"] = self.clock() + 1.0
        return None

    def _acknowledge(self, answer: str, status: str) -> str | None:
        """Say something of an answer; returns how far it has come, or None if the service is not reached."""
        row = {"ID": self.uav, "answer": answer, "status": status}
        told = self._request("POST", "/acknowledgements", row)
        if told is None:
            return None
        come = told.get("status", ["unknown"])[0]
        if come == status or (status == "accepted" and come == "landed"):
            self.said.append((answer, status))
        return come

    def _flush(self) -> None:
        """Say what has happened, in order, and then report."""
        while self._facts and self._acknowledge(*self._facts[0]) is not None:
            self._facts.popleft()
        waiting = [*self._reports] if not self._facts else []
        if waiting and self._request("POST", "/reports", waiting) is not None:
            self._reports.clear()

    def _report(self) -> None:
        """Report what the newest telemetry says, unless that has been reported."""
        position = self.seen["GLOBAL_POSITION_INT"]
        if position.time_boot_ms <= self._reported:
            return
        flies, place, at = self.in_air, place_of(position), self.timing.time(position.time_boot_ms / 1e3)
        battery = battery_of(self.seen.get("SYS_STATUS"))
        if battery is None:
            battery = battery_of(self.seen.get("BATTERY_STATUS"))
        row = {
            "ID": self.uav,
            "time": min(self.clock() if at is None else at, self.clock()),
            "lat": place[0],
            "lon": place[1],
            "battery": battery,
            "source spotted": int(not flies and self.spotted(self)),
            "FLA": max(position.relative_alt / 1e3, 0.1) if flies else 0.0,
            "track": self._track,
            "takeoff-landing time": self._turned if self._turned > 0 else None,
            "previous": [*self.stops][1:],
            "motions": self._motions,
            "sequence": self._number,
        }
        self._spotted = bool(row["source spotted"])
        self._reported, self._number, self._has_reported = position.time_boot_ms, self._number + 1, True
        self._reports.append(row)

    def _decided(self) -> None:
        """Note that a decision has been followed."""
        self.stops.appendleft(self.here)
        self._motions = (0 if self._spotted else self._motions) + 1

    def _asked(self) -> dict[str, Any] | None:
        """What the service tells the vehicle now."""
        told = self._request("GET", f"/advice?uav={self.uav}")
        return told["advice"][0] if told and "advice" in told else None

    # The session.

    def poll(self) -> None:
        """Read what has come, and do what is next."""
        self._receive()
        self._keep_in_touch()
        if self.is_linked:
            getattr(self, f"_{self.state}")()
        self._flush()

    def _turn(self, state: str) -> None:
        """Go over to another state."""
        _LOG.info("%s: %s -> %s", self.uav, self.state, state)
        self.state, self._over = state, self.clock()
        self._accepted.clear()
        self._due = {key: due for key, due in self._due.items() if not isinstance(key, int)}

    def _ground(self) -> None:
        if self.in_air:  # somebody else has taken off, or the bridge began while it flew
            self._found_flying()
            return
        if not self.on_ground:
            return
        now = self.clock()
        if not self.stops:
            self.stops.append(self.here)
        newer = self._boot > self._reported and now >= self._landed_at + self.listen
        if newer and self._is_due("report", self.period):
            self._report()
            self._flush()
        is_known = self._has_reported and not self._facts and not self._reports
        if is_known and self._is_due("ask", min(self.period / 4, 1.0)):
            self._offer = self._offer or self._asked()
            if self._offer is not None:
                self._accept(self._offer)

    def _accept(self, told: dict[str, Any]) -> None:
        """Accept an answer on the ground, and follow it if the service confirms that."""
        if not told["answer"] or told["state"] == "none":
            self._offer = None
            return
        come = self._acknowledge(told["answer"], "accepted")
        if come is None:  # the answer may have got lost: say it again, because it may count already
            return
        self._offer = None
        if come == "taken off":  # of an earlier life of the bridge; it has landed since
            at_goal = way(self.here, (told["lat"], told["lon"]))[0] <= NEAR[1]
            self._facts.append((told["answer"], "landed" if at_goal else "aborted"))
        elif come == "accepted":
            self._follow(told)
            self._turn("takeoff")
        elif come == "landed" and told["reason"] is None:  # it has chosen to hold
            self._decided()

    def _follow(self, told: dict[str, Any]) -> None:
        """Take the goal of an answer."""
        length = told["distance"] or way(self.here, (told["lat"], told["lon"]))[0]
        duration = told["duration"] or length / 3.0
        level, place = told["altitude"] or 20.0, (told["lat"], told["lon"])
        self._origin = self.here
        self._track = way(self.here, place)[1]
        self.goal = Goal(told["answer"], *place, level, told["speed"], duration, length, self.clock())

    def _found_flying(self) -> None:
        """Go on with the flight that the service knows of, or watch."""
        told = self._asked()
        if told is not None and told["state"] == "bound":
            self._follow(told)
            self._turn("cruise")
        elif told is not None:
            self._turn("watch")

    def _takeoff(self) -> None:
        assert self.goal is not None
        if self.in_air:
            if self._turned < self._over:
                self._turned = self.clock()
                self._facts.append((self.goal.answer, "taken off"))
                self._report()
            height = self.seen["GLOBAL_POSITION_INT"].relative_alt / 1e3
            if self._is_taken_over():
                self._end("aborted", "watch")
            elif height >= self.goal.altitude - LEVEL:
                self._turn("cruise")
        elif self.clock() > self._over + PATIENCE:
            self.link.mav.command_long_send(*self._target, 400, 0, 0, 0, 0, 0, 0, 0, 0)  # disarm
            self._end("aborted", "ground")
        else:
            heartbeat = self.seen["HEARTBEAT"]
            custom, guided = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, heartbeat.custom_mode == GUIDED
            armed = heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
            if (guided or self._command(mavlink.MAV_CMD_DO_SET_MODE, custom, GUIDED)) and (
                armed or self._command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
            ):
                self._command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, self.goal.altitude)

    def _is_taken_over(self) -> bool:
        """Whether a pilot or a failsafe has chosen another mode in flight."""
        later = self._heartbeat_at > max(self._turned, self._over) + 2.0  # than the telemetry of the takeoff
        return later and self.seen["HEARTBEAT"].custom_mode != GUIDED

    def _cruise(self) -> None:
        assert self.goal is not None
        if self.on_ground or self._is_taken_over():
            self._ended_early()
            return
        goal = self.goal
        if goal.speed is None or self._command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, goal.speed, -1):
            place, speed = (goal.lat, goal.lon), goal.speed or -1.0
            self._command(
                mavlink.MAV_CMD_DO_REPOSITION, speed, 0, 0, math.nan, 0, 0, goal.altitude, place=place
            )
        position = self.seen["GLOBAL_POSITION_INT"]
        away, pace = way(self.here, (goal.lat, goal.lon))[0], math.hypot(position.vx, position.vy) / 100
        overdue = self.clock() > goal.given + 2 * goal.duration + PATIENCE
        if (away < NEAR[0] and pace < 1.0) or overdue:
            self._turn("landing")
        elif self._is_due("ask in flight", self.period):
            self._obey(self._asked())

    def _obey(self, told: dict[str, Any] | None) -> None:
        """Hold or return if the service says so in flight."""
        if self.goal is None or told is None or told["answer"] in (None, self.goal.answer):
            return
        if told["state"] not in ("hold", "return"):
            return
        old = self.goal.answer
        if self._acknowledge(told["answer"], "accepted") not in ("accepted", "landed"):
            return
        self._end("aborted", "landing" if told["state"] == "hold" else "cruise")
        _LOG.info("%s: %s instead of %s", self.uav, told["state"], old)
        if told["state"] == "return":
            self._follow(told)

    def _landing(self) -> None:
        if self.on_ground:
            self._ended_early() if self.goal else self._touch_down()
        elif self.seen["HEARTBEAT"].custom_mode != LAND:
            self._command(mavlink.MAV_CMD_NAV_LAND)

    def _watch(self) -> None:
        if self.on_ground:
            self._touch_down()

    def _ended_early(self) -> None:
        """The vehicle has landed, or somebody else flies it now: say how the flight has ended."""
        assert self.goal is not None
        there = way(self.here, (self.goal.lat, self.goal.lon))[0] <= NEAR[1]
        if self.on_ground:
            self._end("landed" if there else "aborted", "ground")
            self._touch_down()
        else:
            self._end("aborted", "watch")

    def _touch_down(self) -> None:
        """It stands on the ground: report where, as soon as it has listened."""
        self._decided()
        self._landed_at = self._turned = self.clock()
        self._reported, self._has_reported = max(self._reported, self._boot), False
        self._due.pop("report", None)
        if self.state != "ground":
            self._turn("ground")

    def _end(self, how: str, state: str) -> None:
        """End a flight, and go over to another state."""
        goal = self.goal
        if goal is not None and self._origin is not None:
            self._facts.append((goal.answer, how))
            took, flown = self.clock() - goal.given, way(self._origin, self.here)[0]
            measures = goal.duration, took, goal.distance, flown
            self.flights.append(Flight(goal.answer, how, *measures))
            _LOG.info("%s %s: %.0f s said, %.0f s taken, %.0f m said, %.0f m flown", self.uav, how, *measures)
        self.goal = None
        self._turn(state)


def connect(address: str) -> Any:
    """A connection of MAVLink, such as ``udpin:127.0.0.1:14551``."""
    return mavutil.mavlink_connection(address, source_system=255, source_component=190)


def step_of(ask: Ask, fleet: str, uavs: list[str]) -> float:
    """Create or find a fleet, as soon as there is a service; returns the length of its steps [s]."""
    while True:
        try:
            code, said = ask("PUT", f"/fleets/{fleet}", {"uavs": uavs})
            break
        except OSError as error:
            _LOG.warning("waiting for the service: %s", error)
            time.sleep(2.0)
    if code >= 400:
        raise SystemExit(f"fleet {fleet}: {said}")
    return ask("GET", f"/fleets/{fleet}", None)[1]["dt"]


def main() -> None:
    """Bridge each vehicle in its own thread until the program is stopped."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--service", default="http://127.0.0.1:8000")
    parser.add_argument("--token", default=os.environ.get("DAMIAN_TOKEN", ""))
    parser.add_argument("--fleet", required=True)
    parser.add_argument("--vehicle", action="append", required=True, help="ID=CONNECTION, for each UAV")
    parser.add_argument("--period", type=float, help="between two reports [s]; a step of the service")
    parser.add_argument("--listen", type=float, default=0.0, help="before it asks, after landing [s]")
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    ask = over_http(given.service, given.token)
    named = dict(text.split("=", 1) for text in given.vehicle)
    step, clock = step_of(ask, given.fleet, [*named]), ServiceClock(ask)
    clock.watch()
    _LOG.info("the service has %s", datetime.fromtimestamp(clock()).isoformat(timespec="seconds"))

    def serve(uav: str, address: str) -> None:
        own = given.period or step, given.listen
        bridge = Bridge(
            uav, connect(address), over_http(given.service, given.token), given.fleet, clock, *own
        )
        while True:
            bridge.poll()
            time.sleep(0.02)

    for uav, address in named.items():
        threading.Thread(target=serve, args=(uav, address), daemon=True).start()
    while True:
        time.sleep(10)
        try:
            clock.watch()
        except OSError as error:
            _LOG.warning("the service is not reached: %s", error)


if __name__ == "__main__":
    main()
