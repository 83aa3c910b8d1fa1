"""A simulated fleet of copters that speak MAVLink over UDP, to try the bridge without ArduPilot.

    python -m damian_fleet.mavlink.vehicles --vehicle A=127.0.0.1:14551 --vehicle B=127.0.0.1:14552 \
        --home 52.8110,-4.1283 --wind 5,0 --gusts 2 --delay 0.1,0.8 --loss 0.1

Each is a point mass whose thrust has a limit, in wind with gusts; its battery drains; its radio delays
messages, in order, and loses some, in both directions. It answers the commands of ArduCopter that the bridge
sends, and refuses those that ArduCopter refuses.
"""

import argparse
import math
import os
import random
import socket
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

os.environ.setdefault("MAVLINK20", "1")
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from damian_fleet.mavlink.bridge import EARTH, GUIDED, LAND, metres

STABILIZE = 0
"""Custom mode of ArduCopter in which it stands at first."""
TICK = 0.1
"""Longest step of the physics [s]."""
PERIODS = {"heartbeat": 1.0, "position": 0.25, "landed": 0.5, "battery": 1.0, "time": 2.0, "spotted": 1.0}
"""Times between two messages of a kind [s]."""


@dataclass(frozen=True)
class Airframe:
    """How a copter flies."""

    acceleration: float = 3.0
    """Most that its thrust accelerates it in each of two directions, horizontal and vertical [m/s^2]."""
    climb: float = 2.5
    """Fastest climb and descent [m/s]."""
    speed: float = 10.0
    """Speed over ground unless a command changes it [m/s]."""
    drag: float = 0.15
    """Acceleration by the air for each m/s of it that passes [1/s]."""
    endurance: float = 1500.0
    """How long a full battery flies [s]."""
    failsafe: float = math.inf
    """Time without a heartbeat of the bridge after which it lands [s]; else it goes on, and waits."""


@dataclass(frozen=True)
class Weather:
    """Wind."""

    east: float = 0.0
    north: float = 0.0
    """Where the mean wind blows [m/s]."""
    gusts: float = 0.0
    """Standard deviation of the gusts, east and north each [m/s]."""
    lasting: float = 4.0
    """Time in which gusts change [s]."""


@dataclass(frozen=True)
class Radio:
    """A link that keeps the order of messages; the same both ways."""

    low: float = 0.0
    high: float = 0.0
    """Bounds between which the delay of a message is drawn [s]."""
    loss: float = 0.0
    """Probability that a message is lost."""


class Link:
    """One direction of a radio, with what is on its way."""

    def __init__(self, radio: Radio, draws: random.Random) -> None:
        self.radio, self.draws = radio, draws
        self.due = 0.0
        self.queue: deque[tuple[float, bytes]] = deque()

    def send(self, now: float, data: bytes, cut: bool) -> None:
        """Put a message on its way, if it does not get lost."""
        if cut or self.draws.random() < self.radio.loss:
            return
        self.due = max(self.due, now + self.draws.uniform(self.radio.low, self.radio.high))
        self.queue.append((self.due, data))

    def arrived(self, now: float) -> list[bytes]:
        """Take the messages that have arrived."""
        found = []
        while self.queue and self.queue[0][0] <= now:
            found.append(self.queue.popleft()[1])
        return found


class Copter:
    """A simulated copter.

    Args:
        bridge: host and port to which it sends its telemetry.
        home: latitude and longitude where it stands first [deg].
        now: the time [s since 1970]; it booted ``up`` seconds before.
        sysid: its MAVLink system ID.
        seed: of gusts and radio.
        spots: whether it hears the source at a latitude and longitude [deg] and time [s]; the payload.
    """

    def __init__(
        self,
        bridge: tuple[str, int],
        home: tuple[float, float],
        now: float,
        sysid: int = 1,
        airframe: Airframe | None = None,
        weather: Weather | None = None,
        radio: Radio | None = None,
        seed: int = 0,
        up: float = 100.0,
        spots: Callable[[float, float, float], bool] | None = None,
    ) -> None:
        self.airframe, self.weather = airframe or Airframe(), weather or Weather()
        self.bridge, self.home, self.now, self.booted, self.spots = bridge, home, now, now - up, spots
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=1)
        draws = random.Random(f"{seed} {sysid}")
        self.gusts = random.Random(f"{seed} {sysid} gusts")
        self.up, self.down = Link(radio or Radio(), draws), Link(radio or Radio(), draws)
        self.cut = False
        """Whether the radio is cut now."""
        self.mode, self.armed, self.landed, self.battery = STABILIZE, False, True, 100.0
        self.position, self.velocity, self.gust = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0]
        """East, north and up of its first place [m]; their rates [m/s]; the gust now [m/s]."""
        self.goal: list[float] | None = None
        """To where it flies [m]; None without thrust."""
        self.speed, self.climbs = self.airframe.speed, False
        self.flights: list[tuple[float, float, float, float]] = []
        """Of each flight when it took off and landed [s], and its distance and path over ground [m]."""
        self._left = (now, 0.0, 0.0)
        self._path, self._heard = 0.0, now
        self._due = dict.fromkeys(PERIODS, now)

    # Physics.

    @property
    def took_off(self) -> float:
        """When it took off last [s]; when it was made, if it never did."""
        return self._left[0]

    @property
    def start(self) -> tuple[float, float]:
        """Latitude and longitude from where it took off last [deg]."""
        return degrees(self._left[1:], self.home)

    def place(self) -> tuple[float, float]:
        """Latitude and longitude [deg]."""
        return degrees(self.position, self.home)

    def step(self, now: float) -> None:
        """Live until an instant [s]: take what has arrived, fly, and send what is due."""
        while self.now < now - 1e-9:
            dt = min(TICK, now - self.now)
            self.now += dt
            self._receive()
            if self.now > self._heard + self.airframe.failsafe:
                self.enter(LAND)
            if not self.landed:
                self._fly(dt)
            self._telemetry()
        for data in self.up.arrived(self.now):
            with suppress(OSError):  # nobody listens yet
                self.socket.sendto(data, self.bridge)

    def _fly(self, dt: float) -> None:
        """Accelerate towards the goal, as fast as it can still stop there, against wind and gusts."""
        frame, wind = self.airframe, (self.weather.east, self.weather.north)
        keep = math.exp(-dt / self.weather.lasting)
        for i in range(2):
            noise = self.gusts.gauss(0.0, self.weather.gusts)
            self.gust[i] = keep * self.gust[i] + math.sqrt(1 - keep * keep) * noise
        goal = [*self.position[:2], -10.0] if self.mode == LAND or self.goal is None else self.goal
        if self.mode == LAND and self.goal is not None:
            goal[:2] = self.goal[:2]  # it lands where it was when it was told to
        away = [to - at for to, at in zip(goal, self.position, strict=True)]
        flat = math.hypot(away[0], away[1])
        slow = (
            min(0.5 if self.position[2] < 3 else frame.climb, frame.climb)
            if self.mode == LAND
            else frame.climb
        )
        wanted = [0.0, 0.0, max(-slow, min(frame.climb, 1.0 * away[2]))]
        if self.climbs and away[2] < 1:
            self.climbs = False
        if flat > 0:
            pace = min(self.speed, flat, math.sqrt(1.4 * frame.acceleration * flat))
            wanted[:2] = [pace * each / flat for each in away[:2]]
        thrust = [(want - have) / 0.4 for want, have in zip(wanted, self.velocity, strict=True)]
        # A steady wind is leant against; gusts are felt.
        thrust[:2] = [
            push - frame.drag * (blow - v) for push, blow, v in zip(thrust, wind, self.velocity, strict=False)
        ]
        size = math.hypot(thrust[0], thrust[1])
        share = min(1.0, frame.acceleration / size) if size else 1.0
        thrust = [
            thrust[0] * share,
            thrust[1] * share,
            max(-frame.acceleration, min(frame.acceleration, thrust[2])),
        ]
        for i in range(3):
            air = frame.drag * (wind[i] + self.gust[i] - self.velocity[i]) if i < 2 else 0.0
            self.velocity[i] += (thrust[i] + air) * dt
            self.position[i] += self.velocity[i] * dt
        self._path += math.hypot(*self.velocity[:2]) * dt
        self.battery = max(0.0, self.battery - 100 * dt / frame.endurance)
        if self.position[2] <= 0 and self.mode == LAND:
            self.position[2], self.velocity, self.goal = 0.0, [0.0, 0.0, 0.0], None
            self.landed, self.armed = True, False
            began, east, north = self._left
            distance = math.hypot(self.position[0] - east, self.position[1] - north)
            self.flights.append((began, self.now, distance, self._path))

    # Messages.

    def _receive(self) -> None:
        with suppress(BlockingIOError, ConnectionError):
            while True:
                self.down.send(self.now, self.socket.recv(2048), self.cut)
        for data in self.down.arrived(self.now):
            for message in self.mav.parse_buffer(data) or []:
                kind = message.get_type()
                if kind == "HEARTBEAT":
                    self._heard = self.now
                elif kind == "TIMESYNC" and message.tc1 == 0:
                    self._send(self.mav.timesync_encode(self._nanoseconds(), message.ts1))
                elif kind in ("COMMAND_LONG", "COMMAND_INT"):
                    result = self._obey(message)
                    self._send(self.mav.command_ack_encode(message.command, result))

    def _obey(self, message) -> int:
        """Do what a command says, as ArduCopter does; returns the MAV_RESULT."""
        flies, command = not self.landed, message.command
        if command == mavlink.MAV_CMD_DO_SET_MODE and message.param2 in (GUIDED, LAND):
            self.enter(int(message.param2))
        elif command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            if flies and not message.param1:
                return mavlink.MAV_RESULT_FAILED
            self.armed = bool(message.param1)
        elif command == mavlink.MAV_CMD_NAV_TAKEOFF:
            if self.mode != GUIDED or not self.armed or flies:
                return mavlink.MAV_RESULT_FAILED
            self.landed, self.climbs, self.speed = False, True, self.airframe.speed
            self.goal, self._path = [*self.position[:2], message.param7], 0.0
            self._left = (self.now, *self.position[:2])
        elif command == mavlink.MAV_CMD_DO_CHANGE_SPEED:
            self.speed = message.param2
        elif command == mavlink.MAV_CMD_DO_REPOSITION and message.get_type() == "COMMAND_INT":
            if self.mode != GUIDED or not flies:
                return mavlink.MAV_RESULT_DENIED
            self.goal = [*metres((message.x / 1e7, message.y / 1e7), self.home), message.z]
        elif command == mavlink.MAV_CMD_NAV_LAND:
            self.enter(LAND)
        elif command != mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return mavlink.MAV_RESULT_UNSUPPORTED
        return mavlink.MAV_RESULT_ACCEPTED

    def enter(self, mode: int) -> None:
        """Take a mode of ArduCopter, as by a command, a pilot or a failsafe."""
        if mode == LAND and self.mode != LAND and not self.landed:
            self.goal = list(self.position)
        self.mode = mode

    def _send(self, message) -> None:
        self.up.send(self.now, message.pack(self.mav), self.cut)

    def _nanoseconds(self) -> int:
        return int((self.now - self.booted) * 1e9)

    def _telemetry(self) -> None:
        """Send what is due."""
        boot, charge = int((self.now - self.booted) * 1000), round(self.battery)
        for kind, due in self._due.items():
            if self.now < due - 1e-9:
                continue
            self._due[kind] = max(due + PERIODS[kind], self.now)
            if kind == "heartbeat":
                flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
                flags |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
                self._send(
                    self.mav.heartbeat_encode(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, flags, self.mode, 4)
                )
            elif kind == "position":
                (lat, lon), up = self.place(), round(self.position[2] * 1000)
                rates = [
                    round(each * 100) for each in (self.velocity[1], self.velocity[0], -self.velocity[2])
                ]
                where = boot, round(lat * 1e7), round(lon * 1e7), up, up
                self._send(self.mav.global_position_int_encode(*where, *rates, 65535))
            elif kind == "landed":
                state = 1 if self.landed else 4 if self.mode == LAND else 3 if self.climbs else 2
                self._send(self.mav.extended_sys_state_encode(0, state))
            elif kind == "battery":
                self._send(self.mav.sys_status_encode(0, 0, 0, 0, 15000, -1, charge, 0, 0, 0, 0, 0, 0))
            elif kind == "time":
                self._send(self.mav.system_time_encode(int(self.now * 1e6), boot))
            elif self.landed and self.spots is not None:
                spotted = float(self.spots(*self.place(), self.now))
                self._send(self.mav.named_value_float_encode(boot, b"spotted", spotted))


def degrees(place, home: tuple[float, float]) -> tuple[float, float]:
    """Latitude and longitude [deg] of a place east and north of home [m], which is near."""
    lat = home[0] + math.degrees(place[1] / EARTH)
    return lat, home[1] + math.degrees(place[0] / (EARTH * math.cos(math.radians(home[0]))))


def main() -> None:
    """Fly in real time, or ``--factor`` times as fast."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--vehicle", action="append", required=True, help="ID=HOST:PORT of the bridge")
    parser.add_argument("--home", default="52.8110,-4.1283", help="LAT,LON of the first; others 40 m apart")
    parser.add_argument("--wind", default="0,0", help="EAST,NORTH [m/s]")
    parser.add_argument("--gusts", type=float, default=0.0, help="standard deviation [m/s]")
    parser.add_argument("--delay", default="0,0", help="LOW,HIGH of the radio, each way [s]")
    parser.add_argument("--loss", type=float, default=0.0, help="probability that a message is lost")
    parser.add_argument("--source", help="LAT,LON of a source, heard within --hears")
    parser.add_argument("--hears", type=float, default=60.0, help="distance at which it is heard [m]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--factor", type=float, default=1.0, help="speed; the service's clock must have it too"
    )
    given = parser.parse_args()

    def pair(text: str) -> tuple[float, float]:
        first, second = map(float, text.split(","))
        return first, second

    home, start, began = pair(given.home), time.time(), time.monotonic()
    spots = None
    if given.source:
        source = pair(given.source)

        def spots(lat: float, lon: float, _: float) -> bool:
            return math.hypot(*metres((lat, lon), source)) < given.hears

    weather, radio = Weather(*pair(given.wind), given.gusts), Radio(*pair(given.delay), given.loss)
    fleet = []
    for i, text in enumerate(given.vehicle):
        host, port = text.partition("=")[2].rsplit(":", 1)
        place = degrees((40.0 * i, 0.0), home)
        own = {"weather": weather, "radio": radio, "seed": given.seed, "spots": spots}
        fleet.append(Copter((host, int(port)), place, start, i + 1, **own))
    while True:
        for copter in fleet:
            copter.step(start + (time.monotonic() - began) * given.factor)
        time.sleep(TICK / 2 / given.factor)


if __name__ == "__main__":
    main()
